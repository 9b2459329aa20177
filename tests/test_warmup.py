"""Kernels that a thread loads before they are needed: all of them, and none of them again."""

import subprocess
import sys

PROGRAM = """
import gc, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from casa_sara.warmup import use_every_kernel

def loaded():
    return {(one.py_func.__module__, one.py_func.__name__): len(one.signatures)
            for one in gc.get_objects() if isinstance(one, Dispatcher) and one.py_func.__module__.startswith("casa_sara")}

if sys.argv[1] == "warm":
    use_every_kernel()
before = loaded()

from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.problem import Samples
from casa_sara.reconstruction import reconstruct
from casa_sara.visibilities import RowTable, Visibilities

rng = np.random.default_rng(5)
rows = 60
zeros = np.zeros(rows, np.int32)
table = RowTable(**{name: zeros for name in RowTable.__dataclass_fields__}
                 | dict(time=np.arange(rows) * 10.0, interval=np.full(rows, 10.0), row=np.arange(rows)))
data = Visibilities(
    vis=(1 + 0.1 * rng.standard_normal(rows) + 0.1j * rng.standard_normal(rows)).astype(np.complex64),
    weight=np.full(rows, 100, np.float32), imaging_weight=np.full(rows, 100, np.float32),
    uvw=rng.normal(size=(3, rows)) * 1e4, row=np.arange(rows, dtype=np.int32), chan=np.zeros(rows, np.int16), rows=table,
    ms_names=("a.ms",), notes=[], phase_center={}, freq_range_hz=(1e9, 2e9), spws={0: (0,)}, observatory="VLA", dropped={})
found = reconstruct(Samples(data, np.array([0, 30, rows]), np.ones(rows, np.float32)),
                    ImageGrid((32, 48), (5e-6, 5e-6)), SolverOptions(niter=70, nreweights=2))
assert found.record.iteration[-1] >= 60
new = {name for name, count in loaded().items() if count != before.get(name, 0)}
print(sorted(new))
"""


def run(how):
    return eval(subprocess.run([sys.executable, "-c", PROGRAM, how], check=True, capture_output=True, text=True).stdout)


def test_a_run_needs_no_kernel_that_was_not_loaded():
    cold = run("cold")
    assert len(cold) > 8  # else this does not see what is loaded
    assert run("warm") == []
