"""One image from data to products: read, compute weights, divide into blocks, solve, write."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.casa.images.image_files import read_model, read_spectra
from casa_sara.casa.images.image_plane import ImagePlane, define_image_plane, read_pixels, relative_pb
from casa_sara.casa.images.masks import read_support
from casa_sara.casa.images.products import write_images, write_products
from casa_sara.casa.images.restore import restored_beam
from casa_sara.casa.images.spectral_index import with_spectrum
from casa_sara.casa.ms.block_selection import divide
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import imaging_weights
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.child_process import waiting_child
from casa_sara.casa.runtime.tools import opened
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.visibilities import BlockInfo, Visibilities, sort_into_blocks
from casa_sara.imaging.data_quality import (
    beyond_baselines,
    check_confined,
    image_limits,
    left_outside,
    named_suspects,
    nowhere_visible,
    suspects,
    thermal_noise,
)
from casa_sara.imaging.dry_run import forecast_run, scratch_of
from casa_sara.imaging.error_images import error_images
from casa_sara.imaging.island_list import list_islands
from casa_sara.imaging.mosaic import check_pointings, weight_image, with_beams
from casa_sara.imaging.outliers import (
    OutlierPlane,
    OutlierResult,
    joint_start,
    joint_support,
    outlier_images,
    outlier_planes,
    with_islands,
    with_turns,
    write_outliers,
)
from casa_sara.imaging.plane_images import plane_images, point_spread
from casa_sara.imaging.predict_model import save_model
from casa_sara.imaging.run_solver import (
    Watch,
    checkpoint_of,
    density_of,
    expected_iterations,
    solve_image,
    without_wild,
)
from casa_sara.imaging.spectra import divided_by_band, seen_draws, spectral_images, with_subbands
from casa_sara.imaging.time_forecast import Pace, error_seconds, writing_seconds
from casa_sara.imaging.total_power import total_power
from casa_sara.operators.outliers import rotation, stacked
from casa_sara.operators.subbands import Subbands
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImageGrid, ImagingRequest, images_in, stacked_shape
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.settings import operator_accuracy
from casa_sara.reconstruction.total_power import TotalPower
from casa_sara.runtime.deadline import Deadline

__all__ = [
    "Plane", "Result", "Split", "after_iterations", "caution", "describe", "make_image", "read_data", "split",
]

MODEL_COLUMN = 3.0  # times as long as reading, to write it and read it back
REPORT_SECONDS = 30.0


@dataclass
class Result:
    """The results of one run, for the return value of the task.

    `reconstruction` is None when only dirty images were asked for; `noise` is the noise of each block measured
    from the data, relative to the MS weights; `forecast` is the forecast of memory and time made before; `suspects`
    are the blocks of :func:`casa_sara.imaging.data_quality.suspects`; `subbands` are those of unknown spectra, and
    `outliers` what was found in the images elsewhere. With several ranks, each has its own samples in `data`, and
    `size` is the number of all.
    """

    data: Visibilities
    size: int
    blocks: list[BlockInfo]
    noise: np.ndarray
    reconstruction: Reconstruction | None
    residual_peak: float
    model_flux: float
    forecast: dict
    suspects: list = field(default_factory=list)
    subbands: Subbands | None = None
    outliers: list[OutlierResult] = field(default_factory=list)

    @property
    def finished(self) -> bool:
        """Whether the run is complete, so that a restart has nothing to continue."""
        return self.reconstruction is None or self.reconstruction.finished


@dataclass
class Split:
    """The samples of one plane in the order of their blocks, and the noise of each block measured from the data."""

    data: Visibilities
    blocks: list[BlockInfo]
    offsets: np.ndarray
    noise: np.ndarray


def make_image(request: ImagingRequest, record: Callable[[Result], dict] | None = None,
               comm: Serial = SERIAL) -> Result:
    """Image a selection of MeasurementSets and write the products.

    Parameters
    ----------
    request : casa_sara.options.ImagingRequest
        What the task was asked for.
    record : callable, optional
        Returns what is kept beside the images of the result.
    comm : casa_sara.parallel.serial.Serial or MPI
        Ranks that share the work; rank 0 alone writes.

    Returns
    -------
    Result

    Raises
    ------
    MemoryError
        The run would not fit; nothing large was allocated.
    ValueError, FileNotFoundError, RuntimeError
        For data or parameters that no image can be made of; the message names the task parameter.
    """
    output, deadline = request.output, Deadline(request.limits.maxtime_s)
    forecast, ranks = forecast_run(request.selection, request.grid, request.options, request.limits, comm,
                                   output.blocks, disk=not request.single_dish.image)
    comm.together(forecast.require, request.limits.maxmem_gb)
    checkpoint = checkpoint_of(request)
    if output.resume:
        comm.once(checkpoint.open)
    with waiting_child(write_images) if comm.rank == 0 else nullcontext() as child:  # it starts while CASA reads
        with kernels_loading(log.info):
            data, plane = read_data(request, ranks, scratch_of(output.imagename, forecast.workload))
        if output.images_stand:
            return _complete(request, plane, data, forecast, comm)
        part = split(data, output.blocks, comm, plane.grid.subbands, plane.grid.outliers)
        del data  # the same samples, not yet sorted
        _check(request, plane, part, comm)
        watch = Watch(deadline, Pace(expected_iterations(request.options)), checkpoint)
        solution = _solve(request, plane, part, watch, ranks)
        images = plane_images(solution.part.data, solution.seen, plane.grid, request.weighting, request.options,
                              plane.image_plane, comm)
        images.pixels["model"] = solution.model
        others = outlier_images(plane.outliers, solution, images, request.options)
        doubtful = _look_back(images, plane, solution, comm)
        forecast = replace(forecast, iteration_s=watch.pace.seconds)
        result = solution.result(images, doubtful, forecast, plane.grid.subbands, comm)
        result.outliers = others
        write_outliers(output, plane.outliers, others)
        comm.once(_write, request, plane, images, solution, record and record(result), child)
    if comm.bcast(result.finished or not checkpoint.stands):  # else one of an older run
        comm.once(checkpoint.remove)
    if output.savemodel == "modelcolumn":
        comm.once(save_model, request.selection, solution.part.data, plane.grid, request.options, solution.seen)
    return result


@dataclass(frozen=True)
class Plane:
    """The plane of the image: `grid` is what was asked for, with the spectrum that belongs to the plane.

    `startmodel` real (nx, ny) in Jy/pixel, or (S, nx, ny) of several Stokes parameters, `support` bool (nx, ny) and
    `dish`, what a single dish tells of the sky, are None where there is none; the first is of the image and its
    `outliers` together, stacked, where there are some.
    """

    image_plane: ImagePlane
    grid: ImageGrid
    startmodel: np.ndarray | None
    support: np.ndarray | None = None
    dish: TotalPower | None = None
    outliers: tuple[OutlierPlane, ...] = ()

    @property
    def stacked_support(self):
        """The support of the image and its outliers together."""
        return joint_support(self.support, self.grid, self.outliers)


@dataclass(frozen=True)
class _Solution:
    """A model and the samples that it was made of; without `reconstruction` it is the one to start from.

    `outliers` are the models of the outliers, and `islands` of each what was found in it.
    """

    model: np.ndarray
    part: Split
    reconstruction: Reconstruction | None = None
    outliers: Sequence[np.ndarray] = ()
    islands: Sequence[list] = ()

    @property
    def stacked(self):
        """The model, in one array with those of the outliers."""
        return stacked([self.model, *self.outliers]) if self.outliers else self.model

    @property
    def seen(self):
        """The same, at all frequencies that were solved for where these are several."""
        spectra = self.reconstruction and self.reconstruction.spectra
        return self.stacked if spectra is None else spectra

    def result(self, images, doubtful, forecast, subbands, comm):
        """Return what the task tells of it."""
        data, blocks = self.part.data, self.part.blocks
        return Result(data, comm.total(data.size), blocks, self.part.noise, self.reconstruction, images.residual_peak,
                      images.model_flux, forecast.summary(), doubtful, subbands)


def read_data(request, ranks, scratch):
    """Return this rank's visibilities, and the plane of the image with its first model and support.

    Parameters
    ----------
    request : ImagingRequest
        What the task was asked for.
    ranks : casa_sara.parallel.partition.RankAssignment
        The ranks that read.
    scratch : casa_sara.runtime.scratch.Scratch
        Where the samples go.

    Returns
    -------
    data : Visibilities
    plane : Plane
        Of several Stokes parameters that of the first, with the first models of all.
    """
    grid, output, comm = request.grid, request.output, ranks.comm
    frequencies = grid.needs_frequencies
    data = read_visibilities(request.selection, grid.phasecenter, grid.stokes, frequencies, ranks, scratch)
    data.notes.extend(check_pointings(data, grid))
    if grid.is_mosaic:
        data, grid = with_beams(data, request.selection, grid, comm)
    data.notes.extend(image_limits(data, grid, comm))
    plane = comm.once(define_image_plane, data, request.selection, grid, output.pblimit)
    grid = with_turns(grid, data)
    outliers = outlier_planes(request, data, grid)
    if grid.is_mosaic:
        weights = imaging_weights(data, grid, request.weighting, comm)
        plane = plane.of_mosaic(weight_image(data, grid, weights, comm), output.pblimit)
    dish = total_power(request.single_dish, data, plane, grid)
    data.notes.extend(plane.notes)
    if not plane.mask.any():
        data.notes.append(nowhere_visible(grid, output))
    caution(data)
    grid = comm.once(with_spectrum, with_subbands(grid, data, plane), plane)
    start = joint_start(comm.once(_startmodel, output, plane, grid.stokes), grid, outliers)
    if output.images_stand:
        return data, Plane(plane, grid, start)
    found = Plane(plane, grid, start, comm.once(read_support, grid, plane), dish, outliers)
    if found.stacked_support is not None and start is not None:
        start *= found.stacked_support
    return data, found


def _startmodel(output, plane, stokes):
    """Return the first model, of each of several Stokes parameters; None where there is none."""
    if not output.startmodel or output.resume:
        return None
    if len(stokes) == 1:
        return read_model(output.startmodel, plane)
    return np.array([read_model(output.startmodel, plane.of_stokes(stokes), number) for number in range(len(stokes))])


def _complete(request, plane, data, forecast, comm):
    """Write the model column that a finished run has not written any more; its images stand."""
    model = seen = plane.startmodel
    spectra = request.output.imagename + ".subbands"
    if plane.grid.subbands is not None and os.path.exists(spectra):
        _, seen = read_spectra(spectra)
    comm.once(save_model, request.selection, data, plane.grid, request.options, seen)
    peak = comm.once(_peak, request.output.imagename + ".residual")
    return Result(data, comm.total(data.size), [], np.zeros(0), None, peak, float(model.sum(dtype=float)),
                  forecast.summary())


def _check(request, plane, part, comm):
    """Describe in the log what was read; errors of weights and beam are raised here, before the solver."""
    data, grid = part.data, plane.grid
    describe(data, part.blocks, part.noise, grid.stokes, comm)
    if grid.gridder == "wproject":
        accuracy = operator_accuracy(data, part.offsets, part.noise, comm)
        log.info(WTerm.of(comm.largest(data.max_w), grid.shape, grid.cell_rad, accuracy).words)
    point_spread(data, grid, request.weighting, request.options, plane.image_plane, comm)


def _solve(request, plane, part, watch, ranks):
    """Find the model, within the time that writing leaves, and leave out the samples that it left out."""
    options, grid, comm, data = request.options, plane.grid, ranks.comm, part.data
    if options.niter == 0:
        start = np.zeros(stacked_shape(grid.shapes), np.float32) if plane.startmodel is None else plane.startmodel
        main, *others = map(np.ascontiguousarray, images_in(start, grid.shapes))
        return _Solution(main, part, outliers=others, islands=[[]] * len(others))
    watch.deadline.reserve = after_iterations(comm.total(data.size), grid.shape, request.output, request.limits,
                                              watch.deadline.elapsed()) + error_seconds(options, grid.shape)
    samples = Samples(data, part.offsets, density_of(data, request.selection, grid, options, comm), part.noise,
                      total_power=plane.dish)
    found = solve_image(samples, grid, options, plane.startmodel, watch, plane.stacked_support, ranks)
    islands = with_islands(found.record, plane.outliers, options.significance)
    list_islands(found.record, plane.image_plane, grid.cell_rad, options.significance, comm)
    used, blocks = without_wild(data, part.blocks, part.offsets, found, comm)
    return _Solution(found.model, Split(used, blocks, np.searchsorted(found.kept, part.offsets), part.noise), found,
                     found.outliers, islands)


def _look_back(images, plane, solution, comm):
    """Warn of what is doubtful about data and images; return the suspect blocks, and add the mask to the images."""
    part, pixels, found = solution.part, images.pixels, solution.reconstruction
    data = part.data
    doubtful = suspects(part.blocks, part.noise, found.l2_bounds) if found else []
    for line in named_suspects(part.blocks, doubtful):
        log.warn(line)
    if plane.dish is None:
        caution(data, beyond_baselines(pixels["model"], plane.grid.cell_rad, -comm.largest(-data.min_uv)))
    if plane.support is not None:
        pixels["mask"] = check_confined(pixels["model"], plane.support)
        sigma = thermal_noise(data, images.weights, part.noise, part.offsets, comm)
        if "weight" in pixels:  # of flat noise
            sigma /= float(pixels["weight"].max()) ** 0.5
        caution(data, left_outside(pixels["residual"], plane.support, sigma))
    return doubtful


def _write(request, plane, images, solution, record, child):
    """Write the products, with the errors that the draws give."""
    reconstruction = solution.reconstruction
    draws, jackknife = seen_draws(reconstruction, plane.grid) if reconstruction else (None, None)
    weight = images.pixels.get("weight")
    pb = None if weight is None else relative_pb(weight)
    errors = error_images(draws, jackknife, images.beam, request.output.restoringbeam, plane.grid.cell_rad, pb)
    if "model.error" in errors:
        errors["draws"] = draws.arrays()
    if reconstruction and reconstruction.spectra is not None:
        beam = restored_beam(list(request.output.restoringbeam or ()), images.beam)
        errors |= spectral_images(reconstruction, plane.grid, solution.part.data, beam)
    write_products(request.output, plane.image_plane, images.pixels | errors, images.sumwt, images.beam, record, child)


def split(data, blocks, comm=SERIAL, subbands=None, outliers=()):
    """Sort the samples of a plane into snapshot blocks (`blocks` as of :class:`casa_sara.options.Output`).

    Parameters
    ----------
    data : Visibilities
        The samples.
    blocks : int or tuple of str
        As of :class:`casa_sara.options.Output`.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.
    subbands : Subbands, optional
        Parts of the band that have blocks of their own.
    outliers : sequence of Outlier
        What they hold is no noise either.

    Returns
    -------
    Split
    """
    block_of_sample, infos = divided_by_band(*divide(data, blocks, comm), data, subbands)
    data, offsets = sort_into_blocks(data, block_of_sample, len(infos))
    noise = noise_from_differences(data, offsets, comm, [rotation(data.uvw, outlier) for outlier in outliers])
    return Split(data, infos, offsets, noise)


def caution(data, notes=None):
    """Warn of these notes, which the record keeps too, or of those that are there.

    Parameters
    ----------
    data : Visibilities
        Whose notes are those of the record.
    notes : list of str, optional
        New ones.
    """
    for note in data.notes if notes is None else notes:
        log.warn(note)
    data.notes.extend(notes or [])


def _peak(name):
    """Return the largest absolute pixel of an existing image."""
    with opened("image", name) as ia:
        return float(np.abs(read_pixels(ia)).max())


def after_iterations(samples, shape, output, limits, read_s):
    """Seconds to reserve for the time after the iterations: images, model column, report."""
    column = MODEL_COLUMN * read_s if output.savemodel == "modelcolumn" else 0.0
    return writing_seconds(samples, shape) + column + (REPORT_SECONDS if limits.report else 0.0)


def describe(data, blocks, noise, stokes, comm=SERIAL):
    """Write to the log what was read: the visibilities, those left out, and the blocks with their noise."""
    log.info(f"{comm.total(data.size)} Stokes {stokes} visibilities, longest baseline "
             f"{comm.largest(data.max_uv) / 1e3:.4g} klambda, "
             f"{len(blocks)} data blocks")
    for reason, count in data.dropped.items():
        log.info(f"left out: {count} visibilities, {reason}")
    for j, (block, level) in enumerate(zip(blocks, noise)):
        measured = f"thermal noise {level:#.3g} x MS weights" if np.isfinite(level) \
            else "too few integrations to measure the thermal noise"
        log.info(f"block {j}: {block.label}; {measured}")
