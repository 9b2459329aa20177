"""Long sessions, threads and event loops; benchmarks/endurance.py does the same for longer."""

import sys
from pathlib import Path

import pytest
from simulated_ms import simulate

pytest.importorskip("casatools")

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))

import endurance

FEW = dict(niter=20, imsize=64)


@pytest.fixture(scope="module")
def sets(tmp_path_factory):
    folder, short = tmp_path_factory.mktemp("ms"), dict(antennas=18, scan_seconds=60.0)
    return [simulate(folder / f"{k}.ms", **endurance.OBSERVATION | short, seed=k) for k in range(2)]


@pytest.mark.slow
def test_iterations_take_no_more_and_more_memory(sets):
    """An image of 128² pixels lost in every iteration would be 64 MB per 1000."""
    growth, done, files = endurance.long_solution(sets[0], 1000)  # the first tenth has the first support
    assert done == 1000 and files == 0 and growth < 8e6


@pytest.mark.slow
def test_runs_of_one_session_are_the_same_and_leave_nothing_open(sets):
    growth, files, same = endurance.many_runs(sets[0], 3, **FEW)
    assert same and files == 0 and growth < 8e6


@pytest.mark.slow
def test_runs_in_threads_and_event_loops_are_those_of_one_after_the_other(sets):
    assert endurance.at_once(sets, **FEW)


@pytest.mark.slow
def test_number_of_threads_changes_nothing(tmp_path):
    """The points are spread to the grid in ten pieces, each by one thread."""
    vis = simulate(tmp_path / "a.ms", **endurance.OBSERVATION)
    assert endurance.thread_counts(vis, (1, 2, 3), **FEW) == 0
