"""casampi's client has its servers do the task. Where casampi is installed, ranks can do nothing else:
a file of its own."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from simulated_ms import simulate

pytest.importorskip("casatools")
pytestmark = pytest.mark.skipif(
    shutil.which("mpirun") is None or not all(map(importlib.util.find_spec, ("mpi4py", "casampi"))),
    reason="needs mpirun, mpi4py and casampi")

SCRIPT = """
import json
import casatasks  # from here on all processes but the first are servers
from casa_sara import tsara
parameters = dict(vis="d.ms", imagename="image", imsize=64, cell="3arcsec", datacolumn="data", niter=3, nthreads=1)
result = tsara(parallel=True, **parameters)
try:
    tsara(parallel=True, **parameters)
except FileExistsError as error:
    refusal = str(error)
print()
print(json.dumps(["found", result["iterdone"], result["sara"]["visibilities"], refusal]), flush=True)
"""


def test_the_servers_of_casampi_make_the_image(tmp_path):
    simulate(tmp_path / "d.ms", sky=[(1.0, 0.0, 0.0)], noise=0.02, seed=1)
    (tmp_path / "script.py").write_text(SCRIPT)
    environment = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1", OMP_NUM_THREADS="1",
                       PYTHONPATH=os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(["mpirun", "--oversubscribe", "-n", "3", sys.executable, "script.py"], cwd=tmp_path,
                          env=environment,
                          capture_output=True, text=True, timeout=300)
    said = [json.loads(line) for line in done.stdout.split("\n") if line.startswith('["found"')]
    assert done.returncode == 0 and len(said) == 1, done.stderr[-2000:]
    _, iterations, visibilities, refusal = said[0]
    assert iterations == 3 and visibilities > 100
    assert refusal.startswith("imagename = 'image': ") and "exist" in refusal
    assert (tmp_path / "image.model").is_dir()
