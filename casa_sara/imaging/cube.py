"""A spectral cube: read the data, sort them by channel, and image one channel after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.images.image_files import read_model
from casa_sara.casa.images.image_plane import ImagePlane, define_image_plane
from casa_sara.casa.images.products import check_imagename, write_images, write_products
from casa_sara.casa.images.spectral_axis import SpectralAxis, channels_of
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.child_process import waiting_child
from casa_sara.data.visibilities import Visibilities
from casa_sara.imaging.continuum import Result, describe, split
from casa_sara.imaging.cube_checkpoint import CubeCheckpoint
from casa_sara.imaging.data_quality import image_limits, nowhere_visible
from casa_sara.imaging.dry_run import forecast_run
from casa_sara.imaging.island_list import list_islands
from casa_sara.imaging.mosaic import check_pointings
from casa_sara.imaging.plane_images import plane_images
from casa_sara.imaging.run_solver import Watch, checkpoint_of, density_of, solve_image, without_wild
from casa_sara.imaging.time_forecast import Pace, writing_seconds
from casa_sara.options import ImagingRequest
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.settings import check_l2bound, schedule_of
from casa_sara.runtime.deadline import Deadline
from casa_sara.runtime.signals import stop_on_interrupt
from casa_sara.solver.record import CONVERGED, ITERATION_LIMIT, NOISE_ONLY, STOPPED_BY_USER, UNFINISHED

__all__ = ["Channel", "CubeResult", "make_cube"]


@dataclass(frozen=True)
class Tally:
    """The number of samples of a channel, and of those left out."""

    size: int
    dropped: dict[str, int]
    notes: tuple[str, ...] = ()


@dataclass
class Channel:
    """One channel: its frequency in the frame of the axis, and what was found; a blank one has no result, no beam."""

    freq_hz: float
    result: Result | None = None
    sumwt: float = 0.0
    beam: dict | None = None


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
        solved = [channel.result.reconstruction for channel in self.channels if channel.result]
        codes = [one.record.stop_code if one else ITERATION_LIMIT for one in solved]
        return next((code for code in codes if code not in (CONVERGED, NOISE_ONLY)), CONVERGED)


def make_cube(request: ImagingRequest, record: Callable[[CubeResult], dict] | None = None) -> CubeResult:
    """Image a selection of MeasurementSets channel by channel, and write the products.

    Parameters and errors as of :func:`casa_sara.imaging.continuum.make_image`.
    """
    grid, output, deadline = request.grid, request.output, Deadline(request.limits.maxtime_s)
    forecast, _ = forecast_run(request.selection, grid, request.options, request.limits)
    forecast.require(request.limits.maxmem_gb)
    checkpoint = CubeCheckpoint(checkpoint_of(request))
    if output.resume:
        checkpoint.file.open()
    # read
    with kernels_loading(log.info):
        data = read_visibilities(request.selection, grid.phasecenter, grid.stokes)
    data.notes.extend(check_pointings(data, grid) + image_limits(data, grid))
    cube = _Cube.of(request, data, forecast.workload.channels)
    check_imagename(output.imagename, cube.plane.pb.shape, 2 * output.pbcor)
    for note in data.notes:
        log.warn(note)
    # the dirty cube: errors of weights and beams are raised before the long part
    for k in cube.filled:
        cube.make_dirty(k)
    # solve
    stopped = 0
    if request.options.niter > 0:
        checkpoint.identify(visibilities=data.vis, weights=data.weight, uvw=data.uvw, channels=cube.order)
        deadline.reserve = cube.plane.channels * writing_seconds(0, grid.shape) + writing_seconds(data.size, (0,))
        stopped = _solve_channels(cube, checkpoint, deadline)
    # write
    tally = Tally(data.size, data.dropped, tuple(data.notes))
    result = CubeResult(tally, cube.channels, cube.axis.frame, forecast.summary(), stopped)
    with waiting_child(write_images) as child:
        write_products(output, cube.plane, cube.images, [channel.sumwt for channel in cube.channels], cube.beams(),
                       record and record(result), child)
    if result.finished or not checkpoint.file.stands:  # else one of an older run
        checkpoint.file.remove()
    return result


def _solve_channels(cube, checkpoint, deadline):
    """Solve one channel after the other; return the code of what ended that early, 0 where nothing did."""
    with stop_on_interrupt() as pressed:
        for k in cube.filled:
            if pressed():
                checkpoint.keep(-1, lambda: None, 0, now=True)
                return STOPPED_BY_USER
            reconstruction = checkpoint.finished.get(k)
            if reconstruction is None:
                of_channel = checkpoint.of(k)
                reconstruction = cube.solve(k, of_channel, deadline)
                code = reconstruction.record.stop_code
                if code in UNFINISHED:
                    cube.take(k, reconstruction)
                    if not of_channel.kept:
                        checkpoint.keep(-1, lambda: None, 0, now=True)
                    return code
                checkpoint.finish(k, reconstruction)
            cube.take(k, reconstruction)
    return 0


@dataclass
class _Cube:
    """The images of all channels so far: `images` are 'psf', 'residual' and 'model', float32 (nchan, nx, ny)."""

    request: ImagingRequest
    data: Visibilities
    plane: ImagePlane
    axis: SpectralAxis
    order: np.ndarray
    first: np.ndarray
    channels: list[Channel]
    images: dict[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, request, data, planes):
        """Lay out the axis and sort the samples by channel; there are no images yet."""
        plane = define_image_plane(data, request.selection, request.grid, request.output.pblimit, planes)
        data.notes.extend(plane.notes)
        if not plane.mask.any():
            data.notes.append(nowhere_visible(request.grid, request.output))
        axis = SpectralAxis.of(plane)
        channel = channels_of(data, request.selection, axis)
        order = np.argsort(channel, kind="stable")
        first = np.searchsorted(channel[order], np.arange(axis.size + 1))
        blank = np.diff(first) == 0
        if blank.all():
            grid = request.grid
            raise ValueError(f"start = {grid.start!r}, width = {grid.width!r}, nchan = {grid.nchan}: no usable "
                             "visibility is in these channels")
        if blank.any():
            numbers = ", ".join(map(str, np.flatnonzero(blank)))
            data.notes.append(f"channels {numbers} are blank: they have no usable visibilities")
        if first[0]:
            log.info(f"{first[0]} visibilities are in none of the {axis.size} image channels")
        plane = replace(plane, mask=plane.mask & ~blank[:, None, None])
        images = {name: np.zeros(plane.pb.shape, np.float32) for name in ("psf", "residual", "model")}
        return cls(request, data, plane, axis, order, first, [Channel(float(freq)) for freq in axis.freqs_hz], images)

    @property
    def filled(self):
        """The numbers of the channels that have samples."""
        return np.flatnonzero(np.diff(self.first)).tolist()

    def make_dirty(self, k):
        """Make the images of a channel from its first model, which is empty where none is given."""
        log.info(f"dirty image of channel {k} (of {self.axis.size} channels), {self.channels[k].freq_hz / 1e9:.9g} GHz "
                 f"{self.axis.frame}")
        start = self._startmodel(k)
        model = start if start is not None else np.zeros(self.plane.shape, np.float32)
        try:
            part = self._split(k)
            describe(part.data, part.blocks, part.noise, self.request.grid.stokes)
            check_l2bound(self.request.options, len(part.blocks))
            self._fill(k, part.data, part.blocks, part.noise, None, model)
        except ValueError as error:
            raise ValueError(f"channel {k}, {self.channels[k].freq_hz / 1e9:.9g} GHz: {error}") from error

    def solve(self, k, checkpoint, deadline):
        """Return the solution of a channel."""
        log.info(f"reconstructing channel {k} (of {self.axis.size} channels)")
        part, request = self._split(k), self.request
        density = density_of(part.data, None, request.grid, request.options)
        samples = Samples(part.data, part.offsets, density, part.noise)
        watch = Watch(deadline, Pace(schedule_of(request.options).expected_iterations), checkpoint)
        return solve_image(samples, request.grid, request.options, self._startmodel(k), watch)

    def take(self, k, reconstruction):
        """Make the images of a channel from its solution."""
        part, request = self._split(k), self.request
        list_islands(reconstruction.record, self.plane, request.grid.cell_rad, request.options.significance)
        data, blocks = without_wild(part.data, part.blocks, part.offsets, reconstruction)
        self._fill(k, data, blocks, part.noise, reconstruction, reconstruction.model)

    def beams(self):
        """Return the beam of each channel; a blank one has that of the nearest that is not."""
        filled = np.array(self.filled)
        return [self.channels[filled[np.abs(filled - k).argmin()]].beam for k in range(self.axis.size)]

    def _split(self, k):
        samples = self.data.part(self.order[self.first[k] : self.first[k + 1]])
        return split(replace(samples, dropped={}, notes=[]), self.request.output.blocks)

    def _startmodel(self, k):
        output = self.request.output
        return read_model(output.startmodel, self.plane, k) if output.startmodel and not output.resume else None

    def _fill(self, k, data, blocks, noise, reconstruction, model):
        request, channel = self.request, self.channels[k]
        found = plane_images(data, model, request.grid, request.weighting, request.options, self.plane)
        for name, pixels in found.pixels.items():
            self.images[name][k] = pixels
        channel.sumwt, channel.beam = found.sumwt, found.beam
        channel.result = Result(Tally(data.size, data.dropped), data.size, blocks, noise, reconstruction,
                                found.residual_peak,
                                found.model_flux, {})
