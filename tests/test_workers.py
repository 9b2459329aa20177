"""Threads of the compiled kernels: how many take part."""

import threading

import pytest

from casa_sara.operators import _workers
from casa_sara.operators._workers import Workers


@pytest.mark.parametrize("least, expected", [(0.0, 1), (1.9, 1), (2.0, 2), (3.9, 3), (1e9, 4), (float("inf"), 4)])
def test_a_thread_is_used_where_there_is_work_for_it(least, expected):
    workers, seen = Workers(4), set()
    assert workers.for_work(least * _workers.LEAST_NS) == expected
    workers.run(lambda worker, count: seen.add((worker, count)), work_ns=least * _workers.LEAST_NS)
    assert seen == {(worker, expected) for worker in range(expected)}


def test_processes_share_the_work():
    """With a third of the work in each of three processes, as many threads in all of them."""
    seen = set()
    for process in range(3):
        Workers(4).run(lambda worker, count: seen.add((worker, count)), part=(process, 3),
                       work_ns=6 * _workers.LEAST_NS)
    assert seen == {(worker, 6) for worker in range(6)}


def test_others_are_waited_for():
    waiting, done = threading.Barrier(3, timeout=10), []

    def kernel(worker, count):
        waiting.wait()
        done.append(worker)

    Workers(3).run(kernel)
    assert sorted(done) == [0, 1, 2]


@pytest.mark.parametrize("count", [0, -1])
def test_no_threads_are_refused(count):
    with pytest.raises(ValueError, match=f"nthreads={count} must be at least 1"):
        Workers(count)
