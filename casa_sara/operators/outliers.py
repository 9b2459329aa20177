"""Several images of one observation: a main image, and small ones elsewhere on the sky (`outlierfile`).

    V_m = Σ_o exp(2πi (w_om − w_m)) (Φ_o x_o)_m,      (u_o, v_o, w_o) = R_o (u, v, w),

R_o turns baselines from the axes of the main image to those of image o (the identity for the main image itself).
w_o − w is the baseline along the direction of the centre of o less that along the direction of the main centre, so that
the geometry is exact there; Φ_o is the operator of image o alone, with or without the w-term of its own field.

Images and gradients are stacked along their first axis (:func:`casa_sara.options.stacked_shape`); coefficients of the
dictionary follow one another in one line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from casa_sara.operators._arguments import checked, for_adjoint, for_forward
from casa_sara.operators._coefficient_layout import aligned
from casa_sara.operators.dictionary import Band, SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator, share_work_space
from casa_sara.options import ImageGrid, Outlier, images_in, stacked_shape

__all__ = ["ImagesDictionary", "ImagesOperator", "directions", "extents", "operator_of_images", "rotation", "stacked"]


def stacked(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return images in one array, zeros beside the narrower ones.

    Parameters
    ----------
    images : sequence of arrays (nx, ny)
        Of one type.

    Returns
    -------
    array (Σ nx, max ny)
    """
    shapes = [image.shape for image in images]
    out = np.zeros(stacked_shape(shapes), images[0].dtype)
    for view, image in zip(images_in(out, shapes), images):
        view[...] = image
    return out


def rotation(uvw: np.ndarray, outlier: Outlier) -> np.ndarray:
    """Return exp(2πi(w_o − w)), by which visibilities at the centre of an outlier are those at the main centre.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths, along the axes of the main image.
    outlier : Outlier
        With its `turn`.

    Returns
    -------
    complex64 (M,)
    """
    cycles = (outlier.turn[2] - [0, 0, 1]) @ uvw
    return np.exp(2j * np.pi * (cycles - np.rint(cycles))).astype(np.complex64)


def directions(outlier: Outlier) -> np.ndarray:
    """Return the directions of the corners of an outlier along the axes of the main image, float64 (3, 4): l, m, n.

    Parameters
    ----------
    outlier : Outlier
        With its `turn`.

    Returns
    -------
    float64 (3, 4)
    """
    half = [n * cell / 2 for n, cell in zip(outlier.grid.shape, outlier.grid.cell_rad)]
    l, m = half[0] * np.array([-1, 1, 1, -1]), half[1] * np.array([-1, -1, 1, 1])
    return np.asarray(outlier.turn).T @ np.array([l, m, np.sqrt(1 - l**2 - m**2)])


def extents(grid: ImageGrid) -> tuple[float, float, float]:
    """Return the largest |l| and |m| in an image and its outliers, and the largest 1 − n in the outliers.

    Parameters
    ----------
    grid : ImageGrid
        With its outliers.

    Returns
    -------
    float, float, float
    """
    corners = np.concatenate([directions(outlier) for outlier in grid.outliers], axis=1)
    half = [n * cell / 2 for n, cell in zip(grid.shape, grid.cell_rad)]
    l, m = (max(own, float(np.abs(axis).max())) for own, axis in zip(half, corners))
    return l, m, float((1 - corners[2]).max())


def operator_of_images(uvw: np.ndarray, grid: ImageGrid,
                       of_image: Callable[[np.ndarray, ImageGrid, Any], Any]) -> ImagesOperator:
    """Return the measurement operator of an image with its outliers.

    Parameters
    ----------
    uvw : float64 (3, M)
        Baselines in wavelengths, along the axes of the main image.
    grid : ImageGrid
        With its outliers, and their `turn`.
    of_image : callable
        Takes baselines, the grid of one image, and threads (None for new ones), and returns its operator.

    Returns
    -------
    ImagesOperator
    """
    operators = [of_image(uvw, replace(grid, outliers=()), None)]
    operators += [of_image(outlier.turn @ uvw, outlier.grid, operators[0].workers) for outlier in grid.outliers]
    if all(isinstance(operator, MeasurementOperator) for operator in operators):
        share_work_space(operators)
    return ImagesOperator(operators, [rotation(uvw, outlier) for outlier in grid.outliers])


