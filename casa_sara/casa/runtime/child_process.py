"""Writing with casacore in a child process.

casacore ends the whole process when a write fails, as on a full disk, over a quota or on a network disk that
went away: it throws in destructors. So what takes new disk space is written by a child process, and its
end is an error here. Starting it takes less than half a second.
"""

from __future__ import annotations

import importlib
import json
import os
import pkgutil
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np

__all__ = ["ChildError", "in_child", "waiting_child"]

# sys.path comes along; the folder that Python puts first is the user's, whose files may have the names of modules
_MPI = ("OMPI_", "PMIX_", "PMI_")  # variables by which a process knows that it is a rank
_START = ("import sys; sys.path[:] = sys.argv[1:]; del sys.argv[1:]; "
          "from casa_sara.casa.runtime.child_process import main; main()")


class ChildError(RuntimeError):
    """The child process failed; the message is the last that it printed."""


@contextmanager
def waiting_child(function: Callable[..., None]) -> Iterator[subprocess.Popen]:
    """Yield a child process that gets ready for a function while this one goes on; unused, it ends at the end.

    Parameters
    ----------
    function : callable
        What :func:`in_child` will be asked to call.
    """
    child = _start(function)
    try:
        yield child
    finally:
        if child.returncode is None:
            child.kill()
            child.wait()
            child.stdin.close()
            child.stdout.close()


def _start(function):
    """Return a new child process, which waits on its standard input for a call of a function.

    It is no rank of an MPI job.
    """
    environment = {name: value for name, value in os.environ.items() if not name.startswith(_MPI)}
    child = subprocess.Popen([sys.executable, "-c", _START, *filter(None, sys.path)], stdin=subprocess.PIPE,
                             stdout=subprocess.PIPE, stderr=subprocess.STDOUT, start_new_session=True, env=environment)
    with suppress(BrokenPipeError):  # in_child says why
        child.stdin.write(_name(function).encode() + b"\n")
        child.stdin.flush()
    return child


def _name(function):
    """Return the name by which the child process finds a function."""
    return f"{function.__module__}:{function.__qualname__}"


def in_child(function: Callable[..., None], child: subprocess.Popen | None = None, **arguments: Any) -> None:
    """Call a function of this package in a child process.

    The child ends when this process does; a Ctrl-C of the terminal does not reach it.

    Parameters
    ----------
    function : callable
        At the top level of a module of casa_sara.
    child : Popen, optional
        Of :func:`waiting_child`; else a new one.
    **arguments
        None, bool, numbers, text, arrays (but of objects), and dicts and lists of them.

    Raises
    ------
    ChildError
    """
    arrays: list[np.ndarray] = []
    header = json.dumps({"function": _name(function), "arguments": _packed(arguments, arrays)}).encode() + b"\n"
    child = child or _start(function)
    said: list[bytes] = []
    reader = threading.Thread(target=lambda: said.append(child.stdout.read()), daemon=True)
    reader.start()
    try:
        child.stdin.write(header)
        for array in arrays:
            child.stdin.write(array.reshape(-1).view(np.uint8).data)
        child.stdin.flush()
        child.wait()
    except BrokenPipeError:
        child.wait()  # it ended early, and says why
    except BaseException:
        child.kill()
        child.wait()
        raise
    finally:
        reader.join()
        with suppress(BrokenPipeError):
            child.stdin.close()
        child.stdout.close()
    if child.returncode:
        raise ChildError(_last_words(said[0].decode(errors="replace"), child.returncode))


def _last_words(text, code):
    """Return the error in the output of the child: that of CASA, or the exception."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    what = [line.removeprefix("what():").strip() for line in lines if line.startswith("what():")]
    how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
    return (what or lines or [f"the process that writes ended with {how}"])[-1]


def _packed(value, arrays):
    """Return `value` as JSON takes it; arrays go to the end of `arrays`, their places hold kind and shape."""
    if isinstance(value, dict):
        return {key: _packed(entry, arrays) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_packed(entry, arrays) for entry in value]
    if isinstance(value, np.generic):
        return value.item()
    if not isinstance(value, np.ndarray):
        return value
    arrays.append(np.ascontiguousarray(value))
    return {"": [value.dtype.str, list(value.shape)]}


def _unpacked(value, stream):
    """Return what was packed, its arrays read from a stream in the same order."""
    if isinstance(value, list):
        return [_unpacked(entry, stream) for entry in value]
    if not isinstance(value, dict):
        return value
    if "" not in value:
        return {key: _unpacked(entry, stream) for key, entry in value.items()}
    dtype, shape = value[""]
    array = np.empty(shape, dtype)
    filled = stream.readinto(array.reshape(-1).view(np.uint8).data)
    if filled != array.nbytes:
        raise EOFError("the process that asked has ended")
    return array


def main() -> None:
    """Make the call that stands on the standard input; what CASA prints is for the parent, its log is not."""
    from casaconfig import config

    config.logfile, config.log2term = os.devnull, False
    config.measures_auto_update = config.data_auto_update = False
    importlib.import_module("casatools")
    stream = sys.stdin.buffer
    _function(stream.readline().decode().strip())  # imported while the parent is busy with other things
    line = stream.readline()
    if not line:
        return  # not needed
    request = json.loads(line)
    function = _function(request["function"])
    arguments = _unpacked(request["arguments"], stream)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    function(**arguments)


def _function(name):
    """Return the function of this package with a name of :func:`_name`."""
    if not name.startswith("casa_sara."):
        raise ValueError(f"{name} is no function of casa_sara")
    return pkgutil.resolve_name(name)


def _end_with_parent():
    """End this process when its input does: that happens when the parent is killed."""
    if not os.read(sys.stdin.fileno(), 1):
        os._exit(1)
