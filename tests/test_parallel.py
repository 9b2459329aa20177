"""The task on several ranks of an MPI job: the same image, the same bounds, and an end whatever happens."""

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_mosaic import CENTRE, simulate_mosaic
from simulated_ms import edit, pixels, simulate

pytest.importorskip("casatools")

import mpi_steps

from casa_sara import tsara
from casa_sara.casa.ms import read as ms_module
from casa_sara.casa.ms.data_volume import DataVolume
from casa_sara.imaging.load_balance import assign_ranks, solver_samples
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.mpi import LAUNCHED
from casa_sara.parallel.serial import Serial
from casa_sara.solver.record import ITERATION_LIMIT, STOPPED_BY_USER

ARCSEC = np.pi / 180 / 3600
SKY = [(1.0, -12 * ARCSEC, 7 * ARCSEC), (0.4, 9 * ARCSEC, -10 * ARCSEC), (0.5, 0, 0), (0.2, 2 * ARCSEC, 1 * ARCSEC)]
GRID = dict(imsize=72, cell="0.9arcsec", datacolumn="data", nthreads=1)
LIMIT = 300  # s; a quiet machine needs a tenth
AGREE = 1e-5
ERRORS_AGREE = 1e-2  # differences of two images, in single precision, after the same random numbers
WILD = 1e4

mpi = pytest.mark.skipif(shutil.which("mpirun") is None or importlib.util.find_spec("mpi4py") is None
                         or importlib.util.find_spec("casampi") is not None,
                         reason="needs mpirun and mpi4py, and no casampi, which makes servers of the ranks")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("parallel")


@pytest.fixture(scope="module")
def vis(folder):
    """Four scans; one sample is wild, one row is flagged."""
    name = simulate(folder / "c.ms", configuration="c", antennas=14, sky=SKY, noise=0.05, scans=4, integration=20.0,
                    spacing_seconds=5400.0, hour_angle=-2.5, seed=4)
    edit(name, "DATA", _spoil)
    edit(name, "FLAG_ROW", lambda flag: np.arange(flag.size) == 17)
    return str(name)


def _spoil(data):
    data[:, 1, 700] = WILD
    return data


@pytest.fixture(scope="module")
def alone(vis, folder):
    """What one process finds, by the name of the run."""
    found = {}
    chunk, ms_module._CHUNK = ms_module._CHUNK, mpi_steps.read._CHUNK
    for name, parameters in _runs(vis, folder / "alone").items():
        found[name] = mpi_steps.run(**parameters)
    ms_module._CHUNK = chunk
    return found


def _runs(vis, folder, **more):
    """The runs that all numbers of ranks do.

    Re-weighted; with hard bounds, equal blocks and uniform weights; and with w-term, spectrum, mask, a block, draws.
    """
    folder.mkdir(exist_ok=True)
    common = dict(vis=vis, **GRID, **more)
    return {
        "whole": dict(common, imagename=str(folder / "whole"), niter=125),
        "hard": dict(common, imagename=str(folder / "hard"), niter=12, nreweights=0, databound="weights", blocks=3,
                     weighting="uniform"),
        "rich": dict(common, imagename=str(folder / "rich"), niter=12, gridder="wproject", spectralindex=-0.7,
                     mask="circle[[30pix,34pix],18pix]", blocks=["scan=2"], ndraws=2),
    }


def _mpirun(ranks, steps, folder):
    """Run the steps; return the exit status and what each rank said of each step."""
    path = folder / f"steps{ranks}.json"
    path.write_text(json.dumps(steps))
    environment = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1", OMP_NUM_THREADS="1",
                       PYTHONPATH=os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")]))
    version = subprocess.run(["mpirun", "--version"], capture_output=True, text=True).stdout
    over = ["--oversubscribe"] if "Open MPI" in version else []
    done = subprocess.run(["mpirun", *over, "-n", str(ranks), sys.executable, mpi_steps.__file__, str(path)],
                          cwd=folder,
                          env=environment, capture_output=True, text=True, timeout=LIMIT)
    said = [{} for _ in steps]
    for rank in range(ranks):
        for line in Path(f"{path}.{rank}").read_text().splitlines() if os.path.exists(f"{path}.{rank}") else ():
            found = json.loads(line)
            said[found.pop("step")][rank] = found
    return done, said


def _same_images(one, other, products=("model", "psf")):
    for product in products:
        a, b = (pixels(f"{name}.{product}") for name in (one, other))
        assert np.abs(a - b).max() <= AGREE * np.abs(b).max(), product
    residuals = [pixels(f"{name}.residual") for name in (one, other)]
    assert np.abs(residuals[0] - residuals[1]).max() <= AGREE * pixels(f"{other}.image").max()


