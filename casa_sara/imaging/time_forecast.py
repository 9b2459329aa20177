"""The expected time of a run, from a short measurement of the operators on the data."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np

from casa_sara.data.noise import noise_from_differences
from casa_sara.operators.outliers import rotation
from casa_sara.reconstruction.bootstrap import DRAW_ITERATIONS, DRAW_REWEIGHTINGS, MOST_GROUPS
from casa_sara.reconstruction.paper_method import PAPER, paper_prior
from casa_sara.reconstruction.problem import Problem, Samples
from casa_sara.reconstruction.settings import operator_accuracy, schedule_of
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.nnls import NNLS_ITERATIONS, NNLSFit, nnls

__all__ = ["Pace", "Timing", "error_seconds", "measure", "writing_seconds"]

STARTING = 5.0  # libraries, compiled code, image plane
WRITE_BASE, WRITE_SAMPLE, WRITE_PIXEL = 1.0, 6e-7, 2.5e-7
SMOOTH_PIXEL = 3e-7
MARGIN = 2.0  # on these: disks differ
NORM_PAIRS = 60  # Φ and Φ† for ‖Φ‖, in all
REWEIGHTING = 4  # iterations' time of one re-weighting


@dataclass(frozen=True)
class Timing:
    """Seconds of one call of each kind, and how many calls are expected.

    Attributes
    ----------
    reading, building, writing : float
        Seconds in all.
    pair, nnls_iteration, iteration : float
        Seconds of Φ with Φ†, of one iteration of NNLS and of one of the solver.
    iterations, reweightings : int
        Expected; the data decide.
    channels : int
        Of the image, each of which takes as much.
    renewal : float
        Seconds in which averages are made anew, at a re-weighting.
    averages : int
        To which the visibilities are averaged, 0 where they are not.
    draws : int
        Of bootstrap and jackknife.
    """

    reading: float
    building: float
    pair: float
    nnls_iteration: float
    iteration: float
    writing: float
    iterations: int
    reweightings: int
    channels: int = 1
    nnls_iterations: int = NNLS_ITERATIONS
    renewal: float = 0.0
    averages: int = 0
    draws: int = 0

    @property
    def drawing(self) -> float:
        """Seconds of the draws."""
        return self.draws * (DRAW_ITERATIONS + REWEIGHTING * DRAW_REWEIGHTINGS) * self.iteration

    @property
    def total(self) -> float:
        """Seconds of the run."""
        if not self.iterations:
            return STARTING + self.reading + self.channels * (self.building + self.writing)
        reweighting = REWEIGHTING * self.iteration + self.renewal
        solving = self.iterations * self.iteration + self.reweightings * reweighting
        first = NORM_PAIRS * self.pair + self.nnls_iterations * self.nnls_iteration
        return STARTING + self.reading + self.channels * (self.building + first + solving + self.drawing + self.writing)


def measure(data, offsets, grid, options, reading):
    """Time the real operator, dictionary and iteration on the real data, a few calls of each.

    Parameters
    ----------
    data : Visibilities
        In the order of their blocks.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    options : SolverOptions
        Task parameters of the method.
    reading : float
        Seconds that it took to read the data.

    Returns
    -------
    Timing
    """
    writing = writing_seconds(data.size, grid.shape) + error_seconds(options, grid.shape)
    if not options.niter:
        return Timing(reading, 0.0, 0.0, 0.0, 0.0, writing, 0, 0)
    start = time.perf_counter()
    turns = [rotation(data.uvw, outlier) for outlier in grid.outliers]
    eps = operator_accuracy(data, offsets, noise_from_differences(data, offsets, turns=turns))
    bound = float(data.weight.sum(dtype=float)) * math.prod(grid.shape)  # of the operator's squared norm
    samples = Samples(data, offsets, np.ones(data.size, np.float32))
    problem = Problem.of(samples, grid, options, unit_jy=1.0, eps=eps, data_norm_sq=bound)
    building = time.perf_counter() - start
    measurement = problem.measurement
    image = np.ones(measurement.shape, np.float32)
    pair = _seconds(lambda: measurement.adjoint(measurement.forward(image)))
    # two iterations, and one Φ of the last image
    first = _seconds(lambda: nnls(measurement, problem.vis, problem.precond, bound, NNLSFit(max_iter=2))) / 2.5
    dictionary = problem.dictionary(options.wavelets, options)
    if options.method == PAPER:
        dictionary = paper_prior(dictionary, measurement)
    ppd = AdaptivePPD(measurement, dictionary, problem.vis, problem.offsets, problem.precond, bound, options.positivity)
    ppd.averaged, ppd.threshold = problem.averaged, 1.0
    renewal = _seconds(lambda: ppd.renew_averages(ppd.model)) if ppd.averaged else 0.0
    schedule = schedule_of(options)
    of_blocks = schedule.nnls_iterations if options.method == PAPER else 0
    return Timing(reading, building, pair, first, _seconds(ppd.step), writing, schedule.expected_iterations,
                  schedule.expected_reweightings, nnls_iterations=NNLS_ITERATIONS + of_blocks, renewal=renewal,
                  averages=ppd.vis.size if ppd.averaged else 0, draws=_draws(options))


def _seconds(call, repeats=3):
    """Shortest time of a call that has been made before."""
    call()
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return min(times)


def writing_seconds(samples, shape):
    """Seconds that making and writing the images takes, with a margin."""
    return MARGIN * (WRITE_BASE + WRITE_SAMPLE * samples + WRITE_PIXEL * math.prod(shape))


def _draws(options):
    """Draws of bootstrap and jackknife, which has as many groups as there can be."""
    return options.ndraws + options.jackknife * MOST_GROUPS


def error_seconds(options, shape):
    """Seconds that making and writing the images of errors from draws takes, with a margin."""
    draws = _draws(options)
    return MARGIN * (draws * SMOOTH_PIXEL + 2 * bool(draws) * WRITE_PIXEL) * math.prod(shape)


class Pace:
    """Tells the time of one iteration from the first few, and what follows for the rest.

    Parameters
    ----------
    expected : int
        Iterations expected in all.
    clock : callable
    """

    FIRST, LAST = 1, 4  # the first iteration has the first weights in it

    def __init__(self, expected, clock=time.monotonic):
        self._expected, self._clock, self._start = expected, clock, 0.0
        self.seconds = math.nan

    def __call__(self, iteration):
        """Return a line for the log at the end of this iteration (from 1), '' for none."""
        if iteration == self.FIRST:
            self._start = self._clock()
        if iteration != self.LAST:
            return ""
        self.seconds = (self._clock() - self._start) / (self.LAST - self.FIRST)
        left = self._expected * self.seconds
        return (f"forecast: {self.seconds:.3g} s per iteration and about {self._expected} iterations, so about "
                f"{left:.0f} s from now")
