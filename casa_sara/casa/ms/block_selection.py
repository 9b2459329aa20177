"""Blocks of data that the user selects: entries as 'scan=3' or 'vis=0 spw=1', in the syntax of the data selection."""

from __future__ import annotations

import re

import numpy as np

from casa_sara.casa.ms.integrity import reading
from casa_sara.casa.ms.msselect import MSSELECT_KEYS, msselect
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.parallel.serial import SERIAL

__all__ = ["divide", "parsed"]

_WORD = re.compile(r"(?:^|\s+)(" + "|".join(("vis", *MSSELECT_KEYS)) + r")\s*=")
RIGHT = ("should be a number, or a list of entries as 'scan=3', 'spw=1', 'timerange=09:14:00~09:20:00' or 'vis=0 "
         f"scan=3' (vis, the number of the MeasurementSet, and {', '.join(MSSELECT_KEYS)})")


def divide(visibilities, blocks, comm=SERIAL):
    """Divide the samples into blocks: by snapshots, into a number of blocks, or separately for given selections.

    The samples of an entry, and the rest, are split into snapshots each by itself. Where entries overlap the first has
    the samples.

    Parameters
    ----------
    visibilities : Visibilities
        The samples.
    blocks : int or tuple of str
        As of :class:`casa_sara.options.Output`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    block_of_sample, infos
        As of :func:`casa_sara.data.blocks.snapshot_blocks`; the blocks of the rest come first.

    Raises
    ------
    ValueError
        An entry is not understood, or names no sample that is imaged and no earlier entry has.
    """
    if isinstance(blocks, int):
        return snapshot_blocks(visibilities, blocks, comm=comm)
    group = np.zeros(visibilities.size, np.int32)
    for number, entry in enumerate(blocks, 1):
        found, refusals = _samples_of(visibilities, entry)
        if not comm.total(int(found.sum())):
            raise ValueError(f"blocks = '{entry}': {refusals[0]}" if refusals else
                             f"blocks = '{entry}' selects no visibility that is imaged: {RIGHT}")
        found &= group == 0
        if not comm.total(int(found.sum())):
            raise ValueError(f"blocks = '{entry}' selects only visibilities that earlier entries have selected: leave "
                             "it out, or put it first")
        group[found] = number
    return snapshot_blocks(visibilities, group=group, comm=comm)


def parsed(entry):
    """Return the selection of an entry: parameter → expression.

    Raises
    ------
    ValueError
    """
    pieces = _WORD.split(entry.strip())
    words = dict(zip(pieces[1::2], (value.strip() for value in pieces[2::2])))
    if pieces[0].strip() or not words or len(words) < len(pieces) // 2 or not all(words.values()):
        raise ValueError(f"blocks = '{entry}': {RIGHT}")
    if "vis" in words:
        _numbers(entry, words["vis"])
    return words


def _numbers(entry, text):
    """Return the integers of '0', '0,2' or '0~2'."""
    ranges = [re.fullmatch(r"\s*(\d{1,6})\s*(?:~\s*(\d{1,6})\s*)?", part) for part in text.split(",")]
    if not all(ranges):
        raise ValueError(f"blocks = '{entry}': vis should be the numbers of MeasurementSets, as 'vis=0' or 'vis=1~2'")
    return [number for one in ranges for number in range(int(one[1]), int(one[2] or one[1]) + 1)]


def _samples_of(visibilities, entry):
    """Return which samples an entry selects, bool (M,), and the errors of MeasurementSets that it does not fit."""
    words = parsed(entry)
    wanted = _numbers(entry, words.pop("vis")) if "vis" in words else list(visibilities.spws)
    rows, found, refusals = visibilities.rows, np.zeros(visibilities.size, bool), []
    for number in (number for number in wanted if number in visibilities.spws):
        name = visibilities.ms_names[number]
        try:
            with reading(name):
                chosen, channels = msselect(name, words)
        except ValueError as error:  # an antenna or a field of another MeasurementSet
            refusals.append(error)
            continue
        named = ((rows.ms == number) & np.isin(rows.row, chosen))[visibilities.row]
        if channels:
            spw, here = rows.spw[visibilities.row], np.zeros(visibilities.size, bool)
            for window, numbers in channels.items():
                here |= (spw == window) & np.isin(visibilities.chan, numbers)
            named &= here
        found |= named
    return found, refusals
