"""A cube whose channels are shared by the ranks of an MPI job: the images of one process, and every way to end."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_ms import column, edit, simulate

casatools = pytest.importorskip("casatools")

import cube_mpi_steps

from casa_sara import tsara
from casa_sara.solver.record import STOPPED_BY_USER

ARCSEC = np.pi / 180 / 3600
GRID = dict(imsize=[64, 60], cell="10arcsec", datacolumn="data", specmode="cube", nthreads=1,
            wavelets=["dirac", "db1", "db4"])
LINE = np.array([0.2, 0.5, 1.0, 0.3, 0.2])  # Jy in each channel
BLANK = 1
LIMIT = 300  # s
PRODUCTS = ("model", "residual", "psf", "image", "mask", "sumwt", "model.error", "image.error")

pytestmark = [pytest.mark.slow, pytest.mark.skipif(
    shutil.which("mpirun") is None or importlib.util.find_spec("mpi4py") is None
    or importlib.util.find_spec("casampi") is not None, reason="needs mpirun and mpi4py, and no casampi")]


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """One process: four channels of five have data, and a mask whose plane is the same in all."""
    folder = tmp_path_factory.mktemp("runs")
    vis = simulate(folder / "line.ms", frame="LSRK", spws=(("1.42GHz", "50kHz", 5),), scans=2, antennas=10, noise=0.02,
                   sky=((1.0, 20 * ARCSEC, -30 * ARCSEC),), columns=("DATA", "MODEL_DATA"))
    model = column(vis, "MODEL_DATA")
    edit(vis, "DATA", lambda data: data + (LINE[:, None] - 1) * model)
    edit(vis, "FLAG", lambda flag: flag | (np.arange(5) == BLANK)[:, None])
    common = dict(vis=str(vis), mask="circle[[30pix,27pix],12pix]", ndraws=2, **GRID)
    return folder, common, tsara(imagename=str(folder / "one"), **common)


def mpirun(ranks, steps, folder):
    path = folder / f"steps{len(list(folder.glob('steps*.json')))}.json"
    path.write_text(json.dumps(steps))
    environment = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1", OMP_NUM_THREADS="1",
                       PYTHONPATH=os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
    done = subprocess.run(["mpirun", "--oversubscribe", "-n", str(ranks), sys.executable, cube_mpi_steps.__file__,
                           str(path)], cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT)
    said = [[json.loads(line) for line in Path(f"{path}.{rank}").read_text().splitlines()] for rank in range(ranks)]
    return done, said


def same(one, other):
    for product in PRODUCTS:
        pixels = []
        for name in (one, other):
            ia = casatools.image()
            ia.open(f"{name}.{product}")
            pixels.append(ia.getchunk())
            ia.close()
        np.testing.assert_array_equal(*pixels, err_msg=product)


def test_channels_on_two_ranks_are_those_of_one_process(runs):
    folder, common, alone = runs
    done, said = mpirun(2, [["run", dict(common, imagename="two", parallel=True)]], folder)
    assert done.returncode == 0, done.stderr
    same(folder / "two", folder / "one")
    for rank in range(2):
        (found,) = said[rank]
        assert found["codes"] == [channel.get("stopcode") for channel in alone["sara"]["channels"]]
        assert found["iterdone"] == alone["iterdone"] and found["notes"] == alone["sara"]["notes"]
    ours, theirs = (json.loads((folder / f"{name}.sara.json").read_text()) for name in ("two", "one"))
    assert [channel.get("islands") for channel in ours["channels"]] == [channel.get("islands")
                                                                        for channel in theirs["channels"]]


def test_a_stop_of_one_rank_stops_all_and_three_go_on_to_the_same_images(runs):
    folder, common, alone = runs
    stopped = dict(common, imagename="stopped", parallel=True)
    done, said = mpirun(2, [["stopped", stopped]], folder)
    assert done.returncode == 0, done.stderr
    assert [found["stopcode"] for (found,) in said] == [STOPPED_BY_USER] * 2
    assert (folder / "stopped.checkpoint").exists() and (folder / "stopped.checkpoint.1").exists()
    done, said = mpirun(3, [["run", dict(stopped, restart=True)]], folder)
    assert done.returncode == 0, done.stderr
    assert said[0][0]["iterdone"] == alone["iterdone"]
    same(folder / "stopped", folder / "one")
    assert not list(folder.glob("stopped.checkpoint*"))


def test_an_error_of_one_rank_ends_the_others_soon(runs):
    folder, common, _ = runs
    done, said = mpirun(2, [["failing", dict(common, imagename="failing", parallel=True)]], folder)
    assert done.returncode != 0
    assert [found["error"] for (found,) in said] == ["rank 1 has had enough"] * 2
    assert not (folder / "failing.model").exists()
