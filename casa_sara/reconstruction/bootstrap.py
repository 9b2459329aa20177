"""Errors of a model from solving again: other noise on the same sky (bootstrap), or fewer snapshots (jackknife)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casa_sara.reconstruction.draws import Draws
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l1_weights import reweight
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.noise_draws import draw_noise
from casa_sara.solver.significance import SignificantSupport

__all__ = ["DRAW_ITERATIONS", "DRAW_REWEIGHTINGS", "Bootstrap", "Jackknife", "jackknife_groups"]

STAGES, INTERVAL = 3, 30  # problems of a draw, and iterations of each
DRAW_ITERATIONS, DRAW_REWEIGHTINGS = STAGES * INTERVAL, STAGES - 1
SEED = 20181
MOST_GROUPS, FEWEST_GROUPS = 10, 4  # of snapshots
BLIND = 1e5  # times the noise of data that count no more


@dataclass
class Bootstrap:
    """Draws of the model x̂ of a solution: y* = Φx̂ + σ_j n with new noise n at the levels σ_j found, solved as y was.

    A draw begins where the draw before has ended, the first one with the solution, and goes through the last steps of
    Algorithm 2: three problems of 30 iterations, with support and weights found anew between them.  Noise levels stay.

    Parameters
    ----------
    ppd : AdaptivePPD
        After its solution, of which it keeps the dual variables; its data are replaced.
    bounds : GivenBounds or AdaptiveBounds
        Whose levels are those of the noise.
    support : SignificantSupport or None
    scale : float
        α of the last weights; 0 where there was no re-weighting.
    model : real (nx, ny)
        x̂, in the unit of the iteration.
    threshold : float
        κ of the solution.
    draws : Draws
        Of the sky: of a mosaic the differences of x̂ are multiplied by 1/S.
    done : int
        Iterations of the present draw that are done.
    """

    ppd: AdaptivePPD
    bounds: GivenBounds | AdaptiveBounds
    support: SignificantSupport | None
    scale: float
    model: np.ndarray
    threshold: float
    draws: Draws
    done: int = 0

    def run(self, stopped: Callable[[], bool], progress: Callable[[Draws], None], keep: Callable[[bool], None]) -> None:
        """Make the draws that are missing.

        Parameters
        ----------
        stopped : callable
            Asked after every iteration; True ends it with the draws that are complete.
        progress : callable
            Called after every draw.
        keep : callable
            Called between iterations, with whether it was stopped: from the states of the iteration and of this
            (:meth:`state`) another one goes on as this one would have.
        """
        while not self.draws.complete:
            self._observe()
            while self.done < DRAW_ITERATIONS:
                if self.done and self.done % INTERVAL == 0:
                    self._renew_weights()
                self.ppd.step()
                self.done += 1
                ending = stopped()
                keep(ending)
                if ending:
                    return
            difference = self.ppd.scratch_image
            np.subtract(self.ppd.model, self.model, out=difference)
            difference *= difference.dtype.type(self.ppd.unit_jy * self._factor)
            if self.ppd.sky_over_image is not None:
                skies = self.ppd.planes.split(difference)
                skies *= self.ppd.sky_over_image
            self.draws.add(difference)
            self.done = 0
            progress(self.draws)

    @property
    def _factor(self):
        """On the difference of a draw, whose mean square then is the variance."""
        return 1.0

    def _observe(self):
        """Replace the data by those of the present draw, which depend on its number alone."""
        ppd, noise = self.ppd, self.ppd.scratch_vis
        ppd.correction = None  # the noise is that of averages
        ppd.measurement.forward(self.model, ppd.vis)
        draw_noise(ppd, np.random.default_rng([SEED, len(self.draws)]), self.bounds.noise, noise)
        ppd.vis += noise
        self._begin()

    def _begin(self):
        """Take κ of the solution, and the bounds."""
        if not self.done:
            self.ppd.rescale(self.threshold)
            self.bounds.apply_to(self.ppd)
            self.bounds.finish(self.ppd)

    def _renew_weights(self):
        """Find support and weights anew; the bounds then are what they were in the last problem of the solution."""
        if self.support:
            self.support.update(self.ppd, self.bounds)
        if self.scale:
            reweight(self.ppd, self.bounds, self.scale, self.support is not None)
            self.bounds.finish(self.ppd)

    def state(self) -> dict[str, Any]:
        """Return what :meth:`run` goes on from, beside the states of the iteration and of the bounds."""
        return dict(scale=self.scale, model=self.model, threshold=self.threshold, done=self.done,
                    draws=self.draws.arrays())


@dataclass
class Jackknife(Bootstrap):
    """Solutions without one group of blocks each: Var x̂ = (g − 1)/g Σ (x_k − x̂)² over the g groups.

    Calibration errors that differ from snapshot to snapshot count in full, and so does what only the coverage of a
    group tells of the sky.  The noise of the blocks left out is taken to be 10⁵ times what was found.  Parameters are
    those of `Bootstrap`; `draws` asks for as many as there are groups.  It is run before the bootstrap, which replaces
    the data.
    """

    @property
    def _factor(self):
        return (self.draws.asked - 1) ** 0.5

    def __post_init__(self):
        self._of_all = self.bounds

    def _observe(self):
        l2_bounds = self._of_all.l2_bounds
        left_out = np.arange(len(l2_bounds)) % self.draws.asked == len(self.draws)
        self.bounds = replace(self._of_all, l2_bounds=np.where(left_out, BLIND, 1.0) * l2_bounds)
        self._begin()


def jackknife_groups(blocks: int) -> int:
    """Return into how many groups a jackknife divides so many blocks.

    Parameters
    ----------
    blocks : int
        Blocks of data, d.

    Returns
    -------
    int

    Raises
    ------
    ValueError
        They are too few.
    """
    if blocks < FEWEST_GROUPS:
        raise ValueError(f"jackknife = True: there are {blocks} blocks of data; a jackknife over snapshots needs "
                         f"{FEWEST_GROUPS} or more. blocks can divide the data further")
    return min(blocks, MOST_GROUPS)
