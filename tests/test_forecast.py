"""What a run says before it begins, and the limits of memory and time."""

import os

import numpy as np
import pytest
from simulated_ms import edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.ms.data_volume import measure_volume
from casa_sara.casa.runtime.quantities import seconds
from casa_sara.imaging.memory_forecast import Workload, forecast
from casa_sara.imaging.time_forecast import Pace
from casa_sara.operators._workers import Workers
from casa_sara.options import Selection
from casa_sara.runtime import machine
from casa_sara.runtime.deadline import Deadline
from casa_sara.solver.nnls import nnls
from casa_sara.solver.record import CONVERGED, TIME_LIMIT

GRID = dict(imsize=128, cell="0.5arcsec", datacolumn="data", nthreads=1)
WORK = Workload(1_000_000, (1e6, 9e5), (2048, 1024), (2e-7, 2e-7), 9, 4, 1000, 1)


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=12, noise=0.05, scans=3,
                    integration=20.0, autocorrelations=True, seed=4)


def test_dry_run_says_what_it_takes_and_writes_nothing(vis, tmp_path):
    said = tsara(vis=vis, imagename=str(tmp_path / "never"), dryrun=True, **GRID)["forecast"]
    assert os.listdir(tmp_path) == []
    parts = said["memory_bytes"]["iterating"]
    assert parts["wavelet duals and weights"] == 2 * 9 * 128 * 128 * 4
    assert said["fits"] and said["peak_bytes"] == said["held_before_bytes"] + max(
        sum(phase.values()) for phase in said["memory_bytes"].values())
    times = said["seconds"]
    assert 0 < times["pair"] < 1.5 * times["iteration"] and times["nnls_iteration"] > 0.5 * times["pair"]
    assert times["total"] > times["iteration"] * said["iterations"]


def test_dry_run_of_dirty_images_and_existing_images(vis, tmp_path):
    (tmp_path / "old.model").mkdir()
    said = tsara(vis=vis, imagename=str(tmp_path / "old"), dryrun=True, niter=0, **GRID)["forecast"]
    assert said["iterations"] == 0 and "iterating" not in said["memory_bytes"]
    assert os.listdir(tmp_path) == ["old.model"]


def test_run_that_does_not_fit_is_refused_with_what_would(vis, tmp_path, monkeypatch):
    """4000² pixels take 1.9 GB; nothing of it is allocated before the refusal."""
    from casa_sara.imaging import dry_run

    monkeypatch.setattr(dry_run, "available_memory", lambda: 10**9)
    grid = GRID | dict(imsize=4000, cell="0.5arcsec")
    held = machine.resident_memory()
    with pytest.raises(MemoryError,
                       match=r"imsize = \[4000, 4000\].*wavelet duals.*the memory available.*imsize up to"):
        tsara(vis=vis, imagename=str(tmp_path / "huge"), **grid)
    assert machine.resident_memory() - held < 10**8 and os.listdir(tmp_path) == []
    dry = tsara(vis=vis, imagename=str(tmp_path / "huge"), dryrun=True, **grid)["forecast"]
    assert not dry["fits"] and "imsize up to" in dry["reason"]


def test_maxmem_is_named_where_it_refuses(vis, tmp_path):
    with pytest.raises(MemoryError, match="maxmem = 0.1 GB allows 0.10 GB"):
        tsara(vis=vis, imagename=str(tmp_path / "small"), maxmem=0.1, **GRID)
    with pytest.raises(ValueError, match="maxmem"):
        tsara(vis=vis, imagename=str(tmp_path / "small"), maxmem=-1.0, **GRID)


