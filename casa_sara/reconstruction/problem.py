"""The imaging problem of whitened visibilities, and the steps before the iteration: first image, outliers, norms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from math import inf, prod
from typing import Any

import numpy as np

from casa_sara.data.averaging import WORTHWHILE, Averaged, cell_sides
from casa_sara.data.distribution import Layout
from casa_sara.data.outliers import find_wild
from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import Summed
from casa_sara.operators.norms import power_method
from casa_sara.operators.outliers import ImagesDictionary, extents
from casa_sara.operators.piecewise import operator_on_disk
from casa_sara.operators.single_dish import Stacked
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.subbands import SubbandDictionary
from casa_sara.operators.widefield import WTerm
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.reconstruction.calibration import Calibration
from casa_sara.reconstruction.mosaic_parts import parts_of
from casa_sara.reconstruction.total_power import Beside, TotalPower, WhitenedDish
from casa_sara.solver.interfaces import Measurement
from casa_sara.solver.nnls import NNLSFit, nnls

__all__ = ["Findings", "Problem", "Samples", "averaging_cell", "first_image"]

ROUNDS = 6  # of leaving out wild samples, and of another first image
LARGEST_ERROR = 1.0  # of the averages of the first image, in units of their noise: docs/decisions.md, "Averages"
MOST_DOUBLINGS = 2  # of the cells, where there are more averages than pixels
MOST_HALVINGS = 8  # what is still wrong in cells 256 times smaller is not due to them
DYNAMIC_RANGE = 1e5  # of whitened visibilities: their noise is never taken for less than rms/DYNAMIC_RANGE
ON_DISK_EPS = 1e-6  # of the operator of samples on the disk, which makes images, too
STEEPEST = 2.0  # spectral index for which averages over frequency are made, where it is not known
LIGHT = 1e-2  # of the mean weight Σw²/Σw: no density counts as less


@dataclass
class Samples:
    """Block-sorted samples: all that were given, or those in use. Of several ranks each has its own.

    Attributes
    ----------
    data : Visibilities
        `vis` (Jy), `weight` (inverse variance) and `uvw` are used.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    density : real (M,)
        Sampling density of each sample; U = 1/density is the preconditioner.
    noise : float (d,), optional
        Noise of each block measured from the data, in units of what the weights say; NaN where unknown.
    kept : int (M,)
        Numbers of the samples in the data given.
    total_power : TotalPower, optional
        What a single dish has measured, a block of its own after those of the samples.
    """

    data: Visibilities
    offsets: np.ndarray
    density: np.ndarray
    noise: np.ndarray | None = None
    kept: np.ndarray = field(default=None)  # type: ignore[arg-type]  # all of them: see below
    total_power: TotalPower | None = None

    def __post_init__(self):
        self.offsets = np.asarray(self.offsets)
        if self.kept is None:
            self.kept = np.arange(self.data.size, dtype=np.int32 if self.data.scratch.on_disk else int)

    def without(self, index: np.ndarray) -> Samples:
        """Leave out samples, numbered as they are here.

        Parameters
        ----------
        index : int (n,)
            Numbers of the samples to leave out.

        Returns
        -------
        Samples
        """
        if len(index) == 0:
            return self
        good = np.delete(np.arange(self.data.size), index)
        return replace(self, data=self.data.take(good), offsets=np.searchsorted(good, self.offsets),
                       density=self.density[good], kept=self.kept[good])


@dataclass
class Findings:
    """What is found before the first iteration.

    `left_out` (n,) are the numbers of the wild samples in the data given; `finer` (d,) is how often the cells are
    halved within which each block is averaged, and `averaging_error` the largest error of the averages of the first
    image, in units of their noise; the others are as in `Reconstruction`, in the units of the iteration.
    """

    left_out: np.ndarray
    wild: list[dict]
    nnls_norms: np.ndarray
    data_norm_sq: float
    finer: np.ndarray
    averaging_error: float = 0.0
    noise_only: bool = False


@dataclass
class Problem:
    """Whitened samples y = √w·V of this rank, the operators that belong to them, and the pixels that may be non-zero.

    `vis`, `offsets`, `measurement` and `precond` are of the averages where the samples are `averaged`, and of all
    `samples` where that is None; those of a single `dish`, where there is one, come after them, a block of their own.
    `support` is None where all pixels may be non-zero. Of a mosaic the sky is the image times `sky_over_image`; with
    `subbands` the images of several frequencies are stacked. `shapes` are those of the main image and of its outliers,
    which are stacked too.
    """

    samples: Samples
    vis: np.ndarray
    offsets: np.ndarray
    measurement: Measurement
    precond: np.ndarray
    data_norm_sq: float
    unit_jy: float
    support: np.ndarray | None = None
    averaged: Averaged | None = None
    sky_over_image: np.ndarray | None = None
    dish: WhitenedDish | None = None
    subbands: Any = None
    shapes: tuple[tuple[int, int], ...] = ()
    calibration: Calibration | None = None

    @classmethod
    def of(cls, samples: Samples, grid: ImageGrid, options: SolverOptions,  # noqa: PLR0913 - four have a default
           unit_jy: float, eps: float, data_norm_sq: float | None = None, support: np.ndarray | None = None,
           finer: np.ndarray | None = None, comm: Serial = SERIAL) -> Problem:
        """Whiten the data, average them, and build their operator, to the accuracy `eps`, for images in `unit_jy`.

        Its norm is measured unless given.

        Parameters
        ----------
        samples : Samples
            The samples, sorted into blocks, with their sampling density.
        grid : ImageGrid
            Size, pixels, direction and gridder of the image.
        options : SolverOptions
            Task parameters of the method.
        unit_jy : float
            Jy/pixel in the unit of the image.
        eps : float
            Accuracy of the operator.
        data_norm_sq : float, optional
            ‖U^½Φ‖².
        support : bool (nx, ny), optional
            Pixels that may be non-zero; all by default.
        finer : int (d,), optional
            How many times the cells of each block's averages are halved; found by default.
        comm : casa_sara.parallel.serial.Serial or MPI
            Over whose ranks the samples are spread.

        Returns
        -------
        Problem
        """
        data, offsets = samples.data, samples.offsets
        operator = partial(sky_operator, grid=grid, eps=eps, nthreads=options.nthreads, comm=comm)
        vis: Any = None if data.scratch.on_disk else data.vis * np.sqrt(data.weight)
        measurement = _whitened_operator(data, operator, grid, options, unit_jy)
        precond = of_samples = _preconditioner(samples, options.precondition, comm, grid.subbands)
        calibration = Calibration(data, vis, offsets, measurement, comm) if options.gainfit else None
        averaged = None
        if options.averages:
            parts = grid.mosaic and parts_of(grid.mosaic, data.uvw, np.asarray(data.beam))
            averaged, uvw, freq_hz = _averages(partial(Averaged.of, data, offsets, averaging_cell(grid), vis=vis,
                                                       operator=measurement, comm=comm, parts=parts), samples, finer,
                                               grid, options)
        if averaged is not None:
            vis, offsets = averaged.whitened_mean(averaged.whitened), averaged.cells.offsets
            precond = averaged.weighted_mean(precond).astype(np.float32)
            root_weight = np.sqrt(averaged.sum_of_weights, dtype=np.float32, casting="same_kind")
            measurement = operator(uvw, freq_hz=freq_hz, row_scale=root_weight * np.float32(unit_jy),
                                   beam=averaged.part_of_cell)
        dish = None
        if samples.total_power is not None:
            dish = samples.total_power.whitened(grid.shape, float(data.weight.sum(dtype=float)), unit_jy,
                                                measurement.workers)
            alone = float(prod(grid.shape))  # of one sample
            of_dish = dish.precond(_norm_sq(samples, of_samples, grid, unit_jy) if options.precondition else alone)
            measurement = Stacked(measurement, dish.operator)
            vis, precond = np.concatenate([vis, dish.vis]), np.concatenate([precond, of_dish])
            offsets = np.append(offsets, vis.size)
        if data_norm_sq is None:
            whole = Summed(measurement, comm)
            data_norm_sq = float(comm.bcast(power_method(
                lambda image: whole.adjoint(precond * whole.forward(image)), measurement.shape, dtype=np.float32)))
        if support is not None and grid.subbands is not None:
            support = np.tile(support, (grid.subbands.n_terms, 1))
        return cls(samples, vis, offsets, measurement, precond, data_norm_sq, unit_jy, support, averaged,
                   grid.mosaic and grid.mosaic.over, dish, grid.subbands, grid.shapes, calibration)

    def dictionary(self, wavelets: tuple[str, ...], options: SolverOptions) -> Any:
        """Return Ψ of the image, or of all that are stacked.

        Parameters
        ----------
        wavelets : tuple of str
            The bases of this rank.
        options : SolverOptions
            Task parameters of the method.

        Returns
        -------
        SaraDictionary, SubbandDictionary or ImagesDictionary
        """
        each = [SaraDictionary(shape, wavelets, options.wavelevels, nthreads=options.nthreads,
                               n_bases=len(options.wavelets)) for shape in self.shapes]
        if self.subbands is not None:
            return SubbandDictionary(each[0], self.subbands.orders, options.nthreads)
        return each[0] if len(each) == 1 else ImagesDictionary(each)

    @property
    def renewing(self) -> Averaged | Beside | None:
        """What makes the averages anew, None where there are none."""
        return self.averaged if self.averaged is None or self.dish is None else Beside(self.averaged, self.dish.vis)

    @property
    def block_sizes(self) -> np.ndarray:
        """Samples of each block on this rank, before they were averaged; int (d,)."""
        sizes = np.diff(self.samples.offsets)
        return sizes if self.dish is None else np.append(sizes, self.dish.vis.size)

    def flux_jy(self, image: np.ndarray) -> float:
        """Return Σ|I| of the sky of an image, which no visibility of it exceeds.

        Parameters
        ----------
        image : real (nx, ny)
            In `unit_jy`.

        Returns
        -------
        float
        """
        count = 1 if self.subbands is None else self.subbands.n_terms
        sky = image.reshape(count, -1, image.shape[-1])
        sky = sky if self.sky_over_image is None else sky * self.sky_over_image
        if self.subbands is None:
            return self.unit_jy * float(np.abs(sky).sum(dtype=float))
        fluxes = np.abs(sky).sum(axis=(1, 2), dtype=float)
        return self.unit_jy * float((np.abs(self.subbands.factors(self.subbands.band_hz)).T @ fluxes).max())


def _averages(average, samples, finer, grid, options):
    """Return what `average` makes of the samples, None where that is not worthwhile.

    Unless `finer` says how large the cells are they are enlarged while there are more averages than pixels: to a phase
    of up to 0.4 rad, which those of samples on the disk have at once.
    """
    enlarging = finer is None and not options.jackknife and grid.subbands is None and samples.total_power is None
    on_disk, blocks = samples.data.scratch.on_disk, len(samples.offsets) - 1
    if finer is None:
        finer = np.full(blocks, -MOST_DOUBLINGS if on_disk and enlarging else 0)
    while True:
        found, averages, most = (None, None, None), inf, inf
        with suppress(OverflowError):  # hardly two samples share one of so many cells
            found = average(finer)
            comm = found[0].comm
            averages, most = comm.total(found[0].cells.size), WORTHWHILE * comm.total(samples.data.size)
        if not enlarging or averages <= sum(map(prod, grid.shapes)) or finer.min() == -MOST_DOUBLINGS:
            break
        finer = finer - 1
    if averages <= most < inf:
        return found
    if on_disk:
        raise MemoryError(f"imsize = {list(grid.shape)}: the {samples.data.size} visibilities would be averaged to "
                          f"{averages}, which do not fit into memory: fewer blocks, a smaller image or fewer "
                          "visibilities would")
    return None, None, None


def _whitened_operator(data, operator, grid, options, unit_jy):
    """Return Φ of all samples; of samples on the disk in pieces."""
    def of(uvw, weight, freq_hz, beam):
        return operator(uvw, freq_hz=freq_hz, row_scale=np.sqrt(weight) * np.float32(unit_jy), beam=beam)

    if not data.scratch.on_disk:
        return of(data.uvw, data.weight, data.freq_hz, data.beam)
    whole = operator_on_disk(data.uvw, grid, data.freq_hz, ON_DISK_EPS, options.nthreads, data.scratch)
    return whole.scaled(lambda piece: np.sqrt(data.weight[piece]) * np.float32(unit_jy))


def averaging_cell(grid: ImageGrid) -> np.ndarray:
    """Return the sides of the cells within which samples are averaged: :func:`casa_sara.data.averaging.cell_sides`.

    An outlier is as far from the centre as the corner of an image that would hold it. Of a mosaic the sides along u and
    v are those of the widest beam.

    Parameters
    ----------
    grid : ImageGrid
        Image for which they are averaged.

    Returns
    -------
    float (4,)
        Along v, u, w and ln ν.
    """
    index = 0.0 if grid.spectrum is None else float(np.abs(grid.spectrum.index).max())
    if grid.subbands is not None:
        index = STEEPEST
    depth = WTerm.of(0.0, grid.shape, grid.cell_rad, 1.0).depth if grid.gridder == "wproject" else 0.0
    if grid.outliers:  # an image of two pixels that reaches as far as all of them
        *reach, beyond = extents(grid)
        return cell_sides((2, 2), reach, max(depth, beyond), index)
    shape = grid.shape
    if grid.mosaic is not None:
        boxes = [beam.box(grid.shape, grid.cell_rad) for beam in grid.mosaic.beams]
        shape = tuple(max(box[axis].stop - box[axis].start for box in boxes) for axis in (0, 1))
    return cell_sides(shape, grid.cell_rad, depth, index)


def first_image(samples: Samples, problem_of: Callable[..., Problem], options: SolverOptions,
                stopped: Callable[[], bool] = lambda: False,
                comm: Serial = SERIAL) -> tuple[Problem, Findings, np.ndarray]:
    """Find the image of positivity and a vanishing sparsity alone, where the bounds start, and the model too.

    Parameters
    ----------
    samples : Samples
        The samples, sorted into blocks, with their sampling density.
    problem_of : callable
        Makes the `Problem` of samples.
    options : SolverOptions
        Task parameters of the method.
    stopped : callable
        Ends the fit early when it returns True.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    problem : Problem
        Without the wild samples.
    found : Findings
    first : real (nx, ny)
        In `problem.unit_jy`.
    """
    everything, wild, layout = samples.data.size, [], Layout(samples.offsets, comm)
    finer, rounds = None, 0
    while True:
        problem = problem_of(samples, finer=finer)
        first, left = nnls(Summed(problem.measurement, comm), problem.vis, problem.precond, problem.data_norm_sq,
                           NNLSFit(positivity=options.positivity), stopped, problem.support)
        left = left[: left.size - (0 if problem.dish is None else problem.dish.vis.size)]
        residual = left if problem.averaged is None else problem.averaged.residual(first)
        error = _averaging_error(problem, residual, left, comm)
        used = problem.averaged.finer if problem.averaged else np.zeros(len(samples.offsets) - 1, int)
        if error.max() > LARGEST_ERROR and used.max() < MOST_HALVINGS and not stopped():
            # it goes with the square of the side
            finer = used + np.ceil(0.5 * np.log2(np.maximum(error / LARGEST_ERROR, 1))).astype(int)
            continue
        found = find_wild(samples.data, samples.offsets, residual, problem.flux_jy(first), comm)
        if comm.total(found.index.size) == 0 or rounds == ROUNDS:
            break
        wild += _told_of_all(found, samples, layout, comm)
        samples, finer, rounds = samples.without(found.index), None, rounds + 1
    gone = np.ones(everything, bool)
    gone[samples.kept[samples.kept < everything]] = False
    left_out = np.flatnonzero(gone)
    norms = _norms(residual, samples.offsets, comm)
    if problem.dish is not None:
        norms = np.append(norms, problem.dish.noise_norm(options.positivity, problem.support))
    return problem, Findings(left_out, wild, norms, problem.data_norm_sq, used, float(error.max())), first


def _norms(vis, offsets, comm):
    """Return the norm of each block, of all ranks."""
    return comm.norms(np.array([np.linalg.norm(vis[a:b]) for a, b in zip(offsets[:-1], offsets[1:])]))


def _averaging_error(problem, residual, of_averages, comm):
    """Return the error of the averages of an image in each block, float (d,), in units of their noise.

    That is the noise measured in the data; where it is unknown, what the image leaves.
    """
    samples, averaged = problem.samples, problem.averaged
    if averaged is None:
        return np.zeros(len(samples.offsets) - 1)
    left, rms = (_norms(vis, samples.offsets, comm) / np.sqrt(2 * np.maximum(averaged.samples, 1))
                 for vis in (residual, averaged.whitened))
    noise = left if samples.noise is None else np.where(np.isfinite(samples.noise), samples.noise, left)
    return averaged.error(residual, of_averages) / np.maximum(noise, rms / DYNAMIC_RANGE + np.finfo(float).tiny)


def _told_of_all(found, samples, layout, comm):
    """Return what is told of the wild samples of all ranks, in the order in which one rank alone has them."""
    numbered = zip(layout.numbers(samples.kept[found.index]).tolist(), found.named(samples.data))
    return [told for _, told in sorted(sum(comm.allgather(list(numbered)), []), key=lambda one: one[0])]


def _norm_sq(samples, precond, grid, unit_jy):
    """About ‖U^½Φ‖² of the visibilities, from what the samples of a uv cell have together, ΣUw, times the pixels."""
    data = samples.data
    of_cells = np.median(precond * samples.density * (data.weight / data.imaging_weight))
    return float(of_cells) * prod(grid.shape) * unit_jy**2


def _preconditioner(samples, wanted, comm, subbands=None):
    """U = 1/density, largest value 1.

    Samples of very low weight that are alone in their uv cells (bad data that were down-weighted instead of flagged)
    are not raised to the weight of other cells: the density is taken to be at least 1e-2·Σw²/Σw.

    Of several frequencies it is that times Σ_t g_t², g_t what each image contributes to the sample: where in the uv
    plane there are but samples of the edges of the band, these would weigh up to T² times as much as the others.
    """
    data, scratch = samples.data, samples.data.scratch
    if not wanted:
        return np.ones(data.size, np.float32)
    squares = weights = 0.0
    for piece in scratch.pieces(0, data.size):
        squares += float(np.square(data.weight[piece], dtype=float).sum())
        weights += float(data.weight[piece].sum(dtype=float))
    least = LIGHT * (comm.total(squares) / comm.total(weights))

    def inverse(piece):
        precond = 1.0 / np.maximum(np.asarray(samples.density[piece], float), least)
        return precond if subbands is None else precond / np.square(subbands.factors(data.freq_hz[piece])).sum(axis=0)

    greatest = comm.largest(max(inverse(piece).max(initial=0) for piece in scratch.pieces(0, data.size)))
    precond = scratch.empty(data.size, np.float32)
    for piece in scratch.pieces(0, data.size):
        precond[piece] = inverse(piece) / greatest
    return precond
