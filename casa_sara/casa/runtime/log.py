"""The CASA log: the same file and the same format as those of the CASA tasks.

INFO goes to the log file; CASA itself shows WARN and worse on the terminal too.
"""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime
from typing import Any

__all__ = ["Progress", "error", "info", "logged_task", "speak", "warn"]

ORIGIN = "casa_sara"
_silent = False  # this process is one of several, and another one speaks


def speak(speaks):
    """Set whether this process writes to the log and draws progress."""
    global _silent
    _silent = not speaks


def _sink():
    """Return the log sink of casatasks, or one like it where casatasks is not loaded."""
    return sys.modules["casatasks"].casalog if "casatasks" in sys.modules else _own_sink()


@functools.cache
def _own_sink():
    """Return a sink to CASA's log file, which takes the messages of all casatools too."""
    import casatools
    from casaconfig import config

    sink = casatools.logsink(config.logfile)
    sink.setglobal(True)
    sink.post(f"casatools {casatools.version_string()}", "INFO", ORIGIN)
    return sink


def _post(message, level):
    if not _silent:
        _sink().post(message, level, ORIGIN)


@contextmanager
def logged_task(name: str, arguments: dict[str, Any]) -> Iterator[Callable[[Any], None]]:
    """Write beginning, arguments, error and end of a task as those of casatasks do; yield what takes its result."""
    def post(message, level="INFO"):
        _sink().post(message, level, name)

    start, line, result = datetime.now(), 42 * "#", []
    post(line)
    post(f"##### Begin Task: {name:<18} #####")
    post(f"{name}( {', '.join(f'{key}={value!r}' for key, value in arguments.items())} )")
    try:
        yield result.append
    except Exception as error:
        post(f"Task {name} raised an exception of class {type(error).__name__} with the following message: {error}",
             "ERROR")
        raise
    finally:
        post(f"Result {name}: {result[0] if result else None!r}", "DEBUG")
        post(f"Task {name} complete. Start time: {start} End time: {datetime.now()}")
        post(f"##### End Task: {name:<20} #####")
        post(line)


def info(message):
    """Write a message to the CASA log."""
    _post(message, "INFO")


def warn(message):
    """Write a warning to the CASA log, which also shows it on the terminal."""
    _post(message, "WARN")


def error(message):
    """Write an error to the CASA log, which also shows it on the terminal."""
    _post(message, "SEVERE")


class Progress:
    """Progress of a reconstruction: lines in the log, and a live bar in a terminal.

    Parameters
    ----------
    interval : int
        Iterations between two lines of the log; the first iteration has one too.
    stream : text stream
        Where the bar is drawn, when it is a terminal.
    """

    WIDTH = 24

    def __init__(self, interval=50, stream=None):
        self._interval = interval
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty() and not _silent
        self._start = time.monotonic()
        self._first = None  # time and fraction at the end of the first iteration
        self._first_draws = {}  # time and number of the draws of each name before the first

    def __call__(self, iteration, message, fraction=None):
        """Report the state after iteration number `iteration` (from 1).

        The time left follows from the iterations since the first one: what came before them, and the
        start of the first, are not repeated.

        Parameters
        ----------
        iteration : int
            Number of iterations done.
        message : str
            Text for the log.
        fraction : float, optional
            Estimate of the part of the iterations that is done, 0 to 1.
        """
        now, fraction = time.monotonic(), fraction or 0.0
        begin, done = self._first = self._first or (now, fraction)
        left = f", about {_spell((now - begin) * (1 - fraction) / (fraction - done))} left" if fraction > done else ""
        line = f"iteration {iteration}: {message}; {_spell(now - self._start)} elapsed{left}"
        if iteration == 1 or iteration % self._interval == 0:
            info(line)
        self._draw(line, fraction)

    def draw(self, name, number, asked):
        """Report that so many draws of this name are made, 0 before the first, and the time that the others take."""
        now = time.monotonic()
        begin, before = self._first_draws.setdefault(name, (now, number))
        left = f", about {_spell((now - begin) * (asked - number) / (number - before))} left" if number > before else ""
        line = f"{name} {number} of {asked}; {_spell(now - self._start)} elapsed{left}"
        info(line)
        self._draw(line, number / max(asked, 1))

    def prepare(self, message, log=True):
        """Report what is done before the first iteration.

        Parameters
        ----------
        message : str
            Text for the log.
        log : bool
            Write it to the log too, not to the terminal only.
        """
        line = f"{message}; {_spell(time.monotonic() - self._start)} elapsed"
        if log:
            info(line)
        self._draw(line, 0.0)

    def _draw(self, line, fraction):
        """Draw the bar, where there is a terminal."""
        if self._live:
            filled = round(self.WIDTH * min(fraction, 1))
            self._stream.write(f"\r[{'#' * filled}{'.' * (self.WIDTH - filled)}] {line}\033[K")
            self._stream.flush()

    def close(self):
        """End the line of the bar."""
        if self._live:
            self._stream.write("\n")
            self._stream.flush()


def _spell(seconds):
    """Spell a time span: '42 s', '3 min 20 s', '2 h 05 min'."""
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds // 60 % 60:02d} min"
