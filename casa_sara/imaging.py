"""The story of one image: read, weigh, split, solve, write."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, replace

import numpy as np

from casa_sara.casa import log
from casa_sara.casa.blockwords import divide
from casa_sara.casa.child import waiting_child
from casa_sara.casa.imageplane import define_image_plane, read_pixels
from casa_sara.casa.images import read_model
from casa_sara.casa.modelcolumn import save_model_column, write_model_column
from casa_sara.casa.ms import read_visibilities
from casa_sara.casa.products import write_products
from casa_sara.casa.restore import fit_beam
from casa_sara.casa.spectrum import with_spectrum
from casa_sara.casa.support import read_support
from casa_sara.casa.tools import opened
from casa_sara.casa.weights import dirty_image, imaging_weights, sum_of_weights
from casa_sara.cautions import beyond_baselines, check_confined, left_outside, named_suspects, suspects, thermal_noise
from casa_sara.deadline import Deadline
from casa_sara.noise import noise_from_differences
from casa_sara.operators.measurement import Summed, check_cell, check_field
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImageGrid, Limits, Output, Selection, SolverOptions, Spectrum, Weighting
from casa_sara.parallel import SERIAL
from casa_sara.reconstruction import Reconstruction, operator_accuracy, schedule_of
from casa_sara.rehearsal import foresee
from casa_sara.solver.record import UNFINISHED
from casa_sara.solving import Watch, checkpoint_of, list_islands, solve_image, without_wild
from casa_sara.timing import Pace, writing_seconds
from casa_sara.visibilities import BlockInfo, Visibilities, sort_into_blocks
from casa_sara.warmup import kernels_loading

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
    """What one run found, for the return value of the task.

    `reconstruction` is None when only dirty images were asked for; `noise` is the noise of each block measured
    from the data, in units of what the weights say; `forecast` is what was said of memory and time before; `suspects`
    are the blocks of :func:`casa_sara.cautions.suspects`. Of several ranks each has its own samples in `data`; `size` is
    the number of all.
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
        """Whether there is nothing left for a restart to go on with."""
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
    """The images of one plane: `pixels` are 'psf', 'residual' and 'model', float32 (nx, ny); `weights` (M,) made them."""

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
    comm : casa_sara.parallel.Serial or MPI
        Ranks that share the work; rank 0 alone writes.

    Raises
    ------
    MemoryError
        The run would not fit; nothing large was allocated.
    ValueError, FileNotFoundError, RuntimeError
        For data or parameters that no image can be made of; the message names the task parameter.
    """
    deadline, (forecast, crew) = Deadline(limits.maxtime_s), foresee(selection, grid, options, limits, comm)
    comm.together(forecast.require, limits.maxmem_gb)
    checkpoint = checkpoint_of(selection, grid, options, output)
    if output.resume:
        comm.once(checkpoint.open)
    with waiting_child() if comm.rank == 0 else nullcontext() as child:  # it starts while CASA reads
        # read
        with kernels_loading(log.info):
            data, plane, grid = _read(selection, grid, output, crew)
        start = comm.once(read_model, output.startmodel, plane) if output.startmodel and not output.resume else None
        if output.images_stand:
            comm.once(_save_model, selection, data, grid, options, start)
            return Result(data, comm.total(data.size), [], np.zeros(0), None, comm.once(_peak, output.imagename + ".residual"),
                          float(start.sum(dtype=float)), forecast.summary())
        support = comm.once(read_support, grid, plane)
        if support is not None and start is not None:
            start *= support
        # split and weigh
        part = split(data, output.blocks, comm)
        data, blocks, offsets, noise = part.data, part.blocks, part.offsets, part.noise
        describe(data, blocks, noise, grid.stokes, comm)
        if grid.gridder == "wproject":
            accuracy = operator_accuracy(data, offsets, noise, comm)
            log.info(WTerm.of(comm.largest(data.max_w), grid.shape, grid.cell_rad, accuracy).words)
        _point_spread(data, grid, weighting, options, plane, comm)  # what cannot be weighed or restored is refused now
        # solve
        reconstruction, model = None, start if start is not None else np.zeros(grid.shape, np.float32)
        if options.niter > 0:
            deadline.reserve = _after_iterations(comm.total(data.size), grid, output, limits, deadline.elapsed())
            watch = Watch(deadline, Pace(schedule_of(options).expected_iterations))
            reconstruction = solve_image(data, offsets, noise, selection, grid, options, start, checkpoint, watch, support,
                                         crew)
            forecast = replace(forecast, iteration_s=watch.pace.seconds)
            model = reconstruction.model
            list_islands(reconstruction.record, plane, grid.cell_rad, options.significance, comm)
            data, blocks = without_wild(data, blocks, offsets, reconstruction, comm)
            offsets = np.searchsorted(reconstruction.kept, offsets)
        # write
        images = plane_images(data, model, grid, weighting, options, plane, comm)
        doubtful = _look_back(images, support, reconstruction, Split(data, blocks, offsets, noise), grid, comm)
        result = Result(data, comm.total(data.size), blocks, noise, reconstruction, images.residual_peak, images.model_flux,
                        forecast.summary(), doubtful)
        comm.once(write_products, output, plane, images.pixels, images.sumwt, images.beam, record and record(result), child)
    if comm.broadcast(result.finished or not checkpoint.stands):  # else one of an older run
        comm.once(checkpoint.remove)
    if output.savemodel == "modelcolumn":
        comm.once(_save_model, selection, data, grid, options, model)
    return result


def _read(selection, grid, output, crew):
    """Return this rank's visibilities, the image plane, and the grid with the spectrum that it asks for."""
    comm = crew.comm
    data = read_visibilities(selection, grid.phasecenter, grid.stokes, bool(grid.spectralindex), crew)
    data.notes.extend(image_limits(data, grid, comm))
    plane = comm.once(define_image_plane, data, selection, grid, output.pblimit)
    if not plane.mask.any():
        data.notes.append(nowhere_visible(grid, output))
    _caution(data)
    return data, plane, comm.once(with_spectrum, grid, plane)


