"""One image from data to products: read, compute weights, divide into blocks, solve, write."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from casa_sara.casa.images.image_files import read_model
from casa_sara.casa.images.image_plane import ImagePlane, define_image_plane, read_pixels
from casa_sara.casa.images.masks import read_support
from casa_sara.casa.images.products import write_images, write_products
from casa_sara.casa.images.restore import fit_beam
from casa_sara.casa.images.spectral_index import with_spectrum
from casa_sara.casa.ms.block_selection import divide
from casa_sara.casa.ms.model_column import save_model_column, write_model_column
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights, sum_of_weights
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.child_process import waiting_child
from casa_sara.casa.runtime.tools import opened
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.visibilities import BlockInfo, Visibilities, sort_into_blocks
from casa_sara.imaging.data_quality import (
    beyond_baselines,
    check_confined,
    left_outside,
    named_suspects,
    suspects,
    thermal_noise,
)
from casa_sara.imaging.dry_run import forecast_run
from casa_sara.imaging.mosaic import (
    MosaicModel,
    beams_record,
    check_pointings,
    flat_noise,
    w_note,
    weight_image,
    with_beams,
)
from casa_sara.imaging.run_solver import Watch, checkpoint_of, density_of, list_islands, solve_image, without_wild
from casa_sara.imaging.time_forecast import Pace, writing_seconds
from casa_sara.operators.measurement import Summed, check_cell, check_field
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImageGrid, Limits, Output, Selection, SolverOptions, Spectrum, Weighting
from casa_sara.parallel.partition import RankAssignment
from casa_sara.parallel.serial import SERIAL
from casa_sara.reconstruction.compile_cache import kernels_loading
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Reconstruction, operator_accuracy, schedule_of
from casa_sara.runtime.deadline import Deadline
from casa_sara.solver.record import UNFINISHED

__all__ = [
    "PlaneImages", "Result", "Split", "describe", "image_limits", "make_image", "plane_images", "split", "write_column",
]

FEWEST_PIXELS = 3.0  # of the finest fringe
LARGEST_W_PHASE = 0.3  # rad, in the corners of the image
MODEL_COLUMN = 3.0  # times as long as reading, to write it and read it back
REPORT_SECONDS = 30.0
IMAGE_EPS = 1e-6  # accuracy of the PSF, the residual image and the model column


@dataclass
class Result:
    """The results of one run, for the return value of the task.

    `reconstruction` is None when only dirty images were asked for; `noise` is the noise of each block measured
    from the data, relative to the MS weights; `forecast` is the forecast of memory and time made before; `suspects`
    are the blocks of :func:`casa_sara.imaging.data_quality.suspects`. With several ranks, each has its own samples in `data`, and `size`
    is the number of all.
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

    @property
    def finished(self) -> bool:
        """Whether the run is complete, so that a restart has nothing to continue."""
        return self.reconstruction is None or self.reconstruction.record.stop_code not in UNFINISHED


@dataclass
class Split:
    """The samples of one plane in the order of their blocks, and the noise of each block measured from the data."""

    data: Visibilities
    blocks: list[BlockInfo]
    offsets: np.ndarray
    noise: np.ndarray


@dataclass
class PlaneImages:
    """The images of one plane: `pixels` are 'psf', 'residual', 'model' and, of a mosaic, 'weight'; `weights` (M,) made them."""

    pixels: dict[str, np.ndarray]
    weights: np.ndarray
    sumwt: float
    beam: dict

    @property
    def residual_peak(self) -> float:
        """Largest absolute pixel of the residual, Jy/beam."""
        return float(np.abs(self.pixels["residual"]).max())

    @property
    def model_flux(self) -> float:
        """Flux of the model, Jy."""
        return float(self.pixels["model"].sum(dtype=float))


