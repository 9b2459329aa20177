"""The test whether the data need emission in a region: solutions without it and with it, and a bootstrap of both."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincc, ndtr, ndtri

from casa_sara.reconstruction.bootstrap import INTERVAL, SEED, STAGES
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l1_weights import reweight
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds
from casa_sara.solver.noise_draws import draw_noise
from casa_sara.solver.point_sources import PointSources

__all__ = ["FEATURE_DRAWS", "FeatureResult", "FeatureTest"]

FEATURE_DRAWS = 20
SETTLED, MOST_TO_SETTLE = 5.0, 6  # fall of χ² within a solution, before the first draw, and most solutions until then
LEAST_P = 1e-300


@dataclass(frozen=True)
class FeatureResult:
    """What the data say of the emission in a region.

    Attributes
    ----------
    change : float
        T = χ²(without) − χ²(with), χ² = Σ_j ‖y_j − Φ_j x‖²/σ_j², χ²(without) the mean of a solution before that with
        and of one after it.
    drawn : float (n,)
        T of the draws, in which there is none.
    flux_jy : float
        Of the model in the region, where it may be.
    without, with_ : float32 (nx, ny)
        Both models, Jy/pixel.
    """

    change: float
    drawn: np.ndarray
    flux_jy: float
    without: np.ndarray
    with_: np.ndarray

    @property
    def rank_p_value(self) -> float:
        """Fraction of the draws, with the data as one more, whose T is not less than that of the data."""
        return (1 + int(np.count_nonzero(self.drawn >= self.change))) / (1 + len(self.drawn))

    @property
    def p_value(self) -> float:
        """Probability of a T not less than this without emission: of the scaled χ² with mean and variance of the draws.

        It is what lets a few draws tell of far smaller probabilities than one in their number, by extrapolation.  The
        prior may let T be negative: the distribution then begins at the least of the draws.  No p-value is less than
        that of √T standard deviations, with which emission of known place and shape is detected, nor than 1e-300.
        """
        least = min(float(np.min(self.drawn)), 0.0)
        mean, variance = float(np.mean(self.drawn)) - least, float(np.var(self.drawn, ddof=1))
        if not (mean > 0 and variance > 0):
            return self.rank_p_value
        of_draws = float(gammaincc(mean**2 / variance, max(self.change - least, 0.0) * mean / variance))
        return max(of_draws, float(ndtr(-np.sqrt(max(self.change, 0.0)))), LEAST_P)

    @property
    def sigma(self) -> float:
        """Standard deviations of a Gaussian beyond which there is as much, on one side."""
        return -float(ndtri(self.p_value))


class FeatureTest:
    """Tests of regions after a solution.

    The model is solved with the region's pixels kept at 0, with all of them free, and once more without them; elsewhere
    all have the support of the solution. Each goes on from the one before, and where χ² is still falling, the mean of
    the first and the last falls with it. The same is done with draws y* = Φx₀ + σ_j n of the model x₀ without.

    Parameters
    ----------
    ppd : AdaptivePPD
        After its solution; it is left in another state.
    bounds : GivenBounds or AdaptiveBounds
        Whose levels are those of the noise.
    scale : float
        α of the last weights; 0 where there was no re-weighting.
    confined : bool
        A support confines the model.
    """

    def __init__(self, ppd: AdaptivePPD, bounds: GivenBounds | AdaptiveBounds, scale: float, confined: bool) -> None:
        self._ppd, self._bounds, self._scale, self._confined = ppd, bounds, scale, confined
        self._vis, self._model, self._lowest = ppd.vis.copy(), ppd.model.copy(), ppd.lowest.copy()
        self._points, self._threshold = ppd.points, ppd.threshold

    def test(self, region: np.ndarray, draws: int = FEATURE_DRAWS, stopped: Callable[[], bool] = lambda: False,
             progress: Callable[[int], None] = lambda number: None) -> FeatureResult:
        """Test a region.

        Parameters
        ----------
        region : bool (nx, ny)
            Where the emission is that may not be real.
        draws : int
            How many draws of the model without it.
        stopped : callable
            Asked after every iteration; True raises KeyboardInterrupt.
        progress : callable
            Called with the number of draws done.

        Returns
        -------
        FeatureResult

        Raises
        ------
        KeyboardInterrupt
            It was stopped.
        """
        ppd = self._ppd
        ppd.vis[...] = self._vis
        ppd.lowest[...], ppd.points = self._lowest, self._points
        supports = (self._lowest < np.inf) & ~region, (self._lowest < np.inf) | region
        points = PointSources([place for place in self._points.places if not _touches(place, region)])
        ppd.model[...] = self._model
        change, without, with_ = self._change(supports, points, stopped)
        predicted, noise, drawn = ppd.measurement.forward(without).copy(), np.empty_like(ppd.vis), []
        for number in range(draws):
            draw_noise(ppd, np.random.default_rng([SEED, 1, number]), self._bounds.noise, noise)
            np.add(predicted, noise, out=ppd.vis)
            progress(number)
            if number == 0:
                self._forget(supports[0], points, stopped)
            drawn.append(self._change(supports, points, stopped)[0])
        without, with_ = (model * np.float32(ppd.unit_jy) for model in (without, with_))
        return FeatureResult(change, np.array(drawn), float(with_[region].sum(dtype=float)), without, with_)

    def _change(self, supports, points, stopped):
        """Return T of the present data, and the models without and with the region."""
        without, with_ = supports
        chi_squares, models = [], []
        for support in (without, with_, without):
            chi_squares.append(self._solved(support, points, stopped))
            models.append(self._ppd.model.copy())
        return 0.5 * (chi_squares[0] + chi_squares[2]) - chi_squares[1], models[2], models[1]

    def _forget(self, support, points, stopped):
        """Solve until the dual variables hold nothing any more of what the data had in the region."""
        before = np.inf
        for _ in range(MOST_TO_SETTLE):
            now = self._solved(support, points, stopped)
            if before - now < SETTLED:
                break
            before = now

    def _solved(self, support, points, stopped):
        """Solve within a support, from the present model, and return χ²."""
        self._ppd.support_only(support, points)
        self._ppd.start_from(self._ppd.model)
        self._solve(stopped)
        return self._chi_square()

    def _solve(self, stopped):
        """The problems of a draw, with weights found anew between them."""
        self._ppd.rescale(self._threshold)
        for stage in range(STAGES):
            if stage and self._scale:
                reweight(self._ppd, self._bounds, self._scale, self._confined)
                self._bounds.finish(self._ppd)
            for _ in range(INTERVAL):
                self._ppd.step()
                if stopped():
                    raise KeyboardInterrupt

    def _chi_square(self):
        """Σ_j ‖y_j − Φ_j x‖²/σ_j²."""
        ppd, residual = self._ppd, self._ppd.scratch_vis
        ppd.measurement.forward(ppd.model, residual)
        np.subtract(ppd.vis, residual, out=residual)
        sums = [float(np.square(residual[a:b].view(residual.real.dtype), dtype=float).sum()) for a, b in ppd.blocks()]
        return ppd.comm.total(float(np.dot(sums, self._bounds.noise_weights)))


def _touches(place, region):
    """Whether a point source has pixels in a region."""
    point = PointSources([place])
    return bool(region[point.x, point.y].any())
