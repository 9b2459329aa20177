"""The checkpoint of a run: the data and parameters to which it belongs, its writing and reading."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from casa_sara.reconstruction.state_file import CheckpointError, digest, read, write
from casa_sara.runtime.atomic import NEW

__all__ = ["Checkpoint"]

INTERVAL = 60.0  # s between two checkpoints, at least
PATIENCE = 60  # times what writing one takes: less than 2 % of the run
HEADER = dict(version=str, parameters=dict, data=dict, iteration=int, written=float)


class Checkpoint:
    """The checkpoint of one run: what it belongs to, when to write it, and the state read from it.

    Parameters
    ----------
    path : str
    version : str
        Of the program.
    parameters : dict
        All that decide the image, named as the user knows them; plain values.
    tell, warn : callable
        Take a line for the log.

    Attributes
    ----------
    state : dict or None
        What :meth:`open` has read, until it was :meth:`applied`.
    stands : bool
        The file holds a state of this run.
    """

    def __init__(self, path: str, version: str, parameters: dict[str, Any],
                 tell: Callable[[str], None] = lambda line: None,
                 warn: Callable[[str], None] = lambda line: None) -> None:
        self.path, self.tell, self.warn = path, tell, warn
        self._header = dict(version=version, parameters=json.loads(json.dumps(parameters)), data={})
        self.state: dict[str, Any] | None = None
        self._found: dict[str, Any] = {}
        self._due, self.stands = 0.0, False

    def open(self) -> None:
        """Read the file into `state`.

        Raises
        ------
        CheckpointError
            It is damaged, or of another version or other parameters.
        """
        try:
            found, state = read(self.path)
            for name, kind in HEADER.items():
                if not isinstance(found.get(name), kind):
                    raise CheckpointError(f"its header lacks '{name}'")
            for name in ("version", "parameters"):
                self._compare(name, found[name], self._header[name])
            self._found, self.state, self.stands = found, state, True
        except CheckpointError as error:
            raise self.refusal(error) from None

    def identify(self, **data: np.ndarray | str | None) -> None:
        """Identify the data, by arrays, their digests or None, and compare them with those of the file that was read.

        Parameters
        ----------
        **data : arrays, digests or None
            What identifies the data, by name.

        Raises
        ------
        CheckpointError
            The checkpoint is of other data.
        """
        self._header["data"] = {name: digest(np.ascontiguousarray(values)) if isinstance(values, np.ndarray) else values
                                for name, values in data.items()}
        self._due = time.monotonic() + INTERVAL
        if self.state is not None:
            found = self._found["data"]
            different = [name for name, value in self._header["data"].items() if found.get(name) != value]
            if different:
                raise self.refusal(f"it is of other data: {', '.join(different)} differ")

    @contextmanager
    def applied(self, read: bool = True) -> Iterator[dict[str, Any] | None]:
        """Yield `state` to be restored; an error meanwhile means that it does not fit. Afterwards it is released.

        With `read` = False it was another rank that has read it, and says so.

        Parameters
        ----------
        read : bool
            Whether this rank is the one that has read the file.

        Returns
        -------
        dict or None
            The state, None where there is none.
        """
        try:
            yield self.state
        except CheckpointError:
            raise
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            raise self.refusal(f"its state does not fit ({error})") from None
        if not read:
            return
        age = time.time() - self._found["written"]
        self.tell(f"continuing from '{self.path}', iteration {self._found['iteration']}, "
                      f"written {age / 60:.1f} min ago")
        self.state = None

    def due(self, now: bool = False) -> bool:
        """Return whether it is time to write, as it is whenever it has to be `now`.

        Parameters
        ----------
        now : bool
            Whether it has to be written in any case.

        Returns
        -------
        bool
        """
        return now or time.monotonic() >= self._due

    def keep(self, make_state: Callable[[], dict[str, Any]], iteration: int, now: bool = False) -> None:
        """Write `make_state()` when it is time, or `now`.

        What a full disk, or the like, prevents is said in the log and tried again: the run matters more.

        Parameters
        ----------
        make_state : callable
            Returns the state: dict of dicts, plain values and C-contiguous arrays.
        iteration : int
            Of the state.
        now : bool
            Write whatever the time.
        """
        begun = time.monotonic()
        if not self.due(now):
            return
        try:
            write(self.path, self._header | dict(iteration=iteration, written=time.time()), make_state())
        except OSError as error:
            self.warn(f"the checkpoint of iteration {iteration} could not be written: {error}")
        else:
            self.stands, size = True, os.path.getsize(self.path) / 1e6
            self.tell(f"checkpoint of iteration {iteration} written: '{self.path}', {size:.3g} MB")
        done = time.monotonic()
        self._due = done + max(INTERVAL, PATIENCE * (done - begun))

    def remove(self) -> None:
        """Remove the file, and what an interrupted write has left."""
        for path in (self.path, self.path + NEW):
            if os.path.lexists(path):
                os.unlink(path)

    def _compare(self, name, found, wanted):
        if found == wanted:
            return
        if isinstance(wanted, dict):
            keys = [key for key in {**found, **wanted} if found.get(key) != wanted.get(key)]
            pairs = ", ".join(f"{key} was {found.get(key)!r} and is {wanted.get(key)!r}" for key in keys)
            raise CheckpointError(f"it is of a run with other {name}: {pairs}")
        raise CheckpointError(f"it is of another {name} of casa_sara: {found}, and this is {wanted}")

    def refusal(self, reason: object) -> CheckpointError:
        """Return the error why the run cannot be continued from the file.

        Parameters
        ----------
        reason : object
            Why the file does not fit, for the message.

        Returns
        -------
        CheckpointError
        """
        return CheckpointError(f"restart = True: '{self.path}' cannot be continued: {reason}. Use the same data and "
                               "parameters, or set restart = False and overwrite = True to start anew, or choose "
                               "another imagename")
