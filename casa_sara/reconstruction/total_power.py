"""Total power: a single-dish image as one more block of data, beside the visibilities.

Its values are whitened by one number, their noise, which is found as that of any block: its level follows what the
model leaves of them.  About half of what points half a beam apart measure is finer than the beam passes, so that no
model can follow it, and the noise found is that of the dish.

One thing is set: how much the block counts at most.  What it weighs goes to scales of its beam alone, many times what
visibilities weigh there, and a low noise would make it the better part of the response to a pixel; the support of the
model, and its prior, would then be those of the dish's beam.  Its part in the response Σ‖Φe_p‖²/σ² is therefore at
most `MOST` of that of the visibilities.  The flux of a source known to one part in a thousand is then known to one in a
few hundred still.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casa_sara.operators.norms import power_method
from casa_sara.operators.single_dish import GaussianBeam, ImagedBeam, Points, SingleDishOperator
from casa_sara.solver.nnls import NNLSFit, nnls

__all__ = ["MOST", "Beside", "TotalPower", "WhitenedDish"]

MOST = 0.03  # of the response of the visibilities to a pixel
PASSED = 0.5  # by a beam, of what points half of it apart measure
ALONE, LAST_PENALTY = 300, 1e-5  # iterations of the image of a dish alone, and where its penalty ends
LOOKED_AT = 9  # points at which the response of the dish is measured


@dataclass(frozen=True)
class TotalPower:
    """What a single dish has measured of the sky of an image.

    Attributes
    ----------
    values : float64 (N,)
        Jy/beam at each of the points.
    points : Points
        Half a beam apart.
    beam : GaussianBeam or ImagedBeam
        Of the dish.
    cell_rad : (float, float)
        Pixel size of the image.
    over : real (nx, ny), optional
        The sky is the image times this.
    """

    values: np.ndarray
    points: Points
    beam: GaussianBeam | ImagedBeam
    cell_rad: tuple[float, float]
    over: np.ndarray | None = None

    def operator(self, shape: tuple[int, int], scale: float, nthreads: Any) -> SingleDishOperator:
        """Return Φ, in single precision, times a scale.

        Parameters
        ----------
        shape : (int, int)
            Pixels of the image.
        scale : float
            On all values.
        nthreads : int or Workers
            Threads.

        Returns
        -------
        SingleDishOperator
        """
        return SingleDishOperator(self.points, self.beam, shape, self.cell_rad, self.over, scale, nthreads=nthreads)

    def whitened(self, shape: tuple[int, int], weight: float, unit_jy: float, nthreads: Any) -> WhitenedDish:
        """Return the block for images in `unit_jy`, whitened so that it counts `MOST` where its noise is 1.

        Parameters
        ----------
        shape : (int, int)
            Pixels of the image.
        weight : float
            Σw of the visibilities, 1/Jy²: their response to a pixel.
        unit_jy : float
            Jy/pixel in the unit of the image.
        nthreads : int or Workers
            Threads.

        Returns
        -------
        WhitenedDish
        """
        plain = self.operator(shape, 1.0, nthreads)
        scale = float(np.sqrt(MOST * weight / self._response(plain)))
        operator = self.operator(shape, scale * unit_jy, plain.workers)
        vis = np.zeros(operator.size, np.complex64)
        vis.view(np.float32)[:self.values.size] = scale * self.values
        return WhitenedDish(vis, operator, MOST * weight * unit_jy**2, scale)

    def _response(self, operator):
        """The median over some points of ‖Φe_p‖², e_p a pixel of 1 at the point."""
        chosen = np.unique(np.linspace(0, self.values.size - 1, LOOKED_AT).astype(int))
        found, image = [], np.zeros(operator.shape, operator.dtype)
        for x, y in np.rint(self.points.pixels(operator.shape, self.cell_rad)).astype(int).T[chosen]:
            pixel = np.clip(x, 0, operator.shape[0] - 1), np.clip(y, 0, operator.shape[1] - 1)
            image[pixel] = 1
            found.append(float(np.linalg.norm(operator.forward(image)) ** 2))
            image[pixel] = 0
        return float(np.median(found))


@dataclass(frozen=True)
class WhitenedDish:
    """The block of a problem.

    Attributes
    ----------
    vis : complex64 (M,)
        y, values times `scale`, in pairs.
    operator : SingleDishOperator
        Φ of images in the unit of the problem.
    weight_sum : float
        Its response to a pixel where its noise is 1, in the unit of the problem; what Σw is for visibilities.
    scale : float
        1/(Jy/beam).
    """

    vis: np.ndarray
    operator: SingleDishOperator
    weight_sum: float
    scale: float

    def noise_norm(self, positivity: bool, support: np.ndarray | None) -> float:
        """Return about ‖n‖ of the noise, from what the best image of the dish alone leaves of its values.

        A beam passes about half of what points half a beam apart measure; of that such an image may leave nothing.

        Parameters
        ----------
        positivity : bool
            Whether the image is non-negative.
        support : bool (nx, ny) or None
            Where it may be non-zero.

        Returns
        -------
        float
        """
        fit, precond = NNLSFit(ALONE, LAST_PENALTY, positivity=positivity), np.ones(self.vis.size, np.float32)
        _, left = nnls(self.operator, self.vis, precond, self._norm_sq, fit, support=support)
        return float(np.linalg.norm(left) / np.sqrt(1 - PASSED))

    @cached_property
    def _norm_sq(self):
        """‖Φ‖²."""
        operator = self.operator
        return power_method(lambda image: operator.adjoint(operator.forward(image)), operator.shape, dtype=np.float32)

    def precond(self, norm_sq: float) -> np.ndarray:
        """Return U, float32 (M,), one number for which ‖U^½Φ‖² is that of the visibilities.

        Parameters
        ----------
        norm_sq : float
            About ‖U^½Φ‖² of the visibilities.

        Returns
        -------
        float32 (M,)
        """
        return np.full(self.vis.size, norm_sq / self._norm_sq, np.float32)


class Beside:
    """What renews averages of visibilities, for an iteration that has a single dish beside them.

    Parameters
    ----------
    averaged : casa_sara.data.averaging.Averaged
        Of the visibilities.
    dish : complex (M,)
        Whitened values, which stay.
    """

    def __init__(self, averaged: Any, dish: np.ndarray) -> None:
        self._averaged, self._dish = averaged, dish

    enlarged = costly = False

    def renew(self, model: np.ndarray, predicted: np.ndarray,
              multipliers: np.ndarray | None = None) -> tuple[np.ndarray, None]:
        """Turn Φ̄x of the averages into ȳ, and Φx of the dish into y.

        Parameters
        ----------
        model : real (nx, ny)
            x.
        predicted : complex (cells + M,)
            Φ̄x and Φx.
        multipliers : None
            Cells are not enlarged.

        Returns
        -------
        scatter : float64 (d + 1,)
            Of each block; that of the dish has none.
        gradient : None
        """
        count = predicted.size - self._dish.size
        predicted[count:] = self._dish
        return np.append(self._averaged.renew(model, predicted[:count])[0], 0.0), None
