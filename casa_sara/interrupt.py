"""Ctrl-C as a request to end well."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

__all__ = ["signals_deferred", "stop_on_interrupt"]


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that tells whether Ctrl-C was pressed, which raises KeyboardInterrupt only the second time.

    Outside the main thread signals cannot be caught, and the function is always False.
    """
    pressed = threading.Event()

    def on_interrupt(number, frame):
        if pressed.is_set():
            raise KeyboardInterrupt
        pressed.set()

    if threading.current_thread() is not threading.main_thread():
        yield pressed.is_set
        return
    before = signal.signal(signal.SIGINT, on_interrupt)
    try:
        yield pressed.is_set
    finally:
        signal.signal(signal.SIGINT, before)


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Hold back SIGINT and SIGTERM, and deliver them at the end. Only the main thread can."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = []
    deferred = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *got: received.append(got[0])) for number in deferred}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in received:
            signal.raise_signal(number)
