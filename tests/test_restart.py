"""Killed, stopped and restarted: the task ends at the same image, and refuses what it cannot go on from."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from simulated_ms import edit, pixels, simulate
from test_tsara import SKY, _hashes

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.runtime import log
from casa_sara.reconstruction import checkpoint as checkpoints
from casa_sara.runtime import jsonfile
from casa_sara.solver.record import CONVERGED, STOPPED_BY_USER

GRID = dict(imsize=64, cell="1arcsec", datacolumn="data", nthreads=1, wavelets=["dirac", "db1", "db4"])
PRODUCTS = ("model", "psf", "residual", "image", "sumwt", "pb")
RNG = np.random.default_rng(20)
KILLED = {
    # before there is any checkpoint
    "reading": ("read", 1),
    "norm": ("norm", 1),
    "early": ("iteration", 1),
    "middle": ("iteration", int(RNG.integers(2, 60))),
    "updates": ("iteration", 91),  # the second re-weighting is just done
    "late": ("iteration", int(RNG.integers(120, 250))),
    "writing": ("checkpoint", int(RNG.integers(20, 80))),
    "product": ("product", 1),
}
TOO_EARLY = ("reading", "norm", "early")
STOPPED = {"interrupted": signal.SIGINT, "terminated": signal.SIGTERM}
# Runs that signal themselves at a certain moment: the Nth iteration, checkpoint (written, not yet in place) or product.
# CASA is imported once, and every run is a process forked from there.
SCRIPT = """
import json, os, sys
import casatasks
from casa_sara import tsara
from casa_sara.imaging import continuum
from casa_sara.reconstruction import problem
from casa_sara.casa.images import products
from casa_sara.casa.runtime import log
from casa_sara.private import task_tsara
from casa_sara.reconstruction import checkpoint

def run(folder, parameters, place, moment, number):
    count = 0

    def at(here):
        nonlocal count
        count += here == place
        if here == place and count == moment:
            os.kill(os.getpid(), number)

    class Progress(log.Progress):
        def __call__(self, *args):
            at("iteration")

    def watched(function, here):
        return lambda *args, **more: (at(here), function(*args, **more))[1]

    checkpoint.INTERVAL = checkpoint.PATIENCE = 0  # one after every iteration
    log.Progress = Progress
    continuum.read_visibilities = watched(continuum.read_visibilities, "read")
    problem.power_method = watched(problem.power_method, "norm")
    os.replace = watched(os.replace, "checkpoint")
    products.sync = watched(products.sync, "product")  # written, not yet in place
    os.chdir(folder)
    result = tsara(**parameters)
    print("STOPPED WITH", result["stopcode"], result["iterdone"], flush=True)

children = []
for case in json.load(sys.stdin):
    children.append(os.fork())
    if children[-1] == 0:
        try:
            os.dup2(os.open(case[0] + ".output", os.O_WRONLY | os.O_CREAT), 1)
            run(*case)
        finally:
            os._exit(0)
