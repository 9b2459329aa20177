"""The state of an unfinished solution in a file, which is replaced atomically and verified by checksums.

The file is

    magic line | length of the header (8 bytes) | header, JSON | SHA-256 of all before | the arrays, one after the other

The header lists the arrays with type, shape and SHA-256.  Arrays are raw numbers of a few types, so nothing in the file
is ever executed.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
from typing import Any

import numpy as np

from casa_sara.runtime.atomic import new_file
from casa_sara.runtime.scratch import Scratch

__all__ = ["CheckpointError", "digest", "digest_on_disk", "read", "write"]

MAGIC = b"casa_sara checkpoint 1\n"  # the number is that of the format
TYPES = ("<f2", "<f4", "<f8", "<c8", "<c16", "<i4", "<i8", "|b1")
_DIGEST = hashlib.sha256().digest_size


class CheckpointError(ValueError):
    """The run cannot be continued from the checkpoint; the message says why."""


def write(path: str, header: dict[str, Any], state: dict[str, Any]) -> None:
    """Write a checkpoint, which takes its place when it is complete and on the disk.

    Parameters
    ----------
    path : str
        File to write.
    header : dict
        Plain values.
    state : dict
        Of dicts, plain values and C-contiguous arrays; the arrays are written from where they are.

    Raises
    ------
    OSError
        It cannot be written; what was there is still there.
    """
    arrays: dict[str, np.ndarray] = {}
    tree = _split(state, arrays)
    listed = [dict(name=name, dtype=array.dtype.str, shape=array.shape, sha256=digest(array))
              for name, array in arrays.items()]
    text = json.dumps(header | dict(state=tree, arrays=listed), default=lambda value: value.tolist()).encode()
    begin = MAGIC + struct.pack("<Q", len(text)) + text
    with new_file(path) as file:
        file.write(begin + hashlib.sha256(begin).digest())
        for array in arrays.values():
            file.write(_bytes(array))


def read(path: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read a checkpoint and check every bit of it.

    Parameters
    ----------
    path : str
        The file of the checkpoint.

    Returns
    -------
    header : dict
    state : dict
        As written; the arrays are read-only maps of the file.

    Raises
    ------
    CheckpointError
        It is no checkpoint, of another format, truncated or damaged.
    """
    if not os.path.isfile(path) or os.path.getsize(path) < len(MAGIC) + 8 + _DIGEST:
        raise CheckpointError("it is no checkpoint of casa_sara, or truncated")
    raw = np.memmap(path, np.uint8, "r")
    if raw[:len(MAGIC)].tobytes() != MAGIC:
        raise CheckpointError("it is no checkpoint of casa_sara in the format of this version")
    start = len(MAGIC) + 8
    length, = struct.unpack("<Q", raw[len(MAGIC):start].tobytes())
    place = start + length
    if place + _DIGEST > raw.size or hashlib.sha256(raw[:place].data).digest() != raw[place:place + _DIGEST].tobytes():
        raise CheckpointError("it is truncated or damaged: the checksum of its header is wrong")
    try:
        header = json.loads(raw[start:place].tobytes())
        state, listed = header.pop("state"), header.pop("arrays")
        place += _DIGEST
        for entry in listed:
            place = _join(state, entry, raw, place)
    except CheckpointError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise CheckpointError(f"its header is none ({error!r})") from None
    if place != raw.size:
        raise CheckpointError("it is damaged: more bytes than its arrays have")
    return header, state


def _split(state, arrays, path=""):
    """Move the arrays out of nested dicts into `arrays`, by the path to them; return the rest."""
    rest = {}
    for name, value in state.items():
        if isinstance(value, np.ndarray):
            arrays[path + name] = value
        else:
            rest[name] = _split(value, arrays, f"{path}{name}/") if isinstance(value, dict) else value
    return rest


def _join(state, entry, raw, place):
    """Put the array listed in `entry`, which begins at `place`, into `state`; return where it ends."""
    if entry["dtype"] not in TYPES:
        raise CheckpointError(f"it is damaged: arrays of type {entry['dtype']!r} have no place in it")
    dtype = np.dtype(entry["dtype"])
    end = place + dtype.itemsize * int(np.prod(entry["shape"], dtype=object))
    if not place <= end <= raw.size:
        raise CheckpointError(f"it is truncated: {raw.size} bytes, and '{entry['name']}' should reach to {end}")
    piece = raw[place:end]
    if hashlib.sha256(piece).hexdigest() != entry["sha256"]:
        raise CheckpointError(f"it is damaged: the checksum of '{entry['name']}' is wrong")
    *folders, name = entry["name"].split("/")
    for folder in folders:
        state = state[folder]
    state[name] = piece.view(dtype).reshape(entry["shape"])
    return end


def _bytes(array):
    return array.reshape(-1).view(np.uint8)


def digest_on_disk(array: np.ndarray, scratch: Scratch) -> str:
    """Return the SHA-256 of the SHA-256 of each row of an array (n, M) or (M,), which is read piece by piece.

    Parameters
    ----------
    array : (n, M) or (M,)
        Any array.
    scratch : Scratch
        Where it is.

    Returns
    -------
    str
    """
    of_rows = []
    for row in np.atleast_2d(array):
        of_rows.append(hashlib.sha256())
        for piece in scratch.pieces(0, row.size):
            of_rows[-1].update(_bytes(row[piece]))
    return hashlib.sha256(b"".join(one.digest() for one in of_rows)).hexdigest()


def digest(array: np.ndarray) -> str:
    """Return the SHA-256 of a C-contiguous array, as text.

    Parameters
    ----------
    array : ndarray, C-contiguous
        Any array.

    Returns
    -------
    str
    """
    return hashlib.sha256(_bytes(array)).hexdigest()
