"""The planes of the unknown: one image, or images of several sub-bands stacked along their first axis."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from casa_sara.solver.point_sources import PointSources

__all__ = ["Planes"]


class Planes:
    """How stacked images z_t of equal noise make one: that of a sky that is the same in all of them has z_t = r_t·x.

    Parameters
    ----------
    roots : float (T,)
        r, with Σr² = 1; of one image (1,).
    reference : float (T,)
        The image that is looked at is Σ_t reference_t z_t.
    positivity : bool
        It is not negative where no plane is.
    """

    def __init__(self, roots: npt.ArrayLike = (1.0,), reference: npt.ArrayLike = (1.0,),
                 positivity: bool = False) -> None:
        self.roots, self._reference = np.asarray(roots, float), np.asarray(reference, float)
        self._positivity = positivity

    @property
    def n_planes(self) -> int:
        """T."""
        return len(self.roots)

    def split(self, stacked: np.ndarray) -> np.ndarray:
        """Return stacked images as an array (T, nx, ny), without a copy.

        Parameters
        ----------
        stacked : (T·nx, ny)
            z.

        Returns
        -------
        (T, nx, ny)
        """
        return stacked.reshape(self.n_planes, -1, stacked.shape[-1])

    def mean(self, stacked: np.ndarray) -> np.ndarray:
        """Return Σ r_t z_t, of all images what the data see as one.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            z.

        Returns
        -------
        real (nx, ny)
        """
        return self._combined(self.roots, stacked)

    def at_reference(self, stacked: np.ndarray) -> np.ndarray:
        """Return the image that is looked at.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            z.

        Returns
        -------
        real (nx, ny)
        """
        image = self._combined(self._reference, stacked)
        if self._positivity and self.n_planes > 1:
            np.maximum(image, 0, out=image, where=self.split(stacked).min(axis=0) >= 0)
        return image

    def _combined(self, factors, stacked):
        if self.n_planes == 1:
            return stacked
        return np.tensordot(factors.astype(stacked.dtype), self.split(stacked), 1)

    def stacked(self, image: np.ndarray) -> np.ndarray:
        """Return z of a sky that is the same in all planes.

        Parameters
        ----------
        image : real (nx, ny)
            x.

        Returns
        -------
        real (T·nx, ny)
        """
        if self.n_planes == 1:
            return image
        return (self.roots.astype(image.dtype)[:, None, None] * image).reshape(-1, image.shape[-1])

    def repeated(self, pixels: np.ndarray) -> np.ndarray:
        """Return the same pixels of every plane.

        Parameters
        ----------
        pixels : bool (nx, ny)
            Of one.

        Returns
        -------
        bool (T·nx, ny)
        """
        return pixels if self.n_planes == 1 else np.tile(pixels, (self.n_planes, 1))

    def points(self, points: PointSources, shape: tuple[int, ...]) -> PointSources:
        """Return the same points in every plane, each with a flux of its own.

        Parameters
        ----------
        points : PointSources
            Of one.
        shape : (int, int)
            Of the stacked images.

        Returns
        -------
        PointSources
        """
        if self.n_planes == 1:
            return points
        steps = np.arange(self.n_planes)[:, None, None] * [shape[0] // self.n_planes, 0]
        return PointSources((points.places + steps).reshape(-1, 2))

    def set_pixel(self, stacked: np.ndarray, place: Sequence[int]) -> None:
        """Make all of it 0 but for one pixel, which is 1 in all planes.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            Changed in place.
        place : (int, int)
            The pixel in a plane.
        """
        stacked.fill(0)
        x, y = place
        self.split(stacked)[:, x, y] = self.roots
