"""Kernels that a thread loads before they are needed, all of them and none again;
and compiles where they are missing."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import gc, sys
import numpy as np
from numba.core.dispatcher import Dispatcher
from casa_sara.reconstruction.compile_cache import use_every_kernel

def loaded():
    return {(one.py_func.__module__, one.py_func.__name__): len(one.signatures)
            for one in gc.get_objects() if isinstance(one, Dispatcher)
            and one.py_func.__module__.startswith("casa_sara")}

if sys.argv[1] == "warm":
    use_every_kernel()
before = loaded()

from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import reconstruct
from casa_sara.data.visibilities import RowTable, Visibilities

rng = np.random.default_rng(5)
rows = 60
zeros = np.zeros(rows, np.int32)
table = RowTable(**{name: zeros for name in RowTable.__dataclass_fields__}
                 | dict(time=np.arange(rows) * 10.0, interval=np.full(rows, 10.0), row=np.arange(rows)))
data = Visibilities(
    vis=(1 + 0.1 * rng.standard_normal(rows) + 0.1j * rng.standard_normal(rows)).astype(np.complex64),
    weight=np.full(rows, 100, np.float32), imaging_weight=np.full(rows, 100, np.float32),
    uvw=rng.normal(size=(3, rows)) * 1e4, row=np.arange(rows, dtype=np.int32), chan=np.zeros(rows, np.int16),
    rows=table, ms_names=("a.ms",), notes=[], phase_center={}, freq_range_hz=(1e9, 2e9), spws={0: (0,)},
    observatory="VLA", dropped={})
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


# Compiling --------------------------------------------------------------------------------------

COMPILE = """
from numba.core import event
from casa_sara.reconstruction import compile_cache
{change}
with event.install_recorder("numba:compile") as recorder:
    compile_cache.compile_kernels()
print([str(compile_cache._mark()), len(recorder.buffer)])
"""
LOADED = """
from numba.core import event
from casa_sara.reconstruction.compile_cache import kernels_loading
said = []
with event.install_recorder("numba:compile") as recorder, kernels_loading(said.append):
    pass
print([said, len(recorder.buffer)])
"""
WITHOUT = """
from casa_sara.reconstruction import compile_cache
said, compile_cache.compile_kernels = [], lambda: None
with compile_cache.kernels_loading(said.append):
    pass
print([compile_cache._mark(), said])
"""


def environment(cache):
    return {**os.environ, "NUMBA_CACHE_DIR": str(cache), "PYTHONPATH": str(Path(__file__).parents[1])}


def start(code, cache):
    return subprocess.Popen([sys.executable, "-c", code], env=environment(cache), stdout=subprocess.PIPE, text=True)


def output(process):
    said, _ = process.communicate()
    assert process.returncode == 0
    return said


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A folder of compiled code that two processes have filled at the same time; each has said where its mark is."""
    folder = tmp_path_factory.mktemp("numba")
    both = [start(COMPILE.format(change="pass"), folder) for _ in range(2)]
    (mark, one), (same, other) = [eval(output(process)) for process in both]
    assert mark == same and Path(mark).exists()
    assert min(one, other) == 0 < max(one, other)  # one waits, and finds what the other has compiled
    return folder


@pytest.mark.slow
def test_what_is_compiled_is_found_and_not_announced(cache):
    said, compiled = eval(output(start(LOADED, cache)))
    assert said == [] and compiled == 0


@pytest.mark.slow
def test_two_processes_leave_each_kernel_once(cache):
    """One file of compiled code for each kernel and signature; the gridding kernels have two widths."""
    code = [path.name.split("-")[0] for path in cache.rglob("*.nbc")]
    assert len(code) > 10
    assert {name for name in code if code.count(name) > 1} == {"nufft._interpolate", "nufft._spread"}
    assert not list(cache.rglob("*.tmp.*"))


@pytest.mark.slow
@pytest.mark.parametrize("mark", ["removed", "of another version"])
def test_what_is_not_compiled_is_announced(cache, tmp_path, mark):
    shutil.copytree(cache, tmp_path / "numba")
    path, = (tmp_path / "numba").rglob("*.compiled")
    path.unlink() if mark == "removed" else path.rename(path.with_name("casa_sara-0123456789abcdef.compiled"))
    said, _ = eval(output(start(LOADED, tmp_path / "numba")))
    assert len(said) == 1 and f"later runs find them in '{path.parent}'" in said[0]
    assert path.exists()  # now it is


@pytest.mark.slow
def test_a_helper_that_is_killed_is_made_up_for(cache, tmp_path):
    """Everything but the dictionary is there, and the process that is to compile this is killed: its parent does it."""
    shutil.copytree(cache, tmp_path / "numba")
    for path in (tmp_path / "numba").rglob("*"):
        if path.name.startswith(("_wavelet", "casa_sara")):
            path.unlink()
    kill = "wait = compile_cache._wait_for; compile_cache._wait_for = lambda helper: (helper.kill(), wait(helper))"
    mark = Path(eval(output(start(COMPILE.format(change=kill), tmp_path / "numba")))[0])
    assert mark.exists() and list(mark.parent.glob("_wavelet_kernels.transform*.nbc"))


def test_without_a_folder_every_process_compiles_and_says_so(tmp_path):
    """No folder can be written to: Numba's own error at import is not ours."""
    (tmp_path / "file").touch()
    only_here = {"NUMBA_CACHE_LOCATOR_CLASSES": "UserProvidedCacheLocator"}
    found = subprocess.run([sys.executable, "-c", WITHOUT], capture_output=True, text=True, check=True,
                           env=environment(tmp_path / "file" / "below") | only_here)
    mark, said = eval(found.stdout)
    assert mark is None and len(said) == 1 and "NUMBA_CACHE_DIR" in said[0]
