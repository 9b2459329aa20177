"""Ctrl-C and SIGTERM as requests to stop and to write the images."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["signals_deferred", "stop_on_interrupt"]

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed, or SIGTERM came.

    Only the first signal is such a request, and only when the function has been asked before: whoever asks will end
    well. Any other does at once what it always does (Ctrl-C raises KeyboardInterrupt, SIGTERM ends the process).
    Outside the main thread signals cannot be caught, and the function is always False.
    """
    asked, requested = threading.Event(), threading.Event()

    def stopped():
        asked.set()
        return requested.is_set()

    def on_signal(number, frame):
        if asked.is_set() and not requested.is_set():
            requested.set()
            return
        signal.signal(number, before[number] or signal.SIG_DFL)
        signal.raise_signal(number)

    if threading.current_thread() is not threading.main_thread():
        yield stopped
        return
    before = {number: signal.signal(number, on_signal) for number in SIGNALS}
    try:
        yield stopped
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)  # None: not Python's own


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Hold back SIGINT and SIGTERM, and deliver them at the end. Only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = []
    before = {number: signal.signal(number, lambda *got: received.append(got[0])) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        for number in received:
            signal.raise_signal(number)
