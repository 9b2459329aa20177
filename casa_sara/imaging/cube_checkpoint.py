"""The checkpoint of a cube: the channels that are finished, and the state of the one in progress."""

from __future__ import annotations

from contextlib import contextmanager

from casa_sara.reconstruction.result import Reconstruction

__all__ = ["CubeCheckpoint"]


class CubeCheckpoint:
    """Keeps the solutions of finished channels and the state of the solution in progress in one checkpoint.

    Parameters
    ----------
    checkpoint : casa_sara.reconstruction.checkpoint.Checkpoint
        Opened, if it is to be resumed from.

    Attributes
    ----------
    finished : dict
        Channel → Reconstruction.
    """

    def __init__(self, checkpoint):
        self.file, self.finished = checkpoint, {}
        self._channel, self._solution = -1, None

    def identify(self, **data):
        """Identify the data of all channels, and restore the solutions that were read for them.

        Raises
        ------
        CheckpointError
            What was read is not of these data, or not of a cube.
        """
        self.file.identify(**data)
        if self.file.state is None:
            return
        with self.file.applied() as state:
            self.finished = {int(channel): _reconstruction(one) for channel, one in state["finished"].items()}
            self._channel, self._solution = state["channel"], state["solution"]

    def of(self, channel):
        """Return what the solution of one channel takes for its checkpoint."""
        return _OfChannel(self, channel, self._solution if channel == self._channel else None)

    def finish(self, channel, reconstruction):
        """Add a finished channel, and write when it is time."""
        self.finished[channel] = reconstruction
        self.keep(-1, lambda: None, 0)

    def keep(self, channel, make_solution, iteration, now=False):
        """Write the finished channels, and the state of the solution of another, when it is time or `now`."""
        def state():
            finished = {str(number): vars(one) | dict(record=one.record.state())
                        for number, one in self.finished.items()}
            return dict(finished=finished, channel=channel, solution=make_solution())

        self.file.keep(state, iteration, now)


class _OfChannel:
    """The checkpoint as the solution of one channel sees it; attributes as of Checkpoint."""

    def __init__(self, cube, channel, state):
        self._cube, self._channel, self.state = cube, channel, state
        self.kept = False

    @property
    def path(self):
        return self._cube.file.path

    @property
    def stands(self):
        return self._cube.file.stands

    def identify(self, **data):
        """Nothing to do: the data of all channels are known by their contents."""

    @contextmanager
    def applied(self, read=True):
        """Yield `state`, to be put to use; `read` as of Checkpoint."""
        try:
            yield self.state
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise self._cube.file.refusal(f"its state does not fit ({error})") from None
        self.state = None

    def keep(self, make_state, iteration, now=False):
        """Write when it is time, or `now`."""
        self.kept = self.kept or now
        self._cube.keep(self._channel, make_state, iteration, now)


def _reconstruction(state):
    """Return a finished solution."""
    solved = Reconstruction.of(state)
    solved.record.resumed.pop()  # it was finished, not resumed
    return solved