def _look_back(images, support, reconstruction, part, grid, comm):
    """Point out what is doubtful about data and images; return the suspect blocks, and add the mask to the images."""
    data, pixels = part.data, images.pixels
    doubtful = suspects(part.blocks, part.noise, reconstruction.l2_bounds) if reconstruction else []
    for line in named_suspects(part.blocks, doubtful):
        log.warn(line)
    _caution(data, beyond_baselines(pixels["model"], grid.cell_rad, -comm.largest(-data.min_uv)))
    if support is not None:
        pixels["mask"] = check_confined(pixels["model"], support)
        sigma = thermal_noise(data, images.weights, part.noise, part.offsets, comm)
        _caution(data, left_outside(pixels["residual"], support, sigma))
    return doubtful


def split(data, blocks, comm=SERIAL):
    """Sort the samples of a plane into snapshot blocks (`blocks` as of :class:`casa_sara.options.Output`)."""
    block_of_sample, infos = divide(data, blocks, comm)
    data, offsets = sort_into_blocks(data, block_of_sample, len(infos))
    noise = noise_from_differences(data, offsets, comm)
    return Split(data, infos, offsets, noise)


def plane_images(data, model, grid, weighting, options, plane, comm=SERIAL):
    """Return the `PlaneImages` of a model (nx, ny) in Jy/pixel and the samples it was made of."""
    weights, operator, psf, beam = _point_spread(data, grid, weighting, options, plane, comm)
    residual = dirty_image(operator, data.vis - _predicted(operator, data, grid, options, model, comm), weights, comm)
    if grid.is_cube and weighting.weighting == "uniform":  # tclean's density of a channel counts the hands, too
        sumwt = float(weights.sum(dtype=float))
    else:
        sumwt = sum_of_weights(data, weights, grid.stokes)
    return PlaneImages(dict(psf=psf, residual=residual, model=model), weights, comm.total(sumwt), beam)


def _caution(data, notes=None):
    """Warn of these notes, which the record keeps too, or of those that are there."""
    for note in data.notes if notes is None else notes:
        log.warn(note)
    data.notes.extend(notes or [])


