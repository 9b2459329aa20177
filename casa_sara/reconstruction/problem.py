"""The imaging problem of whitened visibilities, and the steps before the iteration: first image, outliers, norms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from casa_sara.data.distribution import Layout
from casa_sara.data.outliers import find_wild
from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.measurement import Summed
from casa_sara.operators.norms import power_method
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.solver.interfaces import Measurement
from casa_sara.solver.nnls import nnls

__all__ = ["Findings", "Problem", "Samples", "first_image"]

ROUNDS = 6  # of leaving out wild samples
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
    """

    data: Visibilities
    offsets: np.ndarray
    density: np.ndarray
    noise: np.ndarray | None = None
    kept: np.ndarray = field(default=None)  # type: ignore[arg-type]  # all of them: see below

    def __post_init__(self):
        self.offsets = np.asarray(self.offsets)
        if self.kept is None:
            self.kept = np.arange(self.data.size)

    def without(self, index: np.ndarray) -> Samples:
        """Leave out samples, numbered as they are here.

        Parameters
        ----------
        index : int (n,)

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

    `left_out` (n,) are the numbers of the wild samples in the data given; the others are as in `Reconstruction`, in
    the units of the iteration.
    """

    left_out: np.ndarray
    wild: list[dict]
    nnls_norms: np.ndarray
    data_norm_sq: float
    noise_only: bool = False


@dataclass
class Problem:
    """Whitened samples y = √w·V of this rank, the operators that belong to them, and the pixels that may be non-zero.

    `support` is None where all may. Of a mosaic the sky is the image times `sky_over_image`.
    """

    samples: Samples
    vis: np.ndarray
    measurement: Measurement
    precond: np.ndarray
    data_norm_sq: float
    unit_jy: float
    support: np.ndarray | None = None
    sky_over_image: np.ndarray | None = None

    @classmethod
    def of(cls, samples: Samples, grid: ImageGrid, options: SolverOptions, unit_jy: float, eps: float,
           data_norm_sq: float | None = None, support: np.ndarray | None = None, comm: Serial = SERIAL) -> Problem:
        """Whiten the data and build their operator, to the accuracy `eps`, for images in `unit_jy`.

        Its norm is measured unless given.

        Parameters
        ----------
        samples : Samples
        grid : ImageGrid
        options : SolverOptions
        unit_jy : float
            Jy/pixel in the unit of the image.
        eps : float
            Accuracy of the operator.
        data_norm_sq : float, optional
            ‖U^½Φ‖².
        support : bool (nx, ny), optional
        comm : casa_sara.parallel.serial.Serial or MPI
            Over whose ranks the samples are spread.

        Returns
        -------
        Problem
        """
        data = samples.data
        sqrt_weight = np.sqrt(data.weight)
        vis = data.vis * sqrt_weight
        sqrt_weight *= np.float32(unit_jy)
        measurement = sky_operator(data.uvw, grid, data.freq_hz, row_scale=sqrt_weight, eps=eps,
                                   nthreads=options.nthreads, comm=comm, beam=data.beam)
        precond = _preconditioner(samples, options.precondition, comm)
        if data_norm_sq is None:
            whole = Summed(measurement, comm)
            data_norm_sq = comm.bcast(power_method(
                lambda image: whole.adjoint(precond * whole.forward(image)), grid.shape, dtype=np.float32))
        return cls(samples, vis, measurement, precond, data_norm_sq, unit_jy, support, grid.mosaic and grid.mosaic.over)

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
        sky = image if self.sky_over_image is None else image * self.sky_over_image
        return self.unit_jy * float(np.abs(sky).sum(dtype=float))


def first_image(samples: Samples, problem_of: Callable[..., Problem], options: SolverOptions,
                stopped: Callable[[], bool] = lambda: False,
                comm: Serial = SERIAL) -> tuple[Problem, Findings, np.ndarray]:
    """Find the image of positivity and a vanishing sparsity alone, where the bounds start, and the model too.

    Parameters
    ----------
    samples : Samples
    problem_of : callable
        Makes the `Problem` of samples.
    options : SolverOptions
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
    problem = problem_of(samples)
    for _ in range(ROUNDS):
        first, residual = nnls(Summed(problem.measurement, comm), problem.vis, problem.precond, problem.data_norm_sq,
                               positivity=options.positivity, stopped=stopped, support=problem.support)
        samples = problem.samples
        found = find_wild(samples.data, samples.offsets, residual, problem.flux_jy(first), comm)
        if comm.total(found.index.size) == 0:
            break
        wild += _told_of_all(found, samples, layout, comm)
        problem, residual = problem_of(samples.without(found.index)), np.delete(residual, found.index)
    samples = problem.samples
    left_out = np.setdiff1d(np.arange(everything), samples.kept)
    nnls_norms = comm.norms(np.array([np.linalg.norm(residual[a:b])
                                      for a, b in zip(samples.offsets[:-1], samples.offsets[1:])]))
    return problem, Findings(left_out, wild, nnls_norms, problem.data_norm_sq), first


def _told_of_all(found, samples, layout, comm):
    """Return what is told of the wild samples of all ranks, in the order in which one rank alone has them."""
    numbered = zip(layout.numbers(samples.kept[found.index]).tolist(), found.named(samples.data))
    return [told for _, told in sorted(sum(comm.allgather(list(numbered)), []), key=lambda one: one[0])]


def _preconditioner(samples, wanted, comm):
    """U = 1/density, largest value 1.

    Samples of very low weight that are alone in their uv cells (bad data that were down-weighted instead of flagged) are not
    raised to the weight of other cells: the density is taken to be at least 1e-2·Σw²/Σw.
    """
    weight = samples.data.weight
    if not wanted:
        return np.ones(weight.size, np.float32)
    mean = comm.total(float(np.square(weight, dtype=float).sum())) / comm.total(float(weight.sum(dtype=float)))
    precond = 1.0 / np.maximum(np.asarray(samples.density, float), LIGHT * mean)
    return (precond / comm.largest(precond.max(initial=0))).astype(np.float32)
