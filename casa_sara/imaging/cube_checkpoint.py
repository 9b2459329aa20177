"""The checkpoint of a cube: the channels that are finished, and the state of the one in progress."""

from __future__ import annotations

import copy
import glob
from contextlib import contextmanager, nullcontext

import numpy as np

from casa_sara.casa.runtime import log
from casa_sara.parallel.serial import SERIAL
from casa_sara.reconstruction.draws import Draws
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.state_file import CheckpointError, digest

__all__ = ["CubeCheckpoint"]


class CubeCheckpoint:
    """Keeps the solutions of finished channels and the state of the solution in progress.

    Each rank has a file of its own, rank 0 that of one process, the others with their numbers behind: a run is
    continued from all of them, by any number of ranks.

    Parameters
    ----------
    checkpoint : casa_sara.reconstruction.checkpoint.Checkpoint
        Of one process.
    comm : casa_sara.parallel.serial.Serial or MPI
        The ranks that share the channels.

    Attributes
    ----------
    file : Checkpoint
        Of this rank.
    finished : dict
        Channel → Reconstruction.
    """

    def __init__(self, checkpoint, comm=SERIAL):
        self._main, self._comm, self._read = checkpoint, comm, []
        self.file = _numbered(checkpoint, comm.rank) if comm.rank else checkpoint
        self.finished, self._solutions = {}, {}

    def open(self):
        """Read the files of all ranks; those beside the first count only where they are of this run.

        Raises
        ------
        CheckpointError
            The first is damaged, or of another version or other parameters.
        """
        self._main.open()
        self._read = [self._main]
        for number in self._numbers():
            file = self.file if number == self._comm.rank else _numbered(self._main, number)
            with _passed_over():
                file.open()
                self._read.append(file)

    def identify(self, **data):
        """Identify the data of all channels, and restore the solutions that were read for them.

        Raises
        ------
        CheckpointError
            What was read is not of these data, or not of a cube.
        """
        data = {name: digest(np.ascontiguousarray(one)) if one is not None else None for name, one in data.items()}
        for file in dict.fromkeys([self._main, self.file, *self._read]):
            with nullcontext() if file is self._main else _passed_over():
                file.identify(**data)
                if file.state is not None:
                    self._restore(file)

    def _restore(self, file):
        with file.applied() as state:
            self.finished |= {int(channel): _reconstruction(one) for channel, one in state["finished"].items()}
            if state["channel"] >= 0:
                self._solutions[state["channel"]] = state["solution"]

    def clear(self, finished):
        """Remove the files of a run that is `finished`, and else this rank's where it is of an older one."""
        if not finished:
            if not self.file.stands:
                self.file.remove()
        elif self._comm.rank == 0:
            for number in self._numbers():
                _numbered(self._main, number).remove()
            self._main.remove()

    def of(self, channel):
        """Return what the solution of one channel takes for its checkpoint."""
        return _OfChannel(self, channel, self._solutions.pop(channel, None))

    def _numbers(self):
        """Return the numbers of the files beside the first."""
        ends = (path.rpartition(".")[2] for path in glob.glob(glob.escape(self._main.path) + ".*"))
        return sorted(int(end) for end in ends if end.isdigit())

    def finish(self, channel, reconstruction):
        """Add a finished channel, and write when it is time."""
        self.finished[channel] = reconstruction
        self.keep(-1, lambda: None, 0)

    def keep(self, channel, make_solution, iteration, now=False):
        """Write the finished channels, and the state of the solution of another, when it is time or `now`."""
        def state():
            finished = {str(number): vars(one) | dict(record=one.record.state()) | {
                name: draws and draws.arrays() for name, draws in (("draws", one.draws), ("jackknife", one.jackknife))}
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


@contextmanager
def _passed_over():
    """Say in the log that a file beside the first is not of this run, and go on."""
    try:
        yield
    except CheckpointError as error:
        log.info(f"a checkpoint beside is not of this run, and is not used: {error}")


def _numbered(checkpoint, number):
    """Return the checkpoint of another rank of the same run."""
    other = copy.copy(checkpoint)
    other.path, other.state, other.stands = f"{checkpoint.path}.{number}", None, False
    return other


def _reconstruction(state):
    """Return a finished solution."""
    drawn = {name: state[name] and Draws.of(state[name]) for name in ("draws", "jackknife")}
    solved = Reconstruction.of(state | drawn)
    solved.record.resumed.pop()  # it was finished, not resumed
    return solved