def make_image(selection: Selection, grid: ImageGrid, weighting: Weighting, options: SolverOptions,
               output: Output, record: Callable[[Result], dict] | None = None, limits: Limits = Limits(),
               comm=SERIAL) -> Result:
    """Image a selection of MeasurementSets and write the products.

    Parameters
    ----------
    selection, grid, weighting, options, output
        What the task was asked for.
    record : callable, optional
        Returns what is kept beside the images of the result.
    limits : Limits
    comm : casa_sara.parallel.serial.Serial or MPI
        Ranks that share the work; rank 0 alone writes.

    Raises
    ------
    MemoryError
        The run would not fit; nothing large was allocated.
    ValueError, FileNotFoundError, RuntimeError
        For data or parameters that no image can be made of; the message names the task parameter.
    """
    deadline, (forecast, ranks) = Deadline(limits.maxtime_s), forecast_run(selection, grid, options, limits, comm)
    comm.together(forecast.require, limits.maxmem_gb)
    checkpoint = checkpoint_of(selection, grid, options, output)
    if output.resume:
        comm.once(checkpoint.open)
    request = _Request(selection, grid, weighting, options, output, limits, ranks)
    with waiting_child(write_images) if comm.rank == 0 else nullcontext() as child:  # it starts while CASA reads
        with kernels_loading(log.info):
            data, plane = _read(request)
        if output.images_stand:
            return _complete(request, plane, data, forecast)
        part = split(data, output.blocks, comm)
        del data  # the same samples, not yet sorted
        _check(request, plane, part)
        watch = Watch(deadline, Pace(schedule_of(options).expected_iterations), checkpoint)
        solution = _solve(request, plane, part, watch)
        images = plane_images(solution.part.data, solution.model, plane.grid, weighting, options, plane.image_plane,
                              comm)
        doubtful = _look_back(images, plane, solution, comm)
        result = solution.result(images, doubtful, replace(forecast, iteration_s=watch.pace.seconds), comm)
        comm.once(write_products, output, plane.image_plane, images.pixels, images.sumwt, images.beam,
                  record and record(result), child)
    if comm.bcast(result.finished or not checkpoint.stands):  # else one of an older run
        comm.once(checkpoint.remove)
    if output.savemodel == "modelcolumn":
        comm.once(_save_model, selection, solution.part.data, plane.grid, options, solution.model)
    return result


@dataclass(frozen=True)
class _Request:
    """What the task was asked for, and the ranks that work on it."""

    selection: Selection
    grid: ImageGrid
    weighting: Weighting
    options: SolverOptions
    output: Output
    limits: Limits
    ranks: RankAssignment


@dataclass(frozen=True)
class _Plane:
    """The plane of the image: `grid` is what was asked for, with the spectrum that belongs to the plane.

    `startmodel` real (nx, ny) in Jy/pixel and `support` bool (nx, ny) are None where there is none.
    """

    image_plane: ImagePlane
    grid: ImageGrid
    startmodel: np.ndarray | None
    support: np.ndarray | None = None


@dataclass(frozen=True)
class _Solution:
    """A model and the samples that it was made of; without `reconstruction` it is the one to start from."""

    model: np.ndarray
    part: Split
    reconstruction: Reconstruction | None = None

    def result(self, images, doubtful, forecast, comm):
        """Return what the task tells of it."""
        data, blocks = self.part.data, self.part.blocks
        return Result(data, comm.total(data.size), blocks, self.part.noise, self.reconstruction, images.residual_peak,
                      images.model_flux, forecast.summary(), doubtful)


def _read(request):
    """Return this rank's visibilities, and the plane of the image with its first model and support."""
    grid, output, comm = request.grid, request.output, request.ranks.comm
    frequencies = bool(grid.spectralindex) or grid.is_mosaic
    data = read_visibilities(request.selection, grid.phasecenter, grid.stokes, frequencies, request.ranks)
    data.notes.extend(check_pointings(data, grid))
    if grid.is_mosaic:
        data, grid = with_beams(data, request.selection, grid)
    data.notes.extend(image_limits(data, grid, comm))
    plane = comm.once(define_image_plane, data, request.selection, grid, output.pblimit)
    if grid.is_mosaic:
        plane = plane.of_mosaic(weight_image(data, grid, imaging_weights(data, grid, request.weighting, comm)), output.pblimit)
    data.notes.extend(plane.notes)
    if not plane.mask.any():
        data.notes.append(nowhere_visible(grid, output))
    _caution(data)
    grid = comm.once(with_spectrum, grid, plane)
    start = comm.once(read_model, output.startmodel, plane) if output.startmodel and not output.resume else None
    if output.images_stand:
        return data, _Plane(plane, grid, start)
    support = comm.once(read_support, grid, plane)
    if support is not None and start is not None:
        start *= support
    return data, _Plane(plane, grid, start, support)


def _complete(request, plane, data, forecast):
    """Write the model column that a finished run has not written any more; its images stand."""
    comm, model = request.ranks.comm, plane.startmodel
    comm.once(_save_model, request.selection, data, plane.grid, request.options, model)
    peak = comm.once(_peak, request.output.imagename + ".residual")
    return Result(data, comm.total(data.size), [], np.zeros(0), None, peak, float(model.sum(dtype=float)),
                  forecast.summary())


