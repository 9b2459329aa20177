"""Checkpoints: read to the last bit as written, or refused; and a solution goes on as if never stopped."""

import errno
import hashlib
import io
import json
import os
import pickle
import resource
import signal
import struct

import numpy as np
import pytest
from dense_problem import Problem
from test_visibilities import observation

from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction import checkpoint as module
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.reconstruction.state_file import MAGIC, CheckpointError, read, write
from casa_sara.runtime.signals import stop_on_interrupt
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.record import CONVERGED, STOPPED_BY_USER, UNFEASIBLE
from casa_sara.solver.reweighting import Schedule, Stage, run_algorithm_2

HEADER = dict(version="1", parameters=dict(cell=[0.1, 0.1], niter=5), data={}, iteration=3, written=0.0)


def state():
    rng = np.random.default_rng(1)
    return dict(
        ppd=dict(model=rng.normal(size=(3, 4)).astype(np.float32), dual=rng.normal(size=5) + 1j * rng.normal(size=5),
                 bounds=np.array([np.nan, -np.inf, 5e-324]), threshold=0.1 + 0.2, l2_bounds=None),
        stage=dict(last=True, wanted=np.array([[True, False]]), nothing=np.zeros((), bool), empty=np.zeros(0, int),
                   record=dict(rel_change=[np.inf, 1 / 3], bounds=[(0, [1.5])], updates=[dict(released=np.int64(3))])))


# the file

def test_a_state_comes_back_to_the_last_bit(tmp_path):
    path = str(tmp_path / "c")
    write(path, HEADER, state())
    header, found = read(path)
    assert header == HEADER and os.listdir(tmp_path) == ["c"]
    wanted = state()
    for name in ("model", "dual", "bounds"):
        assert found["ppd"][name].dtype == wanted["ppd"][name].dtype
        assert found["ppd"][name].tobytes() == wanted["ppd"][name].tobytes(), name
    assert (found["ppd"]["threshold"], found["ppd"]["l2_bounds"], found["stage"]["last"]) == (0.1 + 0.2, None, True)
    assert [found["stage"][name].shape for name in ("wanted", "nothing", "empty")] == [(1, 2), (), (0,)]
    assert found["stage"]["record"] == dict(rel_change=[np.inf, 1 / 3], bounds=[[0, [1.5]]], updates=[dict(released=3)])


def test_one_wrong_bit_anywhere_is_noticed(tmp_path):
    path = tmp_path / "c"
    write(str(path), HEADER, state())
    good, rng = path.read_bytes(), np.random.default_rng(2)
    for place in range(0, len(good), 3):
        bad = bytearray(good)
        bad[place] ^= 1 << rng.integers(8)
        path.write_bytes(bad)
        with pytest.raises(CheckpointError, match="no checkpoint|damaged"):
            read(str(path))


def test_a_file_too_short_or_too_long_is_noticed(tmp_path):
    path = tmp_path / "c"
    write(str(path), HEADER, state())
    good = path.read_bytes()
    for length in [*range(0, len(good), 7), len(good) - 1]:
        path.write_bytes(good[:length])
        with pytest.raises(CheckpointError, match="truncated"):
            read(str(path))
    path.write_bytes(good + b"\0")
    with pytest.raises(CheckpointError, match="more bytes"):
        read(str(path))
    os.unlink(path)
    os.mkfifo(path)  # nobody will ever write into it
    with pytest.raises(CheckpointError, match="no checkpoint"):
        read(str(path))


class Payload:
    """Unpickled, it makes a file."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return open, (self.path, "w")


def forged(header):
    """A file with right checksums around any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    begin = MAGIC + struct.pack("<Q", len(text)) + text
    return begin + hashlib.sha256(begin).digest()


