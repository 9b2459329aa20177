"""Threads of the compiled kernels: how many take part."""

import threading
import time
import weakref

import pytest

from casa_sara.operators import _workers
from casa_sara.operators._workers import Workers


@pytest.mark.parametrize("least, expected", [(0.0, 1), (1.9, 1), (2.0, 2), (3.9, 3), (1e9, 4), (float("inf"), 4)])
def test_a_thread_is_used_where_there_is_work_for_it(least, expected):
    workers, seen = Workers(4), set()
    assert workers.for_work(least * _workers.LEAST_NS) == expected
    workers.run(lambda worker, count: seen.add((worker, count)), work_ns=least * _workers.LEAST_NS)
    assert seen == {(worker, expected) for worker in range(expected)}


def test_no_more_threads_are_there_than_are_ever_worth_while():
    before = set(threading.enumerate())
    workers = Workers(8, 3.5 * _workers.LEAST_NS)
    assert workers.count == 3 and len(set(threading.enumerate()) - before) == 2


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


def test_an_error_of_any_share_is_raised_when_all_are_done():
    done = []

    def kernel(worker, count):
        if worker == failing:
            raise ArithmeticError(f"share {worker}")
        done.append(worker)

    workers = Workers(3)
    for failing in range(3):
        done.clear()
        with pytest.raises(ArithmeticError, match=f"share {failing}"):
            workers.run(kernel)
        assert sorted(done) == [worker for worker in range(3) if worker != failing]
    failing = None
    workers.run(kernel)  # and the threads are still there


def test_calls_at_once_do_not_take_each_others_ends():
    """Two threads that share one object: each waits for its own call."""
    workers, errors = Workers(3), []

    def call(me):
        for turn in range(300):
            seen = []
            workers.run(lambda worker, count, seen=seen: seen.append(worker))
            if sorted(seen) != [0, 1, 2]:
                errors.append((me, turn, seen))

    callers = [threading.Thread(target=call, args=(me,)) for me in range(2)]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert not errors


def test_threads_end_with_their_object_and_hold_no_arguments():
    before = set(threading.enumerate())
    workers, barrier = Workers(3), threading.Barrier(3, timeout=10)

    class Image:
        pass

    image = Image()
    kept = weakref.ref(image)
    workers.run(lambda image, worker, count: barrier.wait(), image)
    del image
    ours = set(threading.enumerate()) - before
    assert len(ours) == 2
    deadline = time.monotonic() + 10
    while kept() is not None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert kept() is None
    del workers
    for thread in ours:
        thread.join(10)
        assert not thread.is_alive()


@pytest.mark.parametrize("count", [0, -1])
def test_no_threads_are_refused(count):
    with pytest.raises(ValueError, match=f"nthreads={count} must be at least 1"):
        Workers(count)