def _check(request, plane, part):
    """Describe in the log what was read; errors of weights and beam are raised here, before the solver."""
    data, grid, comm = part.data, plane.grid, request.ranks.comm
    describe(data, part.blocks, part.noise, grid.stokes, comm)
    if grid.gridder == "wproject":
        accuracy = operator_accuracy(data, part.offsets, part.noise, comm)
        log.info(WTerm.of(comm.largest(data.max_w), grid.shape, grid.cell_rad, accuracy).words)
    _point_spread(data, grid, request.weighting, request.options, plane.image_plane, comm)


def _solve(request, plane, part, watch):
    """Find the model, within the time that writing leaves, and leave out the samples that it left out."""
    options, grid, ranks = request.options, plane.grid, request.ranks
    comm, data = ranks.comm, part.data
    if options.niter == 0:
        return _Solution(np.zeros(grid.shape, np.float32) if plane.startmodel is None else plane.startmodel, part)
    watch.deadline.reserve = _after_iterations(comm.total(data.size), grid, request.output, request.limits,
                                               watch.deadline.elapsed())
    samples = Samples(data, part.offsets, density_of(data, request.selection, grid, options, comm), part.noise)
    found = solve_image(samples, grid, options, plane.startmodel, watch, plane.support, ranks)
    list_islands(found.record, plane.image_plane, grid.cell_rad, options.significance, comm)
    used, blocks = without_wild(data, part.blocks, part.offsets, found, comm)
    return _Solution(found.model, Split(used, blocks, np.searchsorted(found.kept, part.offsets), part.noise), found)


def _look_back(images, plane, solution, comm):
    """Warn of what is doubtful about data and images; return the suspect blocks, and add the mask to the images."""
    part, pixels, found = solution.part, images.pixels, solution.reconstruction
    data = part.data
    doubtful = suspects(part.blocks, part.noise, found.l2_bounds) if found else []
    for line in named_suspects(part.blocks, doubtful):
        log.warn(line)
    _caution(data, beyond_baselines(pixels["model"], plane.grid.cell_rad, -comm.largest(-data.min_uv)))
    if plane.support is not None:
        pixels["mask"] = check_confined(pixels["model"], plane.support)
        sigma = thermal_noise(data, images.weights, part.noise, part.offsets, comm)
        if "weight" in pixels:  # of flat noise
            sigma /= float(pixels["weight"].max()) ** 0.5
        _caution(data, left_outside(pixels["residual"], plane.support, sigma))
    return doubtful


def split(data, blocks, comm=SERIAL):
    """Sort the samples of a plane into snapshot blocks (`blocks` as of :class:`casa_sara.options.Output`).

    Parameters
    ----------
    data : Visibilities
    blocks : int or tuple of str
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    Split
    """
    block_of_sample, infos = divide(data, blocks, comm)
    data, offsets = sort_into_blocks(data, block_of_sample, len(infos))
    noise = noise_from_differences(data, offsets, comm)
    return Split(data, infos, offsets, noise)


def plane_images(data, model, grid, weighting, options, plane, comm=SERIAL):
    """Return the `PlaneImages` of a model (nx, ny) in Jy/pixel and the samples it was made of.

    Parameters
    ----------
    data : Visibilities
    model : real (nx, ny)
        Jy/pixel.
    grid : ImageGrid
    weighting : Weighting
    options : SolverOptions
        Whose number of threads is used.
    plane : ImagePlane
        For the beam.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    PlaneImages
    """
    weights, operator, psf, beam = _point_spread(data, grid, weighting, options, plane, comm)
    if grid.is_mosaic:
        operator = _operator(data, grid, options, comm)
    residual = dirty_image(operator, data.vis - _predicted(operator, data, grid, options, model, comm), weights, comm)
    pixels = dict(psf=psf, residual=residual, model=model)
    if grid.is_mosaic:
        pixels["weight"] = weight_image(data, grid, weights)
        pixels["residual"] = flat_noise(residual, pixels["weight"])
    if grid.is_cube and weighting.weighting == "uniform":  # tclean's density of a channel counts the correlations, too
        sumwt = float(weights.sum(dtype=float))
    else:
        sumwt = sum_of_weights(data, weights, grid.stokes)
    return PlaneImages(pixels, weights, comm.total(sumwt), beam)


def _caution(data, notes=None):
    """Warn of these notes, which the record keeps too, or of those that are there."""
    for note in data.notes if notes is None else notes:
        log.warn(note)
    data.notes.extend(notes or [])