def test_a_hostile_file_is_refused_and_nothing_executed(tmp_path):
    trap, path = str(tmp_path / "trap"), tmp_path / "c"
    poison = pickle.dumps(Payload(trap))
    pickle.loads(poison).close()
    assert os.path.exists(trap)  # the payload works
    os.unlink(trap)
    archive = io.BytesIO()
    np.savez(archive, model=np.array([Payload(trap)], object))
    entry = dict(name="model", dtype="|O", shape=[len(poison) // 8], sha256=hashlib.sha256(poison).hexdigest())
    hostile = [poison, archive.getvalue(), b"\0" * 1000, forged(dict(state={}, arrays=[entry])) + poison,
               forged(poison)]
    for change in (dict(dtype="O"), dict(dtype="f4,O"), dict(dtype="__import__('os')"),
                   dict(dtype="<f4", shape=[2**62, 4]),
                   dict(dtype="<f4", shape=[-1, -4]), dict(dtype="<f4", shape="ab"), dict(dtype=["<f4"]),
                   dict(dtype="<f4", shape=[1], name="__class__/__init__")):
        hostile.append(forged(dict(state={}, arrays=[entry | change])) + poison)
    hostile += [forged(b"[" * 100_000), forged(b"null"), forged(b"[]"), forged(b"{}"),
                forged(b'{"state": 3, "arrays": 4}'),
                MAGIC + struct.pack("<Q", 2**63) + b"\0" * 64]
    for content in hostile:
        path.write_bytes(content)
        with pytest.raises(CheckpointError):
            read(str(path))
    assert not os.path.exists(trap)


def test_what_cannot_be_written_is_told_and_the_old_one_stays(tmp_path):
    path, lines = str(tmp_path / "c"), []
    checkpoint = Checkpoint(path, "1", {}, warn=lines.append)
    checkpoint.keep(state, 1, now=True)
    before, limits = (tmp_path / "c").read_bytes(), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (600, limits[1]))  # a file that cannot grow, as on a full disk
    try:
        checkpoint.keep(state, 2, now=True)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert "iteration 2 could not be written" in lines[0] and os.strerror(errno.EFBIG) in lines[0]
    assert (tmp_path / "c").read_bytes() == before and os.listdir(tmp_path) == ["c"]
    checkpoint.remove()
    checkpoint.remove()
    assert os.listdir(tmp_path) == []


def test_writing_takes_less_than_two_per_cent(tmp_path, monkeypatch):
    """A clock of our own: an iteration takes 1 s, and a checkpoint as long as said."""
    clock, checkpoint = [0.0], Checkpoint(str(tmp_path / "c"), "1", {})
    monkeypatch.setattr(module.time, "monotonic", lambda: clock[0])

    def spent(cost, seconds):
        written = []
        monkeypatch.setattr(module, "write", lambda *args: written.append(clock.__setitem__(0, clock[0] + cost)))
        monkeypatch.setattr(module.os.path, "getsize", lambda path: 0)
        end = clock[0] + seconds
        while clock[0] < end:
            clock[0] += 1
            checkpoint.keep(state, 1)
        return len(written)

    checkpoint.identify()
    assert spent(0.1, 3600) in (58, 59, 60)  # one a minute: no more than a minute is lost
    assert 3600 / 600 <= spent(9.0, 3600) <= 0.02 * 3600 / 9.0  # large images: ten minutes, and 2 %
    monkeypatch.undo()


# whose it is

def opened(path, version="1", parameters=HEADER["parameters"]):
    checkpoint = Checkpoint(path, version, parameters)
    checkpoint.open()
    return checkpoint


def test_a_checkpoint_of_something_else_is_refused_with_the_difference(tmp_path):
    path, data = str(tmp_path / "c"), dict(visibilities=np.arange(3.0), noise=None)
    checkpoint = Checkpoint(path, "1", HEADER["parameters"])
    checkpoint.identify(**data)
    checkpoint.keep(state, 3, now=True)
    opened(path).identify(**data)
    for change, message in [
        (dict(version="2"), "another version of casa_sara: 1, and this is 2"),
        (dict(parameters=dict(cell=(0.1, 0.1), niter=6)),
         "other parameters: niter was 5 and is 6.*Use the same data and parameters"),
        (dict(parameters=dict(cell=(0.1, 0.1), niter=5, regscale=2.0)), "regscale was None and is 2.0"),
    ]:
        with pytest.raises(CheckpointError, match=f"restart = True: '{path}' cannot be continued.*{message}"):
            opened(path, **change)
    with pytest.raises(CheckpointError, match="other data: visibilities differ"):
        opened(path).identify(visibilities=np.array([0, 1, 2.5]), noise=None)
    with pytest.raises(CheckpointError, match="other data: noise differ"):
        opened(path).identify(visibilities=np.arange(3.0), noise=np.ones(1))
    for wrong in ({}, dict(version="1"), dict(version="1", parameters=7), HEADER | dict(data=3)):
        write(path, wrong, state())
        with pytest.raises(CheckpointError, match="cannot be continued"):
            opened(path).identify(**data)


# the solution

def solution(problem, adaptive):
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                      problem.data_norm_sq(problem.precond))
    weights = np.abs(problem.measurement.matrix[:, 0]) ** 2
    common = dict(samples=np.diff(problem.offsets), weight_sums=np.add.reduceat(weights, problem.offsets[:-1]),
                  n_bases=3)
    if adaptive:
        return ppd, AdaptiveBounds(3 * problem.errors, **common)
    return ppd, GivenBounds(1.02 * problem.errors, **common)