print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children]))
"""


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=12, sky=SKY, noise=0.05,
                    scans=2,
                    integration=20.0, spacing_seconds=5400.0, hour_angle=-2.5, seed=4)


@pytest.fixture(scope="module")
def uninterrupted(vis, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("whole") / "source")
    return tsara(vis=vis, imagename=name, **GRID), name


@pytest.fixture(scope="module")
def ended(vis, tmp_path_factory):
    """All the runs that were killed or stopped, side by side: folder, exit status and output of each."""
    moments = KILLED | {name: ("iteration", 77) for name in STOPPED}
    folders = [tmp_path_factory.mktemp(name) for name in moments]
    cases = [[str(folder), dict(vis=vis, imagename=str(folder / "source"), **GRID), place, moment,
              int(STOPPED.get(name, signal.SIGKILL))]
             for folder, (name, (place, moment)) in zip(folders, moments.items())]
    done = subprocess.run([sys.executable, "-c", SCRIPT], input=json.dumps(cases), text=True, capture_output=True,
                          timeout=300, cwd=folders[0].parent, env=os.environ | {"OMP_NUM_THREADS": "1"}, check=True)
    statuses = json.loads(done.stdout.splitlines()[-1])
    return {name: (folder, status, Path(f"{folder}.output").read_text() + done.stderr)
            for name, folder, status in zip(moments, folders, statuses)}


def names_in(folder):
    return {path.name for path in Path(folder).iterdir() if not path.name.endswith((".log", ".last"))}


def assert_the_same(uninterrupted, name, result):
    for product in PRODUCTS:
        np.testing.assert_array_equal(pixels(f"{name}.{product}"), pixels(f"{uninterrupted[1]}.{product}"))
    assert {key: result[key] for key in ("iterdone", "stopcode", "nmajordone")} == \
        {key: uninterrupted[0][key] for key in ("iterdone", "stopcode", "nmajordone")}
    histories = [jsonfile.load(f"{root}.sara.json")["history"] for root in (name, uninterrupted[1])]
    assert histories[0] == histories[1]
    assert names_in(Path(name).parent) == {"source.sara.json", *(f"source.{product}" for product in PRODUCTS)}


@pytest.mark.parametrize("moment", KILLED)
def test_killed_at_any_moment_it_goes_on_to_the_same_image(uninterrupted, ended, vis, moment):
    folder, status, output = ended[moment]
    assert status == -signal.SIGKILL, output
    place, count = KILLED[moment]
    # a killed run's lock locks nothing
    left = {"source.lock"} | (set() if moment in TOO_EARLY else {"source.checkpoint"})
    left |= {"source.checkpoint.new"} if place == "checkpoint" else set()
    assert names_in(folder) - left == set() or place == "product"
    assert left <= names_in(folder)
    result = tsara(vis=vis, imagename=str(folder / "source"), restart=True, **GRID)
    # the image of an iteration that ends a problem is the next problem's: 89
    expected = {"product": [uninterrupted[0]["iterdone"] - 1], "writing": [count - 1], "updates": [89]}
    expected |= dict.fromkeys(TOO_EARLY, [])
    assert result["sara"]["resumed"] == expected.get(moment, [count - 1])
    assert_the_same(uninterrupted, str(folder / "source"), result)


@pytest.mark.parametrize("moment", STOPPED)
def test_a_signal_delivers_the_best_image_and_a_checkpoint(uninterrupted, ended, vis, moment):
    folder, status, output = ended[moment]
    assert status == 0 and f"STOPPED WITH {STOPPED_BY_USER} 77" in output, output
    assert names_in(folder) == {"source.checkpoint", "source.sara.json", *(f"source.{product}" for product in PRODUCTS)}
    model = pixels(str(folder / "source.model"))
    whole = pixels(uninterrupted[1] + ".model")
    x, y = np.unravel_index(np.argmax(whole), whole.shape)
    near = np.s_[x - 3 : x + 4, y - 3 : y + 4]  # so early the support holds the brightest sources only
    assert model[near].sum() > 0.5 * whole[near].sum() > 0.3
    assert 0 < np.linalg.norm(model - whole) < 0.5 * np.linalg.norm(whole)
    with pytest.raises(FileExistsError, match="source.checkpoint'.*restart = True.*overwrite = True"):
        tsara(vis=vis, imagename=str(folder / "source"), **GRID)
    result = tsara(vis=vis, imagename=str(folder / "source"), restart=True, **GRID)
    assert result["sara"]["resumed"] == [77]
    assert_the_same(uninterrupted, str(folder / "source"), result)


# in this process

class Signalling(log.Progress):
    """Sends signals at an iteration."""

    iteration, signals = 12, (signal.SIGINT,)

    def __call__(self, iteration, message, fraction=None):
        if iteration == self.iteration:
            for number in self.signals:
                signal.raise_signal(number)


@pytest.fixture
def stopped(vis, tmp_path, monkeypatch):
    """Imagename of a run stopped at iteration 12, after which nothing signals any more."""
    name = str(tmp_path / "source")
    with monkeypatch.context() as patched:
        patched.setattr(log, "Progress", Signalling)
        assert tsara(vis=vis, imagename=name, **GRID)["stopcode"] == STOPPED_BY_USER
    return name


def test_what_does_not_belong_is_refused_and_nothing_touched(vis, stopped, uninterrupted, tmp_path_factory,
                                                             monkeypatch):
    path = Path(stopped + ".checkpoint")
    good = path.read_bytes()
    before = _hashes(path.parent)

    def refused(message, **changes):
        with pytest.raises(ValueError, match=f"restart = True: .*source.checkpoint.*{message}"):
            tsara(**(dict(vis=vis, imagename=stopped, restart=True, overwrite=True) | GRID | changes))

    refused("imsize was .64, 64. and is .80, 80.", imsize=80)
    refused("regscale was 1.0 and is 2.0", regscale=2.0)
    refused("blocks was 0 and is 3", blocks=3)
    refused("scan was '' and is '1'", scan="1")
    refused("startmodel was '' and is 'other.model'", startmodel="other.model")
    refused("niter was 100000 and is 0", niter=0)
    other = str(tmp_path_factory.mktemp("other") / "c.ms")
    shutil.copytree(vis, other)
    edit(other, "DATA", lambda data: data + (np.arange(data.shape[-1]) == 5) * np.complex64(0.01))
    refused("other data: visibilities", vis=other)
    with monkeypatch.context() as patched:
        patched.setattr("casa_sara.imaging.run_solver.__version__", "9.9")
        refused("another version of casa_sara: .* and this is 9.9")
    assert _hashes(path.parent) == before
    for bad in (good[:-1], good[:5000], good[:-20] + bytes([good[-20] ^ 4]) + good[-19:], b""):
        path.write_bytes(bad)
        refused("cannot be continued: it is (truncated|damaged|no checkpoint)")
        assert path.read_bytes() == bad
    path.write_bytes(good)
    assert _hashes(path.parent) == before
    # neither the name of the data nor the threads, weighting and restoration are decided by then
    moved = str(tmp_path_factory.mktemp("moved") / "renamed.ms")
    shutil.copytree(vis, moved)
    result = tsara(**(GRID | dict(vis=moved, imagename=stopped, restart=True, nthreads=2, weighting="uniform")))
    assert result["sara"]["resumed"] == [12] and not path.exists()
    wanted = pixels(uninterrupted[1] + ".model")
    np.testing.assert_allclose(pixels(stopped + ".model"), wanted, rtol=0, atol=1e-6 * wanted.max())


def test_a_second_ctrl_c_aborts_at_once(vis, tmp_path, monkeypatch):
    monkeypatch.setattr(log, "Progress", type("Twice", (Signalling,), dict(signals=(signal.SIGINT, signal.SIGINT))))
    with pytest.raises(KeyboardInterrupt):
        tsara(vis=vis, imagename=str(tmp_path / "source"), **GRID)
    assert names_in(tmp_path) == set()


def test_ctrl_c_before_the_first_iteration_leaves_everything(stopped, vis, monkeypatch):
    before = _hashes(Path(stopped).parent)
    monkeypatch.setattr("casa_sara.reconstruction.problem.nnls", lambda *args,
                        **more: signal.raise_signal(signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        tsara(vis=vis, imagename=stopped, overwrite=True, **GRID)
    assert _hashes(Path(stopped).parent) == before


def test_overwriting_keeps_the_checkpoint_until_there_is_something_better(stopped, vis, monkeypatch):
    path = Path(stopped + ".checkpoint")
    old = path.read_bytes()
    kept = []

    class Watching(Signalling):
        def __call__(self, iteration, message, fraction=None):
            kept.append(path.read_bytes() == old)
            if iteration == 5:
                monkeypatch.setattr(checkpoints.Checkpoint, "keep", keep_now)

    keep = checkpoints.Checkpoint.keep
    keep_now = lambda self, make_state, iteration, now: keep(self, make_state, iteration, True)
    monkeypatch.setattr(log, "Progress", Watching)
    result = tsara(vis=vis, imagename=stopped, overwrite=True, niter=8, **GRID)
    assert result["sara"]["resumed"] == [] and kept == [True] * 5 + [False] * 3
    assert not path.exists()


def test_restart_with_nothing_to_go_on_from_begins(vis, tmp_path, uninterrupted):
    lines = []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(log, "info", lines.append)
        result = tsara(vis=vis, imagename=str(tmp_path / "source"), restart=True, **GRID)
    assert any("neither" in line and "starting from the beginning" in line for line in lines)
    assert result["sara"]["resumed"] == [] and result["stopcode"] == CONVERGED
    assert_the_same(uninterrupted, str(tmp_path / "source"), result)
    # and with a model only, it is continued
    again = tsara(vis=vis, imagename=str(tmp_path / "source"), restart=True, niter=3, **GRID)
    assert again["iterdone"] == 3 and again["sara"]["resumed"] == []
