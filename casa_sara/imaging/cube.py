"""A spectral cube: read the data, sort them by channel, and image one channel after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from casa_sara.casa.images.products import check_imagename, write_images, write_products
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.child_process import waiting_child
from casa_sara.imaging.continuum import after_iterations
from casa_sara.imaging.cube_checkpoint import CubeCheckpoint
from casa_sara.imaging.cube_planes import Channel, CubePlanes, Tally
from casa_sara.imaging.data_quality import image_limits
from casa_sara.imaging.dry_run import forecast_run
from casa_sara.imaging.mosaic import check_pointings, with_beams
from casa_sara.imaging.predict_model import save_model
from casa_sara.imaging.run_solver import checkpoint_of
from casa_sara.imaging.time_forecast import writing_seconds
from casa_sara.options import ImagingRequest
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.runtime.deadline import Deadline
from casa_sara.runtime.signals import stop_on_interrupt
from casa_sara.solver.record import (
    CONVERGED,
    EMPTY_MASK,
    ITERATION_LIMIT,
    NOISE_ONLY,
    STOPPED_BY_USER,
    TIME_LIMIT,
    UNFINISHED,
)

__all__ = ["CubeResult", "make_cube"]


@dataclass
class CubeResult:
    """The results of one run, for the task's return value; `stopped` is the stop code if it ended early, else 0."""

    data: Tally
    channels: list[Channel]
    frame: str
    forecast: dict
    stopped: int = 0

    @property
    def finished(self) -> bool:
        """Whether the run is complete, so that a restart has nothing to continue."""
        return self.stopped not in UNFINISHED

    @property
    def stop_code(self) -> int:
        """Of the run: that of the first channel that did not converge, if there is one."""
        if self.stopped:
            return self.stopped
        codes = [self.code_of(channel) for channel in self.channels if channel.result]
        return next((code for code in codes if code not in (CONVERGED, NOISE_ONLY, EMPTY_MASK)), CONVERGED)

    def code_of(self, channel: Channel) -> int:
        """Return the stop code of a channel: for one that was not solved, why."""
        solved = channel.result and channel.result.reconstruction
        if solved:
            return solved.record.stop_code
        return EMPTY_MASK if channel.closed else self.stopped or ITERATION_LIMIT


def make_cube(request: ImagingRequest, record: Callable[[CubeResult], dict] | None = None,
              comm: Serial = SERIAL) -> CubeResult:
    """Image a selection of MeasurementSets channel by channel, and write the products.

    Parameters and errors as of :func:`casa_sara.imaging.continuum.make_image`. Ranks share the channels: each reads all
    data and solves its channels by itself, so that these are to the last bit those of one process. Rank 0 has the
    result of all, the others of their own.
    """
    grid, output, deadline = request.grid, request.output, Deadline(request.limits.maxtime_s)
    forecast, _ = forecast_run(request.selection, grid, request.options, request.limits, comm)
    comm.together(forecast.require, request.limits.maxmem_gb)
    checkpoint = CubeCheckpoint(checkpoint_of(request), comm)
    if output.resume:
        comm.together(checkpoint.open)
    # read
    with kernels_loading(log.info):
        data = comm.together(read_visibilities, request.selection, grid.phasecenter, grid.stokes,
                             grid.needs_frequencies)
    if grid.is_mosaic:
        data, grid = comm.together(with_beams, data, request.selection, grid)
        request = replace(request, grid=grid)
    data.notes.extend(check_pointings(data, grid) + image_limits(data, grid))
    cube = CubePlanes.of(request, data, forecast.workload.channels, comm)
    comm.once(check_imagename, output.imagename, cube.plane.pb.shape, 2 * output.pbcor + grid.masked
              + 2 * bool(request.options.ndraws) + request.options.jackknife)
    for note in data.notes:
        log.warn(note)
    # the dirty cube: errors of weights and beams are raised before the long part
    comm.together(_make_dirty, cube, comm)
    # solve
    stopped = 0
    if request.options.niter > 0:
        comm.together(checkpoint.identify, visibilities=data.vis, weights=data.weight, uvw=data.uvw,
                      channels=cube.order, support=cube.support, beam=data.beam)
        deadline.reserve = cube.plane.channels * writing_seconds(0, grid.shape) + after_iterations(
            data.size, (0,), output, request.limits, deadline.elapsed())
        stopped = comm.largest(_solve_channels(cube, checkpoint, deadline, comm))
    cube.gather(comm)
    # write
    tally = Tally(data.size, data.dropped, (*data.notes, *cube.found))
    result = CubeResult(tally, cube.channels, cube.axis.frame, forecast.summary(), stopped)
    if not output.images_stand:
        comm.once(_write, request, cube, record and record(result))
    checkpoint.clear(result.finished)
    if output.savemodel == "modelcolumn":
        comm.once(save_model, request.selection, data, grid, request.options, cube.images["model"], cube.axis)
    return result


def _make_dirty(cube, comm):
    """Make the dirty images of this rank's channels."""
    for k in cube.filled[comm.rank :: comm.size]:
        cube.make_dirty(k)


def _write(request, cube, record):
    """Write the products."""
    with waiting_child(write_images) as child:
        write_products(request.output, cube.plane, cube.products(), [channel.sumwt for channel in cube.channels],
                       cube.beams(), record, child)


def _solve_channels(cube, checkpoint, deadline, comm):
    """Solve this rank's channels one after the other; return the code of what ended that early, 0 where nothing did.

    What ends it on one rank ends it on all.
    """
    own = [k for k in cube.filled[comm.rank :: comm.size] if k in cube.solvable]
    watch = _Deadline(deadline, comm)
    with stop_on_interrupt() as pressed:
        code = _solve_own(cube, own, checkpoint, watch, pressed)
        if code:
            comm.ask_stop(code)
        comm.meet(lambda: pressed() and comm.ask_stop(STOPPED_BY_USER))
    return code


def _solve_own(cube, own, checkpoint, watch, pressed):
    """Solve channels one after the other; return the code of what ended that early."""
    for k in own:
        if pressed() or watch.asked():
            checkpoint.keep(-1, lambda: None, 0, now=True)
            return watch.asked() or STOPPED_BY_USER
        reconstruction = checkpoint.finished.get(k)
        if reconstruction is None:
            of_channel = checkpoint.of(k)
            reconstruction = cube.solve(k, of_channel, watch)
            code = reconstruction.record.stop_code
            if code in UNFINISHED:
                code = reconstruction.record.stop_code = watch.asked() or code
            elif not reconstruction.finished:  # all but its draws
                code = watch.asked() or (STOPPED_BY_USER if pressed() else TIME_LIMIT)
            else:
                code = 0
            if code:
                cube.take(k, reconstruction)
                if not of_channel.kept:
                    checkpoint.keep(-1, lambda: None, 0, now=True)
                return code
            checkpoint.finish(k, reconstruction)
        cube.take(k, reconstruction)
    return 0


class _Deadline:
    """The deadline of a rank: that of the run, or at once where another rank has ended."""

    def __init__(self, deadline, comm):
        self._deadline, self.asked = deadline, comm.stop_asked

    def near(self):
        """Return whether to stop now."""
        return bool(self.asked()) or self._deadline.near()
