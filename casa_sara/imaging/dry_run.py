"""Before a run: a forecast of its memory and, for a dry run, of its time."""

from __future__ import annotations

import math
import os
import time
from dataclasses import replace

import numpy as np

from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.images.spectral_axis import channels_of, samples_of_channels, spectral_axis
from casa_sara.casa.images.spectral_index import spectral_band, with_spectrum
from casa_sara.casa.ms.block_selection import divide
from casa_sara.casa.ms.data_volume import measure_volume
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.selection import select_data
from casa_sara.casa.runtime import log
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.imaging.load_balance import assign_ranks
from casa_sara.imaging.memory_forecast import Workload, forecast
from casa_sara.imaging.mosaic import check_pointings, with_beams
from casa_sara.imaging.outliers import with_turns
from casa_sara.imaging.spectra import divided_by_band, with_subbands
from casa_sara.imaging.time_forecast import measure
from casa_sara.operators.measurement import check_field
from casa_sara.parallel.partition import ALONE
from casa_sara.parallel.serial import SERIAL
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.runtime.machine import available_memory, resident_memory
from casa_sara.runtime.scratch import IN_MEMORY, Scratch

__all__ = ["dry_run", "forecast_run", "scratch_of"]

MANY = 30_000_000  # samples, which are kept on the disk even if there is memory
LEAST = 1_000_000  # samples that go there where memory is short: with fewer it is the image that does not fit
DISK_SAMPLE = 102  # bytes of a sample there: 46 of it, 28 of the operator, 12 of its cell, residual, density, weights
WRITER = 130_000_000  # bytes of the process that writes the images, while it waits


def forecast_run(selection, grid, options, limits, comm=SERIAL, blocks=0, disk=True):
    """Share a run among the ranks, and forecast the memory of this one, from the numbers of rows, channels and pixels.

    Rank 0 says its own in the log. Flags are read only where the run would not fit with all samples. Many samples, and
    those that do not fit into memory, are kept on the disk where that can be.

    Returns
    -------
    casa_sara.imaging.memory_forecast.Forecast
    casa_sara.parallel.partition.RankAssignment
    """
    resident, available = resident_memory(), (available_memory() - WRITER) // comm.node_size
    channels, share = comm.once(_channels, selection, grid)
    for flags in (False, True):
        volume = comm.once(measure_volume, selection, flags, grid.stokes)
        if any(volume.reach):  # else there is nothing to read, which reading explains
            check_field(math.hypot(*volume.reach), grid.shape, grid.cell_rad)
        band = spectral_band(grid, volume.freq_range_hz)

        def memory_of(ranks, volume=volume, band=band):
            work = Workload.of(volume, grid, options, limits.report, band, ranks)
            return forecast(replace(work, channels=channels, share=share), resident, available, limits.maxmem_gb)

        ranks = ALONE if grid.is_cube else assign_ranks(  # each rank has its channels, and reads all
            comm, volume, grid, options, lambda ranks: all(comm.allgather(memory_of(ranks).fits)))
        found = memory_of(ranks)
        if (disk and _may_be_on_disk(grid, options, limits, comm)
                and (volume.samples >= MANY or volume.samples >= LEAST and not found.fits)):
            work = replace(found.workload, on_disk=True, blocks=blocks if isinstance(blocks, int) else 0)
            found = forecast(work, resident, available, limits.maxmem_gb)
        if all(comm.allgather(found.fits)):
            break
    for line in found.lines():
        log.info(line)
    return found, ranks


def _may_be_on_disk(grid, options, limits, comm):
    """Whether samples can be kept on the disk: those of one image that are averaged for the solver, of one process.

    The report and the fit of gains have all of them in memory.
    """
    return (comm.size == 1
            and not (grid.is_cube or grid.is_mosaic or grid.outliers or limits.report or options.gainfit)
            and grid.nterms == 1 and len(grid.stokes) == 1 and (options.averages or options.niter == 0))


def scratch_of(imagename, workload):
    """Return where the samples of a run go.

    Parameters
    ----------
    imagename : str
        Whose folder it is.
    workload : casa_sara.imaging.memory_forecast.Workload
        Whether they go to the disk.

    Raises
    ------
    OSError
        There they have no room.
    """
    if not workload.on_disk:
        return IN_MEMORY
    scratch = Scratch(os.path.dirname(imagename) or os.curdir)
    scratch.require(DISK_SAMPLE * workload.samples)
    log.info(f"visibilities and what belongs to each, {DISK_SAMPLE * workload.samples / 1e9:.3g} GB, are kept in files "
             f"without a name in '{scratch.folder}'")
    return scratch