def _same_findings(found, expected, ranks):
    assert sorted(found) == list(range(ranks))
    assert all(found[rank] == found[0] for rank in found)  # the same dictionary on every rank
    exact = ("iterdone", "stopcode", "visibilities", "wild", "labels", "dropped", "averages", "halvings")
    assert {name: found[0][name] for name in exact} == {name: expected[name] for name in exact}
    np.testing.assert_allclose(found[0]["noise"], expected["noise"], rtol=1e-12)
    for name in ("bounds", "residual_norm"):
        np.testing.assert_allclose(found[0][name], expected[name], rtol=AGREE)


@pytest.fixture(scope="module")
def two(vis, folder, alone):
    """Two ranks: the runs, a refusal that the job survives, and a run that is asked to stop."""
    runs = _runs(vis, folder / "two", parallel=True)
    stopped = dict(runs["whole"], imagename=str(folder / "two" / "stopped"))
    steps = [["run", runs["whole"]], ["refused", runs["whole"]], ["run", runs["hard"]], ["stopped", stopped],
             ["run", runs["rich"]]]
    return _mpirun(2, steps, folder)


@pytest.fixture(scope="module")
def three(folder, two, vis, alone):
    """Three ranks: go on with what two have left, and a rank that is killed."""
    runs = _runs(vis, folder / "three", parallel=True)
    resume = dict(runs["whole"], imagename=str(folder / "two" / "stopped"), restart=True)
    return _mpirun(3, [["run", resume], ["killed", runs["whole"]], ["run", runs["whole"]]], folder)


@mpi
def test_two_ranks_find_what_one_process_finds(two, alone, folder):
    done, said = two
    assert done.returncode == 0, done.stderr
    for step, name in ((0, "whole"), (2, "hard"), (4, "rich")):
        _same_findings(said[step], alone[name], 2)
        _same_images(folder / "two" / name, folder / "alone" / name)
    for product in ("model.error", "image.error"):
        found, expected = (pixels(folder / ranks / f"rich.{product}") for ranks in ("two", "alone"))
        assert expected.any() and np.abs(found - expected).max() <= ERRORS_AGREE * expected.max()
    assert alone["whole"]["wild"] == [700] and len(alone["hard"]["bounds"]) == 3
    assert 0 < alone["whole"]["averages"] < alone["whole"]["visibilities"] / 5 and 0 < alone["rich"]["averages"]
    assert alone["whole"]["stopcode"] == ITERATION_LIMIT


@mpi
def test_an_error_of_all_is_raised_by_all_and_the_job_goes_on(two):
    said = two[1][1]
    assert sorted(said) == [0, 1]
    assert all(found["error"].startswith("FileExistsError: imagename") for found in said.values())


@mpi
def test_a_run_stopped_on_two_ranks_goes_on_on_three_to_the_same_image(two, three, alone, folder):
    stopped, resumed = two[1][3], three[1][0]
    assert [stopped[rank]["stopcode"] for rank in range(2)] == [STOPPED_BY_USER] * 2
    assert resumed[0]["resumed"] == [stopped[0]["iterdone"]] and stopped[0]["iterdone"] == mpi_steps.WHEN
    _same_findings(resumed, alone["whole"], 3)
    _same_images(folder / "two" / "stopped", folder / "alone" / "whole")


