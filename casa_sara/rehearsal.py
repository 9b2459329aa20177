"""Before a run: what it will take, whether it fits, and for a dry run how long it would last."""

from __future__ import annotations

import math
import time

from casa_sara.casa import log
from casa_sara.casa.blockwords import divide
from casa_sara.casa.census import take_census
from casa_sara.casa.ms import read_visibilities
from casa_sara.forecast import Workload, forecast
from casa_sara.operators.measurement import check_field
from casa_sara.resources import available_memory, resident_memory
from casa_sara.timing import measure
from casa_sara.visibilities import sort_into_blocks

__all__ = ["foresee", "rehearse"]


def foresee(selection, grid, options, limits):
    """Forecast the memory of a run, from the numbers of rows, channels and pixels, and say it in the log.

    Flags are read only where the run would not fit with all samples.

    Returns
    -------
    casa_sara.forecast.Forecast
    """
    resident, available = resident_memory(), available_memory()
    for flags in (False, True):
        census = take_census(selection, flags, grid.stokes)
        if any(census.reach):  # else there is nothing to read, which reading explains
            check_field(math.hypot(*census.reach), grid.shape, grid.cell_rad)
        work = Workload.of(census, grid, options, limits.report)
        found = forecast(work, resident, available, limits.maxmem_gb)
        if found.fits:
            break
    for line in found.lines():
        log.info(line)
    return found


def rehearse(selection, grid, options, blocks, limits):
    """Say what a run would take: memory by part and, where it fits, time from a short measurement.

    Nothing is written.

    Parameters
    ----------
    selection, grid, options
        As of :func:`casa_sara.imaging.make_image`.
    blocks : int or tuple of str
        As of :class:`casa_sara.options.Output`.
    limits : casa_sara.options.Limits

    Returns
    -------
    dict
        See :meth:`casa_sara.forecast.Forecast.summary`, with `seconds` of each part and `iterations`; `reason` instead where it
        does not fit.
    """
    found = foresee(selection, grid, options, limits)
    if not found.fits:
        try:
            found.require(limits.maxmem_gb)
        except MemoryError as error:
            log.warn(str(error))
            return found.summary() | {"reason": str(error)}
    start = time.perf_counter()
    data = read_visibilities(selection, grid.phasecenter, grid.stokes)
    data, offsets = sort_into_blocks(data, divide(data, blocks)[0])
    timing = measure(data, offsets, grid, options, time.perf_counter() - start)
    for line in _time_lines(timing):
        log.info(line)
    seconds = {name: getattr(timing, name) for name in ("reading", "building", "pair", "nnls_iteration", "iteration",
                                                        "writing", "total")}
    return found.summary() | {"visibilities": data.size, "iterations": timing.iterations, "seconds": seconds,
                              "iteration_s": timing.iteration}


def _time_lines(timing):
    """The times as lines of a table."""
    yield f"forecast: {timing.total:.0f} s, with about {timing.iterations} iterations (the data decide)"
    rows = {"reading": timing.reading, "building the operator": timing.building,
            "one iteration of NNLS": timing.nnls_iteration, "one iteration": timing.iteration, "writing the images": timing.writing}
    for name, seconds in rows.items():
        yield f"  {name:<26}{seconds:10.3f} s"
