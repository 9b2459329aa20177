"""The time limit of a run, including the writing of its images."""

from __future__ import annotations

import math
import time

__all__ = ["Deadline"]


class Deadline:
    """Decides when to stop the iterations, so that the images are written before the time limit.

    Parameters
    ----------
    seconds : float
        From now on; infinite for no deadline.
    clock : callable
        Seconds of any origin.

    Attributes
    ----------
    reserve : float
        Seconds that what comes after the iterations takes.
    """

    def __init__(self, seconds=math.inf, clock=time.monotonic):
        self._clock, self._begin = clock, clock()
        self._last, self._end = self._begin, self._begin + seconds
        self.reserve = 0.0

    def elapsed(self) -> float:
        """Seconds since the beginning."""
        return self._clock() - self._begin

    def near(self) -> bool:
        """Whether to stop now; asked after every iteration, another one is taken to last as long as since then."""
        now = self._clock()
        lap, self._last = now - self._last, now
        return now + lap + self.reserve >= self._end