@mpi
@pytest.mark.slow
def test_a_mosaic_on_two_and_three_ranks(tmp_path):
    """As of one process: beams, weights, averages, images and errors; stopped on two ranks, it goes on on three."""
    sky = [(1.0, 0.0, 0.0), (0.5, 20 * ARCSEC, 10 * ARCSEC)]
    vis = simulate_mosaic(tmp_path / "mosaic.ms", [(0, 0), (25, 0), (0, 25)], sky, dishes=(12.0,) * 5 + (7.0,) * 3,
                          noise=0.1, rounds=2, hours=2.0, spws=(("100GHz", "20MHz", 6), ("104GHz", "20MHz", 2)))
    common = dict(vis=vis, imsize=[120, 108], cell="1.2arcsec", gridder="mosaic", datacolumn="data", niter=40,
                  phasecenter=f"J2000 {CENTRE[0]}deg {CENTRE[1]}deg", wavelets=["dirac", "db2"], weighting="briggs",
                  ndraws=2, nthreads=1, blocks=3)
    names = {name: str(tmp_path / f"mosaic_{name}") for name in ("alone", "two", "stopped")}
    expected = mpi_steps.run(imagename=names["alone"], **common)
    shared = dict(common, parallel=True)
    done, said = _mpirun(2, [["run", dict(shared, imagename=names["two"])],
                             ["stopped", dict(shared, imagename=names["stopped"])]], tmp_path)
    assert done.returncode == 0, done.stderr
    _same_findings(said[0], expected, 2)
    done, resumed = _mpirun(3, [["run", dict(shared, imagename=names["stopped"], restart=True)]], tmp_path)
    assert done.returncode == 0, done.stderr
    assert resumed[0][0]["resumed"] == [mpi_steps.WHEN] and 0 < expected["averages"] < expected["visibilities"] / 2
    _same_findings(resumed[0], expected | dict(resumed=[mpi_steps.WHEN]), 3)
    for name in ("two", "stopped"):
        _same_images(names[name], names["alone"], ("model", "psf", "weight", "pb"))
        found, errors = (pixels(f"{names[which]}.model.error") for which in (name, "alone"))
        assert errors.any() and np.abs(found - errors).max() <= ERRORS_AGREE * errors.max()


@mpi
def test_a_rank_that_is_killed_ends_the_job(three):
    done, said = three
    assert done.returncode != 0
    assert not said[2]  # nothing came after


@mpi
def test_four_ranks_and_the_error_of_one(vis, folder, alone):
    """The error of one rank is raised by all, each of which could still write, and the job ends."""
    runs = _runs(vis, folder / "four", parallel=True)
    failing = dict(runs["whole"], imagename=str(folder / "four" / "failing"))
    done, said = _mpirun(4, [["run", runs["whole"]], ["failing", failing]], folder)
    _same_findings(said[0], alone["whole"], 4)
    _same_images(folder / "four" / "whole", folder / "alone" / "whole")
    assert sorted(said[1]) == [0, 1, 2, 3]
    assert all(found["error"] == "ArithmeticError: rank 1 has had enough" for found in said[1].values())
    assert done.returncode != 0
    assert not [path for path in (folder / "four").iterdir() if path.name.startswith(("failing", ".failing"))]


def test_without_mpi_the_error_says_what_to_install_and_how_to_start(vis, monkeypatch):
    for name in LAUNCHED:
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ValueError, match=r"parallel = True.*mpirun -n 4 .*pip install 'casa_sara\[mpi\]'"):
        tsara(vis=vis, imagename="x", parallel=True, **GRID)


class _Ranks(Serial):
    """A communicator by its size alone."""

    def __init__(self, size, rank=0):
        self.size, self.rank = size, rank


@pytest.mark.parametrize("size", [2, 3, 5, 16])
@pytest.mark.parametrize("samples", [100, 10_000_000])
def test_work_is_shared_whole_and_evenly(size, samples):
    options, grid = SolverOptions(), ImageGrid((2048, 2048), (1e-6, 1e-6))
    ranks = assign_ranks(_Ranks(size), DataVolume(samples, (1e5, 1e5)), grid, options)
    readers = [ranks.reader(rank) for rank in range(size)]
    assert [number for number in readers if number is not None] == list(range(ranks.readers)) and readers[0] == 0
    assert len(ranks.owners) == len(options.wavelets) and set(ranks.owners) <= set(range(size))
    # many visibilities spread over many ranks; few are not worth a second Fourier transform
    assert ranks.readers == 1 if samples == 100 else ranks.readers > size // 2


def test_averages_are_counted_where_visibilities_are_averaged():
    """For an image of few pixels a second reader would have nothing to do."""
    volume, grid = DataVolume(1_000_000, (1e5, 1e5)), ImageGrid((512, 512), (1e-6, 1e-6))
    every, few = (assign_ranks(_Ranks(8), volume, grid, SolverOptions(averaging=averaging)).readers
                  for averaging in (False, True))
    assert few < every
    assert solver_samples(volume, grid, SolverOptions()) == 512**2
    assert solver_samples(replace(volume, samples=1000), grid, SolverOptions()) == 500
    for options in (SolverOptions(averaging=False), SolverOptions(method="dabbech2018")):
        assert solver_samples(volume, grid, options) == 1_000_000


def test_what_does_not_fit_is_spread_further():
    options, grid, volume = SolverOptions(), ImageGrid((2048, 2048), (1e-6, 1e-6)), DataVolume(100, (1e5, 1e5))
    assert assign_ranks(_Ranks(4), volume, grid, options, lambda ranks: ranks.readers >= 3).readers == 3