def _channels(selection, grid):
    """Return how many channels a cube will have, and the share of the samples in the one with most; else 0 and 1."""
    if not grid.is_cube:
        return 0, 1.0
    axis = spectral_axis(selection, grid)
    samples = samples_of_channels(selection, axis)
    everything = sum(group.rows.size * group.channels.size for ms in select_data(selection)[0] for group in ms.groups)
    if not samples.any():
        raise ValueError(f"start = {grid.start!r}, width = {grid.width!r}, nchan = {grid.nchan}: no data are in these "
                         "channels")
    return axis.size, float(samples.max() / everything)


def _fullest_channel(data, selection, grid):
    """Return the samples of the channel of a cube that has most."""
    channel = channels_of(data, selection, spectral_axis(selection, grid))
    count = np.bincount(channel[channel >= 0], minlength=1)
    return data.part(np.flatnonzero(channel == count.argmax()))


def dry_run(selection, grid, options, output, limits):
    """Forecast the memory of a run by part and, where it fits, its time from a short measurement.

    Nothing is written.

    Parameters
    ----------
    selection, grid, options
        As of :func:`casa_sara.imaging.continuum.make_image`.
    output : casa_sara.options.Output
        Its `blocks` and, where visibilities go to the disk, the folder of its `imagename`.
    limits : casa_sara.options.Limits
        Largest memory.

    Returns
    -------
    dict
        See :meth:`casa_sara.imaging.memory_forecast.Forecast.summary`, with `seconds` of each part and `iterations`;
        `reason` instead where it does not fit.
    """
    with kernels_loading(log.info):
        found, _ = forecast_run(selection, grid, options, limits, blocks=output.blocks)
    if not found.fits:
        try:
            found.require(limits.maxmem_gb)
        except MemoryError as error:
            log.warn(str(error))
            return found.summary() | {"reason": str(error)}
    start = time.perf_counter()
    data = read_visibilities(selection, grid.phasecenter, grid.stokes, grid.needs_frequencies,
                             scratch=scratch_of(output.imagename, found.workload))
    check_pointings(data, grid)
    if grid.is_mosaic:
        data, grid = with_beams(data, selection, grid)
    if grid.spectralindex:
        grid = with_spectrum(grid, define_image_plane(data, selection, grid))
    grid = with_turns(grid, data)
    if grid.nterms > 1:
        grid = with_subbands(grid, data, define_image_plane(data, selection, grid))
    everything = data.size
    if grid.is_cube:
        data = _fullest_channel(data, selection, grid)
    block_of_sample, _ = divided_by_band(*divide(data, output.blocks), data, grid.subbands)
    data, offsets = sort_into_blocks(data, block_of_sample)
    timing = measure(data, offsets, grid, options, time.perf_counter() - start)
    several = "channels" if grid.is_cube else "Stokes parameters"
    timing = replace(timing, channels=max(found.workload.channels, len(grid.stokes)))
    for line in _time_lines(timing, several):
        log.info(line)
    seconds = {name: getattr(timing, name) for name in ("reading", "building", "pair", "nnls_iteration", "iteration",
                                                        "drawing", "writing", "total")}
    return found.summary() | {"visibilities": everything, "averages": timing.averages,
                              "iterations": timing.iterations, "seconds": seconds,
                              "iteration_s": timing.iteration}


def _time_lines(timing, several):
    """The times as lines of a table; `several` is what there are several of."""
    channels = f" for each of {timing.channels} {several}" if timing.channels > 1 else ""
    yield (f"forecast: {timing.total:.0f} s, with about {timing.iterations} iterations{channels} (the number depends "
           "on the data)" + (f", the visibilities averaged to {timing.averages}" if timing.averages else ""))
    rows = {"reading": timing.reading, "building the operator": timing.building,
            "one NNLS iteration": timing.nnls_iteration, "one solver iteration": timing.iteration,
            **({f"{timing.draws} draws for the errors": timing.drawing} if timing.draws else {}),
            "writing the images": timing.writing}
    for name, seconds in rows.items():
        yield f"  {name:<26}{seconds:10.3f} s"