def solved(problem, adaptive, path, interrupt_at):
    """Solve, interrupted after these iterations: each time everything goes through a file into new objects."""
    schedule, start = Schedule(nreweights=8, reweight_tol=1e-5, reltol=1e-5, final_reltol=1e-5), None
    for last in (*interrupt_at, None):
        ppd, bounds = solution(problem, adaptive)
        if start is None:
            ppd.rescale(0.2)
        else:
            ppd.set_state(start["ppd"])
            bounds.set_state(start["bounds"])
            for one, kept in ((ppd, start["ppd"]), (bounds, start["bounds"])):
                assert one.state().keys() == kept.keys()
                assert all(np.array_equal(value, kept[name]) for name, value in one.state().items())
            start = Stage.of(start["stage"])

        def keep(stage, now):
            if now:
                write(path, {}, dict(ppd=ppd.state(), bounds=bounds.state(), stage=stage.state()))

        record = run_algorithm_2(ppd, bounds, schedule, stopped=lambda: ppd.iteration == last, keep=keep, stage=start)
        assert record.stop_code == STOPPED_BY_USER if last else record.stop_code != STOPPED_BY_USER
        start = read(path)[1] if last else None
    return ppd.model, record


def assert_same(found, wanted, resumed):
    np.testing.assert_array_equal(found[0], wanted[0])
    assert found[1].resumed == resumed
    found, wanted = (json.dumps(one[1].state() | dict(resumed=[])) for one in (found, wanted))
    assert found == wanted


@pytest.mark.parametrize("adaptive", [True, False])
def test_an_interrupted_solution_ends_at_the_same_image(tmp_path, adaptive):
    path = str(tmp_path / "c")
    problem = Problem(seed=9, samples=(300, 300), noise=(0.4, 2.0))
    wanted = solved(problem, adaptive, path, ())
    updates = [update["iteration"] for update in wanted[1].reweightings]
    end = wanted[1].iteration[-1]
    assert wanted[1].stop_code == CONVERGED and len(updates) == 8
    # around the re-weightings (at their very iteration the interruption waits for the next), and late in the last
    around = [update + step for update in updates for step in (-1, 1, 7)]
    moments = sorted({1, 2, *around, *range(updates[-1] + 20, end, 50), end - 1} - {*updates, end, end + 1, end + 7})
    assert_same(solved(problem, adaptive, path, moments), wanted, moments)
    for one in np.random.default_rng(3).choice(moments, 4, replace=False):
        assert_same(solved(problem, adaptive, path, [int(one)]), wanted, [int(one)])


def test_patience_with_bounds_that_cannot_be_met_goes_on(tmp_path):
    problem, path = Problem(seed=14, samples=(20, 30), noise=(1.0, 1.0)), str(tmp_path / "c")
    problem.errors = 0.01 * problem.errors
    wanted = solved(problem, False, path, ())
    end = wanted[1].iteration[-1]
    assert wanted[1].stop_code == UNFEASIBLE
    assert_same(solved(problem, False, path, [end - 150]), wanted, [end - 150])


GRID = ImageGrid((40, 48), (1e-6, 1e-6))
OPTIONS = SolverOptions(wavelets=("dirac", "db1", "db3"), wavelevels=2, nreweights=12)


@pytest.fixture(scope="module")
def sky():
    """Two sources, one between pixels, 2 % gain errors and two wild samples, in two blocks."""
    data = observation([(0, 0, 0, 0, 120), (0, 0, 1, 1e4, 120)], channels=2, seed=5)
    rng = np.random.default_rng(6)
    data.uvw *= 8e4
    l, m = -(np.array([12, 30.5]) - 20) * 1e-6, (np.array([20, 30.5]) - 24) * 1e-6
    data.vis[:] = 3 * np.exp(2j * np.pi * (data.uvw[0] * l[0] + data.uvw[1] * m[0]))
    data.vis += 2 * np.exp(2j * np.pi * (data.uvw[0] * l[1] + data.uvw[1] * m[1]))
    data.vis *= 1 + 0.02 * rng.standard_normal(data.rows.time.size)[data.row]
    data.vis += 0.01 * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    data.weight[:] = 1e4
    data, offsets = sort_into_blocks(data, data.rows.scan[data.row])
    data.vis[[100, 3000]] = 1e3
    return data, offsets