def test_what_is_said_to_fit_does():
    """The image proposed fits, and one 5 % larger does not."""
    import re

    found = forecast(WORK, 300_000_000, 400_000_000)
    with pytest.raises(MemoryError) as refusal:
        found.require(0.0)
    nx, ny, samples = map(int,
                          re.search(r"imsize up to \[(\d+), (\d+)\] or at most (\d+) vis", str(refusal.value)).groups())
    assert nx == pytest.approx(2 * ny, abs=4)

    def fits(**changed):
        return forecast(WORK.__class__(**{**WORK.__dict__, **changed}), 300_000_000, 400_000_000).fits

    assert fits(shape=(nx, ny)) and not fits(shape=(int(1.05 * nx), int(1.05 * ny)))
    assert fits(samples=samples) and not fits(samples=int(1.05 * samples))


def test_room_is_the_least_of_machine_and_maxmem():
    assert forecast(WORK, 3 * 10**8, 10**10, 0.5).room == 2 * 10**8
    assert forecast(WORK, 3 * 10**8, 10**8, 0.5).room == 10**8
    assert forecast(WORK, 3 * 10**8, 10**8).room == 10**8


def test_census_counts_what_is_read(vis, tmp_path):
    """Every sample at first, the unflagged ones with the flags; autocorrelations never."""
    import shutil

    from casa_sara.casa.ms.read import read_visibilities

    copy = shutil.copytree(vis, tmp_path / "flagged.ms")
    rng = np.random.default_rng(0)
    edit(copy, "FLAG", lambda flag: rng.random(flag.shape) < 0.2)
    edit(copy, "FLAG_ROW", lambda flag: rng.random(flag.shape) < 0.1)
    for selection in (Selection((vis, str(copy)), datacolumn="data"),
                      Selection((str(copy),), datacolumn="data", spw="0:1~2", antenna="A03")):
        data = read_visibilities(selection)
        most, exact = measure_volume(selection), measure_volume(selection, flags=True)
        assert exact.samples == data.size
        assert most.samples == data.size + sum(count for reason, count in data.dropped.items() if "flagged" in reason)
        for reach, axis in zip(exact.reach, data.uvw):
            assert np.abs(axis).max() <= reach < 1.3 * np.abs(axis).max()


def test_flags_are_read_before_a_run_is_refused(vis, tmp_path, monkeypatch):
    """A run of which most is flagged fits though it would not with all samples."""
    import shutil

    from casa_sara.imaging import dry_run

    copy = shutil.copytree(vis, tmp_path / "flagged.ms")
    edit(copy, "FLAG", lambda flag: flag | (np.arange(flag.shape[-1]) % 10 > 0))
    full = measure_volume(Selection((str(copy),), datacolumn="data")).samples
    monkeypatch.setattr(dry_run, "forecast", lambda work,
                        *rest: forecast(work, 0, 0 if work.samples == full else 10**12))
    said = tsara(vis=str(copy), imagename=str(tmp_path / "some"), dryrun=True, **GRID)["forecast"]
    assert said["fits"] and said["visibilities"] < 0.2 * full


@pytest.mark.slow
def test_time_limit_delivers_the_image(vis, tmp_path):
    """A run that re-weights for ever ends, with its images written."""
    made = tsara(vis=vis, imagename=str(tmp_path / "short"), maxtime="6s", reltol=0.0, reweighttol=0.0,
                 nreweights=10**6,
                 **GRID)
    assert (made["stopcode"], made["stopDescription"]) == (TIME_LIMIT, "time limit")
    assert made["summaryminor"][0][0][0]["modelFlux"][0] > 0.2
    assert {"short.model", "short.image", "short.sara.json"} <= set(os.listdir(tmp_path))


def test_no_time_at_all_gives_the_first_fit(vis, tmp_path):
    made = tsara(vis=vis, imagename=str(tmp_path / "none"), maxtime="1ms", **GRID)
    assert (made["stopcode"], made["iterdone"]) == (TIME_LIMIT, 1)
    assert made["summaryminor"][0][0][0]["modelFlux"][0] > 0.2


def test_enough_time_changes_nothing(vis, tmp_path):
    made = tsara(vis=vis, imagename=str(tmp_path / "long"), maxtime=60, **GRID)
    assert made["stopcode"] == CONVERGED
    assert made["sara"]["forecast"]["iteration_s"] > 0