class _Stack:
    """Access to images in a stack: those that are not in one piece there go through a buffer."""

    def __init__(self, shapes, dtype):
        self._shapes = list(shapes)
        self.shape = stacked_shape(self._shapes)
        self.padded = any(ny < self.shape[1] for _, ny in self._shapes)
        self._buffers = [np.empty(shape if shape[1] < self.shape[1] else (0, 0), dtype) for shape in self._shapes]

    def read(self, array: np.ndarray) -> Iterator[np.ndarray]:
        """Yield the images, each valid until the next one is asked for."""
        for view, buffer in zip(images_in(array, self._shapes), self._buffers):
            if buffer.size:
                np.copyto(buffer, view)
            yield buffer if buffer.size else view

    def write(self, array: np.ndarray) -> Iterator[np.ndarray]:
        """Yield arrays for the images, which are stored when the next one, or the end, is asked for: first in a zip."""
        if self.padded:
            array.fill(0)
        for view, buffer in zip(images_in(array, self._shapes), self._buffers):
            yield buffer if buffer.size else view
            if buffer.size:
                np.copyto(view, buffer)


class ImagesOperator:
    """Σ_o r_o Φ_o x_o of stacked images and its adjoint; nothing is allocated by calls with `out`.

    As of :class:`casa_sara.operators.measurement.MeasurementOperator`, one operator serves one thread at a time.

    Parameters
    ----------
    operators : sequence of objects
        Φ_o, the main image first: `forward`, `adjoint`, `shape`, `size`, `dtype`, `complex_dtype` and `workers`.
    rotations : sequence of complex64 (M,)
        r_o of all but the first, for which it is 1.
    """

    def __init__(self, operators: Sequence[Any], rotations: Sequence[np.ndarray]) -> None:
        main = operators[0]
        self.size, self.workers = main.size, main.workers
        self.dtype, self.complex_dtype = main.dtype, main.complex_dtype
        self._operators, self._rotations = list(operators), list(rotations)
        self._stack = _Stack([operator.shape for operator in operators], self.dtype)
        self.shape: tuple[int, ...] = self._stack.shape
        self._vis = np.empty(self.size, self.complex_dtype)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities of stacked images.

        Parameters
        ----------
        image : real (Σ nx, max ny)
            x_o.
        out : complex (M,), optional
            Where the result goes.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        for operator, own, turn in zip(self._operators, self._stack.read(image), [None, *self._rotations]):
            if turn is None:
                operator.forward(own, out)
            else:
                operator.forward(own, self._vis)
                self._vis *= turn
                out += self._vis
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the stacked images, the adjoint for real inner products, of visibilities.

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : real (Σ nx, max ny), optional
            Where the result goes.

        Returns
        -------
        real (Σ nx, max ny)
        """
        vis, out = for_adjoint(self, vis, out)
        for own, operator, turn in zip(self._stack.write(out), self._operators, [None, *self._rotations]):
            if turn is None:
                operator.adjoint(vis, own)
            else:
                np.conjugate(vis, out=self._vis)
                self._vis *= turn
                np.conjugate(self._vis, out=self._vis)
                operator.adjoint(self._vis, own)
        return out


class ImagesDictionary:
    """Ψ of stacked images: that of each, so that it is a Parseval frame as these are.

    Parameters
    ----------
    dictionaries : sequence of SaraDictionary
        Of each image, of the same bases.
    """

    def __init__(self, dictionaries: Sequence[SaraDictionary]) -> None:
        self._dictionaries = list(dictionaries)
        self.n_bases, self.dtype = self._dictionaries[0].n_bases, self._dictionaries[0].dtype
        self._shapes: list[Any] = [dictionary.shape for dictionary in self._dictionaries]
        self._in, self._out = (_Stack(self._shapes, self.dtype) for _ in range(2))
        self.shape = self._in.shape
        ends = np.cumsum([dictionary.n_coefs for dictionary in self._dictionaries]).tolist()
        self._parts = [(slice(end - dictionary.n_coefs, end), dictionary.coef_shape)
                       for end, dictionary in zip(ends, self._dictionaries)]
        self.n_coefs = ends[-1]

    def allocate(self) -> np.ndarray:
        """Return an array of coefficients, all 0."""
        return aligned((self.n_coefs,), self.dtype)

    def bands(self) -> list[Band]:
        """Return the list of all :class:`~casa_sara.operators.dictionary.Band`, those of the first image first."""
        return [band._replace(part=part) for dictionary, part in zip(self._dictionaries, self._parts)
                for band in dictionary.bands()]

    def analysis(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ†·image, in `out` where given.

        Parameters
        ----------
        image : real (Σ nx, max ny)
            Stacked images.
        out : real (n_coefs,), optional
            Receives the result.

        Returns
        -------
        real (n_coefs,)
        """
        out = self.allocate() if out is None else out
        for dictionary, own, coefs in zip(self._dictionaries, self._in.read(image), self._split(out)):
            dictionary.analysis(own, coefs)
        return out

    def synthesis(self, coefs: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ·coefs, in `out` where given.

        Parameters
        ----------
        coefs : real (n_coefs,)
            The coefficients.
        out : real (Σ nx, max ny), optional
            Receives the result.

        Returns
        -------
        real (Σ nx, max ny)
        """
        out = np.empty(self.shape, self.dtype) if out is None else out
        for own, dictionary, one in zip(self._out.write(out), self._dictionaries, self._split(coefs)):
            dictionary.synthesis(one, own)
        return out

    def dual_step(self, model_bar: np.ndarray, dual: np.ndarray, threshold: float, weights: np.ndarray,
                  out: np.ndarray, relaxation: float = 1.0) -> np.ndarray:
        """Update the dual variables in place and return Ψ·dual: as `SaraDictionary.dual_step`, for every image.

        Parameters
        ----------
        model_bar : real (Σ nx, max ny)
            x̄.
        dual, weights : real (n_coefs,)
            u and W.
        threshold : float
            κ.
        out : real (Σ nx, max ny)
            Receives the result.
        relaxation : float
            ρ.

        Returns
        -------
        real (Σ nx, max ny)
        """
        pieces = zip(self._out.write(out), self._in.read(model_bar), self._dictionaries, self._split(dual),
                     self._split(weights))
        for own, bar, dictionary, one, weight in pieces:
            dictionary.dual_step(bar, one, threshold, weight, own, relaxation)
        return out

    def reweight(self, image: np.ndarray, alpha: np.ndarray, scale: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Fill `out` with the weights s·α/(α + d̄) of every image: as `SaraDictionary.reweight`.

        Parameters
        ----------
        image : real (Σ nx, max ny)
            Stacked images.
        alpha, scale : float (number of bands,)
            α and s, in the order of `bands`.
        out : real (n_coefs,)
            Receives the weights.

        Returns
        -------
        real (n_coefs,)
        """
        count = len(self._dictionaries)
        pieces = zip(self._dictionaries, self._in.read(image), np.split(alpha, count), np.split(scale, count),
                     self._split(out))
        for dictionary, own, a, s, one in pieces:
            dictionary.reweight(own, a, s, one)
        return out

    def scale_at(self, coefs: np.ndarray, pixels: np.ndarray, factor: float) -> None:
        """Multiply the coefficients that describe some pixels, in place.

        Parameters
        ----------
        coefs : real (n_coefs,)
            Changed in place.
        pixels : bool (Σ nx, max ny)
            Pixels whose coefficients are meant.
        factor : float
            Factor on their weights.
        """
        for dictionary, one, own in zip(self._dictionaries, self._split(coefs), images_in(pixels, self._shapes)):
            dictionary.scale_at(one, own, factor)

    def _split(self, coefs):
        """Return the coefficients of every image, without copies."""
        coefs = checked(coefs, "coefs", (self.n_coefs,), self.dtype)
        return [coefs[part].reshape(shape) for part, shape in self._parts]
