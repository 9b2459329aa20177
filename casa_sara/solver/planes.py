"""The planes of the unknown: one image, images of several sub-bands, or images of several parts of the sky.

Several are stacked along their first axis. Those of sub-bands (:class:`Planes`) show one sky, whose support they share;
those of several parts of the sky (:class:`Images`) have each a support of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from casa_sara.options import images_in, stacked_shape
from casa_sara.solver.point_sources import PointSources

__all__ = ["Images", "Planes"]

EVERYTHING = slice(None)


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

    def split(self, stacked: np.ndarray) -> Any:
        """Return the stacked images one by one, without a copy.

        Parameters
        ----------
        stacked : (T·nx, ny)
            z.

        Returns
        -------
        T arrays (nx, ny)
        """
        return stacked.reshape(self.n_planes, -1, stacked.shape[-1])

    def each(self, function: Callable[[np.ndarray], np.ndarray], stacked: np.ndarray) -> np.ndarray:
        """Return what a function of one image makes of each, stacked and of the same type.

        Parameters
        ----------
        function : callable
            Takes an image (nx, ny) and returns one.
        stacked : (T·nx, ny)
            Images.

        Returns
        -------
        (T·nx, ny)
        """
        out = np.zeros_like(stacked)
        for image, result in zip(self.split(stacked), self.split(out)):
            result[...] = function(image)
        return out

    @property
    def parts(self) -> list[slice]:
        """The rows of each part of the sky; all of them where there is one."""
        return [EVERYTHING]

    def places(self, points: PointSources) -> list[np.ndarray | slice]:
        """Return which of some points are in each part of the sky.

        Parameters
        ----------
        points : PointSources
            Of the stacked images.

        Returns
        -------
        list of int arrays, or of slices
        """
        return [EVERYTHING]

    def main(self, stacked: np.ndarray) -> np.ndarray:
        """Return the part of stacked images that shows the part of the sky which was asked for, without a copy.

        Parameters
        ----------
        stacked : (T·nx, ny)
            Images.

        Returns
        -------
        array
        """
        return stacked

    def means(self, stacked: np.ndarray) -> list[np.ndarray]:
        """Return :meth:`mean` of each part of the sky.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            z.

        Returns
        -------
        list of real (nx, ny)
        """
        return [self.mean(stacked)]

    def looked_at(self, stacked: np.ndarray) -> list[np.ndarray]:
        """Return :meth:`at_reference` of each part of the sky.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            z.

        Returns
        -------
        list of real (nx, ny)
        """
        return [self.at_reference(stacked)]

    def allowed(self, support: np.ndarray | None, stacked: np.ndarray) -> list[np.ndarray]:
        """Return the pixels of each part of the sky that a support of the stacked images leaves; all without one.

        Parameters
        ----------
        support : bool (T·nx, ny) or None
            The support.
        stacked : real (T·nx, ny)
            Of whose shape it is.

        Returns
        -------
        list of bool (nx, ny)
        """
        return [np.ones(self.split(stacked)[0].shape, bool) if support is None else self.split(support)[0]]

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
        image = self.difference_at_reference(stacked)
        if self._positivity and self.n_planes > 1:
            np.maximum(image, 0, out=image, where=self.split(stacked).min(axis=0) >= 0)
        return image

    def difference_at_reference(self, stacked: np.ndarray) -> np.ndarray:
        """Return what a change of all images is in the image that is looked at, whatever its sign.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            Of z.

        Returns
        -------
        real (nx, ny)
        """
        return self._combined(self._reference, stacked)

    def _combined(self, factors, stacked):
        if self.n_planes == 1:
            return stacked
        return np.einsum("t,txy", factors.astype(stacked.dtype), self.split(stacked))  # not BLAS: see SubbandDictionary

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

    def joined(self, supports: Sequence[np.ndarray]) -> np.ndarray:
        """Return the support of the stacked images of that of each part of the sky.

        Parameters
        ----------
        supports : list of bool (nx, ny)
            Of each.

        Returns
        -------
        bool (T·nx, ny)
        """
        support, = supports
        return support if self.n_planes == 1 else np.tile(support, (self.n_planes, 1))

    def points(self, points: Sequence[PointSources], shape: tuple[int, ...]) -> PointSources:
        """Return the points of the stacked images of those of each part of the sky; each plane has a flux of its own.

        Parameters
        ----------
        points : list of PointSources
            Of each.
        shape : (int, int)
            Of the stacked images.

        Returns
        -------
        PointSources
        """
        only, = points
        if self.n_planes == 1:
            return only
        steps = np.arange(self.n_planes)[:, None, None] * [shape[0] // self.n_planes, 0]
        return PointSources((only.places + steps).reshape(-1, 2))

    def set_pixel(self, stacked: np.ndarray, place: Sequence[int], part: int = 0) -> None:
        """Make all of it 0 but for one pixel, which is 1 in all planes.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            Changed in place.
        place : (int, int)
            The pixel in a plane.
        part : int
            Number of the part of the sky.
        """
        stacked.fill(0)
        x, y = place
        for plane, root in zip(self.split(stacked), self.roots):
            plane[x, y] = root


class Images(Planes):
    """Images of several parts of the sky, of equal noise, the main one first.

    Parameters
    ----------
    shapes : sequence of (int, int)
        Of each: see :func:`casa_sara.options.stacked_shape`.
    """

    def __init__(self, shapes: Sequence[tuple[int, int]]) -> None:
        super().__init__()
        self._shapes = tuple(shapes)
        ends = np.cumsum([nx for nx, _ in self._shapes]).tolist()
        self._parts = [slice(end - nx, end) for end, (nx, _) in zip(ends, self._shapes)]

    @property
    def parts(self) -> list[slice]:
        """The rows of each."""
        return self._parts

    def split(self, stacked: np.ndarray) -> Any:
        """Return the images, without a copy.

        Parameters
        ----------
        stacked : (Σ nx, max ny)
            Images.

        Returns
        -------
        list of (nx, ny)
        """
        return images_in(stacked, self._shapes)

    def places(self, points: PointSources) -> list[np.ndarray | slice]:
        """Return which points are in each image.

        Parameters
        ----------
        points : PointSources
            Of the stacked images.

        Returns
        -------
        list of int arrays
        """
        rows = points.places[:, 0]
        return [np.flatnonzero((rows >= part.start) & (rows < part.stop)) for part in self._parts]

    def main(self, stacked: np.ndarray) -> np.ndarray:
        """Return the first image, without a copy.

        Parameters
        ----------
        stacked : (Σ nx, max ny)
            Images.

        Returns
        -------
        (nx, ny)
        """
        return self.split(stacked)[0]

    def means(self, stacked: np.ndarray) -> list[np.ndarray]:
        """Return the images, without a copy.

        Parameters
        ----------
        stacked : real (Σ nx, max ny)
            Images.

        Returns
        -------
        list of real (nx, ny)
        """
        return list(self.split(stacked))

    def at_reference(self, stacked: np.ndarray) -> np.ndarray:
        """Return the first image, without a copy.

        Parameters
        ----------
        stacked : real (Σ nx, max ny)
            Images.

        Returns
        -------
        real (nx, ny)
        """
        return self.main(stacked)

    def looked_at(self, stacked: np.ndarray) -> list[np.ndarray]:
        """Return the images, without a copy.

        Parameters
        ----------
        stacked : real (Σ nx, max ny)
            Images.

        Returns
        -------
        list of real (nx, ny)
        """
        return list(self.split(stacked))

    def allowed(self, support: np.ndarray | None, stacked: np.ndarray) -> list[np.ndarray]:
        """Return where each image may be non-zero.

        Parameters
        ----------
        support : bool (Σ nx, max ny) or None
            Of all; everywhere without it.
        stacked : real (Σ nx, max ny)
            Of whose shape it is.

        Returns
        -------
        list of bool (nx, ny)
        """
        return [np.ones(image.shape, bool) for image in self.split(stacked)] if support is None \
            else list(self.split(support))

    def joined(self, supports: Sequence[np.ndarray]) -> np.ndarray:
        """Return the support of all.

        Parameters
        ----------
        supports : list of bool (nx, ny)
            Of each.

        Returns
        -------
        bool (Σ nx, max ny)
        """
        support = np.zeros(stacked_shape(self._shapes), bool)
        for own, image in zip(supports, self.split(support)):
            image[...] = own
        return support

    def points(self, points: Sequence[PointSources], shape: tuple[int, ...]) -> PointSources:
        """Return the points of all.

        Parameters
        ----------
        points : list of PointSources
            Of each image.
        shape : (int, int)
            Of the stacked images.

        Returns
        -------
        PointSources
        """
        return PointSources(np.concatenate([own.places + [part.start, 0] for own, part in zip(points, self._parts)]))

    def set_pixel(self, stacked: np.ndarray, place: Sequence[int], part: int = 0) -> None:
        """Make all of it 0 but for a pixel of one image, which is 1.

        Parameters
        ----------
        stacked : real (Σ nx, max ny)
            Changed in place.
        place : (int, int)
            The pixel.
        part : int
            Number of the image.
        """
        stacked.fill(0)
        self.split(stacked)[part][tuple(place)] = 1