def _save_model(selection, data, grid, options, model):
    """Write the model's visibilities into the MeasurementSets: the last phase, the images are whole."""
    log.info("writing the model column")
    save_model_column(selection.vis, write_column, selection=asdict(selection), phase_center=data.phase_center,
                      cell_rad=grid.cell_rad, gridder=grid.gridder, spectrum=grid.spectrum and asdict(grid.spectrum),
                      nthreads=options.nthreads, model=model)


def write_column(selection, phase_center, cell_rad, gridder, spectrum, nthreads, model):
    """Predict the visibilities of a model and write them: what `save_model_column` has a child process do."""
    chosen = {name: tuple(value) if isinstance(value, list) else value for name, value in selection.items()}
    grid = ImageGrid(model.shape, tuple(cell_rad), gridder=gridder, spectrum=spectrum and Spectrum(**spectrum))
    write_model_column(Selection(**chosen), phase_center, lambda uvw, freq_hz: sky_operator(
        uvw, grid, freq_hz, eps=IMAGE_EPS, nthreads=nthreads).forward(model))


def _peak(name):
    """Return the largest absolute pixel of an image that stands."""
    with opened("image", name) as ia:
        return float(np.abs(read_pixels(ia)).max())


def _predicted(operator, data, grid, options, model, comm):
    """Return the visibilities of a model, by the operator of the dirty images unless there is a spectrum."""
    if grid.spectrum is not None:
        operator = sky_operator(data.uvw, grid, data.freq_hz, eps=IMAGE_EPS, nthreads=options.nthreads, comm=comm)
    return operator.forward(model)


def _point_spread(data, grid, weighting, options, plane, comm):
    """Return the imaging weights, the operator of the dirty images (flat spectra), the PSF and the beam fitted to it."""
    weights = imaging_weights(data, grid, weighting, comm)
    operator = Summed(sky_operator(data.uvw, grid, eps=IMAGE_EPS, nthreads=options.nthreads, comm=comm), comm)
    psf = dirty_image(operator, np.ones(data.size, np.complex64), weights, comm)
    return weights, operator, psf, comm.once(fit_beam, psf, plane)


def image_limits(data, grid, comm=SERIAL):
    """What the user should know of this image plane and these baselines; raise where no image can be made of them."""
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
    corner_sq = 0.25 * sum((n * cell) ** 2 for n, cell in zip(grid.shape, grid.cell_rad))
    phase = np.pi * max_w * corner_sq
    if phase > LARGEST_W_PHASE and grid.gridder == "standard":
        notes.append(f"the w-term is not modelled: it turns phases by up to {phase:.2g} rad in the corners of this image; "
                     "gridder = 'wproject' models it")
    return notes


def _after_iterations(samples, grid, output, limits, read_s):
    """Seconds to keep for what comes after the iterations: images, model column, report."""
    column = MODEL_COLUMN * read_s if output.savemodel == "modelcolumn" else 0.0
    return writing_seconds(samples, grid.shape) + column + (REPORT_SECONDS if limits.report else 0.0)


def nowhere_visible(grid, output):
    """What the user should know of an image whose pixels are masked everywhere."""
    return (f"phasecenter = '{grid.phasecenter}': the primary beam is nowhere in the image above pblimit = "
            f"{output.pblimit:g}, and its pixels are masked everywhere")


def describe(data, blocks, noise, stokes, comm=SERIAL):
    """Say in the log what was read."""
    log.info(f"{comm.total(data.size)} Stokes {stokes} visibilities, longest baseline "
             f"{comm.largest(data.max_uv) / 1e3:.4g} klambda, "
             f"{len(blocks)} blocks")
    for reason, count in data.dropped.items():
        log.info(f"left out: {count} samples, {reason}")
    for j, (block, level) in enumerate(zip(blocks, noise)):
        measured = f"noise measured from the data {level:.3g} times what the weights say" if np.isfinite(level) \
            else "too few integrations to measure the noise"
        log.info(f"block {j}: {block.label}; {measured}")