@pytest.mark.parametrize("wrong", ["2Jy", "-1h", "0", "soon", "nan", "1e400h", -3, 0])
def test_wrong_maxtime_is_named(vis, tmp_path, wrong):
    with pytest.raises(ValueError, match="maxtime"):
        tsara(vis=vis, imagename=str(tmp_path / "x"), maxtime=wrong, **GRID)


def test_seconds():
    assert seconds("90min", "maxtime") == 5400 and seconds("2h", "maxtime") == 7200


def test_deadline_keeps_the_reserve_and_one_more_iteration():
    now = [0.0]
    deadline = Deadline(10.0, clock=lambda: now[0])
    deadline.reserve = 3.0
    for now[0], near in ((2.0, False), (4.0, False), (5.1, False), (6.0, False), (6.6, True)):
        assert deadline.near() == near, now
    assert deadline.elapsed() == 6.6
    assert not Deadline().near()


def test_pace_leaves_out_the_first_iteration():
    now = [100.0]
    pace = Pace(200, clock=lambda: now[0])
    said = []
    for iteration, now[0] in enumerate((150.0, 152.0, 154.0, 156.0, 170.0), start=1):
        said.append(pace(iteration))
    assert pace.seconds == 2.0 and said[:3] == said[4:] + ["", ""] and "2 s per iteration" in said[3]


def test_nnls_that_is_stopped_has_made_ten_iterations():
    class Identity:
        shape, calls, workers = (4, 4), 0, Workers(1)

        def forward(self, image, out):
            self.calls += 1
            out[...] = image.ravel()

        def adjoint(self, vis, out):
            out[...] = vis.real.reshape(4, 4)

    identity = Identity()
    model, residual = nnls(identity, np.ones(16, np.complex64), np.ones(16, np.float32), 1.0, stopped=lambda: True)
    assert identity.calls == 11  # and the residual
    np.testing.assert_allclose(residual, 1 - model.ravel())


def _group(folder, **files):
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(str(text))


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """A kernel's files of our own: 8 GB available on the machine."""
    monkeypatch.setattr(machine, "_CGROUPS", tmp_path / "cgroup")
    monkeypatch.setattr(machine, "_PROC", tmp_path / "proc")
    _group(tmp_path / "proc/self", cgroup="0::/user/job\n", statm="100 50 1 1 0 1 0\n")
    _group(tmp_path / "proc", meminfo="MemTotal: 16000000 kB\nMemAvailable: 8000000 kB\n")
    return tmp_path


def test_memory_of_the_machine(kernel):
    assert machine.available_memory() == 8_000_000 * 1024
    assert machine.resident_memory() == 50 * os.sysconf("SC_PAGE_SIZE")
    (kernel / "proc/meminfo").unlink()
    assert machine.available_memory() == os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    (kernel / "proc/self/statm").unlink()
    assert 10**7 < machine.resident_memory() < 10**11


def test_memory_of_control_groups_version_2(kernel):
    _group(kernel / "cgroup/user/job", memory__max="max", memory__current=10**9, memory__stat="inactive_file 5\n")
    assert machine.available_memory() == 8_000_000 * 1024
    _group(kernel / "cgroup/user", memory__max=3 * 10**9, memory__current=2 * 10**9,
           memory__stat="anon 7\ninactive_file 500000000\n")
    assert machine.available_memory() == 1_500_000_000
    _group(kernel / "cgroup/user/job", memory__max=10**9, memory__current=2 * 10**9, memory__stat="inactive_file 0\n")
    assert machine.available_memory() == 0


def test_memory_of_control_groups_version_1(kernel):
    (kernel / "proc/self/cgroup").write_text("7:cpu,cpuacct:/\n4:memory:/docker/abc\n0::/\n")
    _group(kernel / "cgroup/memory", memory__limit_in_bytes=4 * 10**9, memory__usage_in_bytes=10**9,
           memory__stat="total_inactive_file 250000000\n")  # inside a container the group's own path is not there
    assert machine.available_memory() == 3_250_000_000