def image(sky, path="", stop_at=None, **changes):
    data, offsets = (changes.get(name, value) for name, value in zip(("data", "offsets"), sky))
    checkpoint = None
    if path:
        checkpoint = Checkpoint(str(path), "1", {})
        if os.path.exists(path):
            checkpoint.open()
    reached = [0]
    samples = Samples(data, offsets, np.ones(data.size), changes.get("noise", np.array([1.0, np.nan])))
    return reconstruct(samples, GRID, OPTIONS, control=Control(
        lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))


def test_a_reconstruction_goes_on_with_all_that_was_found(sky, tmp_path, monkeypatch):
    wanted = image(sky)
    assert len(wanted.wild) == 2 and wanted.record.stop_code == CONVERGED
    assert sum(update["released"] for update in wanted.record.reweightings) > 0  # the whole machinery is at work
    path = tmp_path / "c"
    stopped = image(sky, path, 37)
    assert stopped.record.stop_code == STOPPED_BY_USER and stopped.record.iteration[-1] == 37
    monkeypatch.setattr("casa_sara.reconstruction.problem.nnls", None)  # not needed any more
    updates = [update["iteration"] for update in wanted.record.reweightings]
    releases = np.flatnonzero([update["released"] for update in wanted.record.reweightings])
    middle = updates[releases[0] - 1] + 5  # pixels have asked once to be released
    last = updates[-1] + 5  # they are, and errors shared
    assert image(sky, path, middle).record.resumed == [37]
    assert image(sky, path, last).record.resumed == [37, middle]
    found = image(sky, path)
    assert_same((found.model, found.record), (wanted.model, wanted.record), [37, middle, last])
    for name in ("l2_bounds", "residual_norms", "nnls_norms", "kept"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
    for name in ("wild", "threshold", "data_norm_sq", "noise_jy_per_beam"):
        assert getattr(found, name) == getattr(wanted, name)


def test_a_reconstruction_of_other_data_is_refused(sky, tmp_path):
    path, (data, offsets) = tmp_path / "c", sky
    image(sky, path, 3)
    before = path.read_bytes()
    for name, change in [("visibilities", "vis"), ("weights", "weight"), ("uvw", "uvw"),
                         ("blocks", dict(offsets=offsets + [0, 1, 0])), ("noise", dict(noise=np.array([1.0, 2.0])))]:
        if isinstance(change, str):
            other = data.take(np.arange(data.size))
            getattr(other, change)[..., 7] *= 1.0001
            change = dict(data=other)
        with pytest.raises(CheckpointError, match=f"other data: {name} differ"):
            image(sky, path, **change)
    assert path.read_bytes() == before


def test_a_state_that_does_not_fit_is_refused(sky, tmp_path):
    path = tmp_path / "c"
    image(sky, path, 3)
    header, right = read(str(path))
    for room, name, value in [("ppd", "model", np.zeros((48, 40), np.float32)),
                              ("ppd", "l2_dual", np.zeros(3, complex)),
                              ("found", "left_out", "all"), ("stage", "record", {}), ("bounds", "l2_bounds", None)]:
        wrong = right | {room: {key: entry for key, entry in right[room].items() if key != name or value is not None}}
        if value is not None:
            wrong[room][name] = value
        write(str(path), header, wrong)
        with pytest.raises(CheckpointError, match="its state does not fit"):
            image(sky, path)


# signals

def test_the_first_signal_is_a_request_and_the_second_is_not():
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]
    with pytest.raises(KeyboardInterrupt), stop_on_interrupt() as stopped:
        assert not stopped()
        signal.raise_signal(signal.SIGTERM)
        assert stopped()
        signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)] == before


def test_before_anyone_asks_signals_act_at_once():
    with pytest.raises(KeyboardInterrupt), stop_on_interrupt():
        signal.raise_signal(signal.SIGINT)