def _save_model(selection, data, grid, options, model):
    """Write the model's visibilities into the MeasurementSets: the last phase, after the images are complete."""
    log.info("writing MODEL_DATA")
    save_model_column(selection.vis, write_column, selection=asdict(selection), phase_center=data.phase_center,
                      cell_rad=grid.cell_rad, gridder=grid.gridder, spectrum=grid.spectrum and asdict(grid.spectrum),
                      nthreads=options.nthreads, model=model, beams=beams_record(data, grid) if grid.is_mosaic else None)


def write_column(selection, phase_center, cell_rad, gridder, spectrum, nthreads, model, beams=None):
    """Predict the visibilities of a model and write them: what `save_model_column` has a child process do."""
    selection = Selection(**{name: tuple(value) if isinstance(value, list) else value for name, value in selection.items()})
    grid = ImageGrid(model.shape, tuple(cell_rad), gridder=gridder, spectrum=spectrum and Spectrum(**spectrum))
    accuracy = dict(eps=IMAGE_EPS, nthreads=nthreads)
    if beams is not None:
        predict = MosaicModel(model, grid, selection, phase_center, beams, accuracy)
        write_model_column(selection, phase_center, predict, by_row=True)
        return
    write_model_column(selection, phase_center,
                       lambda uvw, freq_hz: sky_operator(uvw, grid, freq_hz, **accuracy).forward(model))


def _peak(name):
    """Return the largest absolute pixel of an existing image."""
    with opened("image", name) as ia:
        return float(np.abs(read_pixels(ia)).max())


def _predicted(operator, data, grid, options, model, comm):
    """Return the visibilities of a model, by the operator of the dirty images unless there is a spectrum."""
    if grid.spectrum is not None:
        operator = sky_operator(data.uvw, grid, data.freq_hz, eps=IMAGE_EPS, nthreads=options.nthreads, comm=comm,
                                beam=data.beam)
    return operator.forward(model)


def _operator(data, grid, options, comm):
    """Return the operator of the dirty images, for flat spectra."""
    return Summed(sky_operator(data.uvw, grid, eps=IMAGE_EPS, nthreads=options.nthreads, comm=comm, beam=data.beam), comm)


def _point_spread(data, grid, weighting, options, plane, comm):
    """Return the imaging weights, the operator of the dirty images, the PSF and the beam fitted to it.

    The PSF of a mosaic is that of all samples without their primary beams.
    """
    weights = imaging_weights(data, grid, weighting, comm)
    operator = _operator(data, replace(grid, gridder="standard", mosaic=None) if grid.is_mosaic else grid, options, comm)
    psf = dirty_image(operator, np.ones(data.size, np.complex64), weights, comm)
    return weights, operator, psf, comm.once(fit_beam, psf, plane)


def image_limits(data, grid, comm=SERIAL):
    """Return warnings about this image plane and these baselines; raise where no image can be made of them."""
    notes = []
    reach = [[comm.largest(float(np.abs(axis).max(initial=0)))] for axis in data.uvw[:2]]
    max_uv, max_w = comm.largest(data.max_uv), comm.largest(data.max_w)
    check_cell(np.array(reach), grid.cell_rad)
    check_field(max_uv, grid.shape, grid.cell_rad)
    arcsec = np.degrees(grid.cell_rad[0]) * 3600
    pixels = 1 / (max_uv * max(grid.cell_rad))
    if pixels < FEWEST_PIXELS:
        notes.append(f"cell = '{arcsec:.4g}arcsec' gives the finest fringe {pixels:.2g} pixels: below {FEWEST_PIXELS:g} "
                     f"sources between pixels cannot be represented; 5 would be cell = '{arcsec * pixels / 5:.3g}arcsec'")
    if grid.is_mosaic:
        return notes + w_note(data, grid.mosaic, LARGEST_W_PHASE)
    corner_sq = 0.25 * sum((n * cell) ** 2 for n, cell in zip(grid.shape, grid.cell_rad))
    phase = np.pi * max_w * corner_sq
    if phase > LARGEST_W_PHASE and grid.gridder == "standard":
        notes.append(f"the w-term is not modelled: it changes phases by up to {phase:.2g} rad in the corners of this image; "
                     "gridder = 'wproject' models it")
    return notes


def _after_iterations(samples, grid, output, limits, read_s):
    """Seconds to reserve for the time after the iterations: images, model column, report."""
    column = MODEL_COLUMN * read_s if output.savemodel == "modelcolumn" else 0.0
    return writing_seconds(samples, grid.shape) + column + (REPORT_SECONDS if limits.report else 0.0)


def nowhere_visible(grid, output):
    """Return the warning about an image whose pixels are masked everywhere."""
    return (f"phasecenter = '{grid.phasecenter}': the primary beam is below pblimit = {output.pblimit:g} in the whole image, so "
            "all of its pixels are masked")


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
