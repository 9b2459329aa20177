"""A sky whose spectrum is not known: several frequencies at which it is solved for, and what the data see of it.

Between the frequencies ν_t the brightness of a pixel is the polynomial in ln ν through its values I(ν_t), of `nterms`
terms:

    I(ν) = Σ_t L_t(ln ν) I(ν_t),      L_t the polynomials of Lagrange.

The ν_t are those of the Gauss quadrature of the data: with w_t the share of the weight of all data that ν_t stands for,

    Σ_m w_m L_s(ν_m) L_t(ν_m) = δ_st w_t Σ_m w_m,

so that the sky is solved for in z_t = √w_t I(ν_t), images of equal noise, that the data do not mix but for where in the
uv plane they lie.  Their orders c_k = Σ_t F_kt z_t, F orthonormal with the first row √w_t, are the mean spectrum of a
pixel, its slope, its curvature …; a flat spectrum has but the first, which then has the noise of an image of all data.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import eigh_tridiagonal

from casa_sara.operators._arguments import for_adjoint, for_forward
from casa_sara.operators._workers import Workers
from casa_sara.operators.dictionary import Band, SaraDictionary
from casa_sara.operators.modulated import add_term, take_term
from casa_sara.runtime import jit

__all__ = ["SubbandDictionary", "SubbandOperator", "Subbands"]

PIXELS_AT_ONCE = 4096


@dataclass(frozen=True)
class Subbands:
    """The frequencies at which the sky is solved for.

    Attributes
    ----------
    freqs_hz : float (T,)
        ν_t, ascending.
    shares : float (T,)
        w_t, whose sum is 1.
    reference_hz : float
        ν_0, that of the model.
    band_hz : (float, float)
        Lowest and highest frequency of the data.
    """

    freqs_hz: np.ndarray
    shares: np.ndarray
    reference_hz: float
    band_hz: tuple[float, float]

    @classmethod
    def of(cls, freq_hz: np.ndarray, weight: np.ndarray, nterms: int, reference_hz: float) -> Subbands:
        """Return those of the data: the nodes and weights of their Gauss quadrature (Golub & Welsch 1969).

        Parameters
        ----------
        freq_hz : real (M,)
            Frequencies of the samples.
        weight : real (M,)
            Their weights.
        nterms : int
            T.
        reference_hz : float
            Frequency of the model.

        Returns
        -------
        Subbands

        Raises
        ------
        ValueError
            There are fewer frequencies than terms.
        """
        distinct, number = np.unique(freq_hz, return_inverse=True)
        if distinct.size < nterms:
            raise ValueError(f"nterms = {nterms}: the data have {distinct.size} frequencies; should be at most as many")
        share = np.bincount(number.ravel(), np.asarray(weight, float))
        share = share / share.sum()
        place = np.log(distinct.astype(float))
        centre = float(share @ place)
        place -= centre
        # the recurrence of the orthonormal polynomials of the data, whose Jacobi matrix has the nodes
        diagonal, beside = np.zeros(nterms), np.zeros(nterms)
        before, now = np.zeros_like(place), np.ones_like(place)
        for k in range(nterms):
            diagonal[k] = share @ (place * now * now)
            after = (place - diagonal[k]) * now - (beside[k - 1] * before if k else 0.0)
            beside[k] = np.sqrt(share @ (after * after))
            before, now = now, after / max(beside[k], np.finfo(float).tiny)
        nodes, vectors = eigh_tridiagonal(diagonal, beside[:-1])
        return cls(np.exp(nodes + centre), vectors[0] ** 2, float(reference_hz),
                   (float(distinct[0]), float(distinct[-1])))

    @property
    def n_terms(self) -> int:
        """Number of frequencies T."""
        return len(self.freqs_hz)

    @property
    def orders(self) -> np.ndarray:
        """F, float64 (T, T), orthonormal."""
        place = np.log(self.freqs_hz / self.reference_hz)
        powers = np.sqrt(self.shares)[:, None] * place[:, None] ** np.arange(self.n_terms)
        found, triangle = np.linalg.qr(powers)
        return (found * np.sign(np.diag(triangle))).T

    def factors(self, freq_hz: np.ndarray) -> np.ndarray:
        """Return L_t(ln ν)/√w_t: what z_t contributes at some frequencies.

        Parameters
        ----------
        freq_hz : real (M,)
            Frequencies.

        Returns
        -------
        float64 (T, M)
        """
        place, nodes = np.log(np.asarray(freq_hz, float) / self.reference_hz), np.log(self.freqs_hz / self.reference_hz)
        out = np.empty((self.n_terms, place.size))
        for t, node in enumerate(nodes):
            others = np.delete(nodes, t)
            out[t] = np.prod((place - others[:, None]) / (node - others)[:, None], axis=0) / np.sqrt(self.shares[t])
        return out

    def band_of(self, freq_hz: np.ndarray) -> np.ndarray:
        """Return to which of T parts of the band, each of the weight w_t, the frequencies belong, int (M,).

        Parameters
        ----------
        freq_hz : real (M,)
            Frequencies.

        Returns
        -------
        int64 (M,)
        """
        middles = np.sqrt(self.freqs_hz[1:] * self.freqs_hz[:-1])
        return np.searchsorted(middles, freq_hz)

    def spectra(self, stacked: np.ndarray) -> np.ndarray:
        """Return I(ν_t) of stacked images z.

        Parameters
        ----------
        stacked : real (T·nx, ny)
            z.

        Returns
        -------
        real (T, nx, ny)
        """
        brightness = stacked.reshape(self.n_terms, -1, stacked.shape[-1])
        return brightness / np.sqrt(self.shares).astype(stacked.dtype)[:, None, None]

    def stacked(self, spectra: np.ndarray) -> np.ndarray:
        """Return z of images I(ν_t), or of one image that is the same at all frequencies.

        Parameters
        ----------
        spectra : real (T, nx, ny) or (nx, ny)
            Brightness.

        Returns
        -------
        real (T·nx, ny)
        """
        z = spectra * np.sqrt(self.shares).astype(spectra.dtype)[:, None, None]
        return z.reshape(-1, z.shape[-1])

    def reference_weights(self) -> np.ndarray:
        """Return what each z_t contributes at the frequency of the model, float64 (T,)."""
        return self.factors(np.array([self.reference_hz]))[:, 0]


class SubbandOperator:
    """Σ_t g_tm (Φ z_t)_m of images z stacked along their first axis, (T·nx, ny), and its adjoint.

    As of :class:`casa_sara.operators.measurement.MeasurementOperator`; nothing is allocated by calls with `out`.

    Parameters
    ----------
    base : object
        The plain Φ: `forward`, `adjoint`, `shape`, `size`, `dtype`, `complex_dtype` and `workers`.
    factors : real (T, M)
        g, of the base's dtype.
    """

    def __init__(self, base: Any, factors: np.ndarray) -> None:
        self.size, self.dtype, self.complex_dtype = base.size, base.dtype, base.complex_dtype
        self.workers = base.workers
        self.shape: tuple[int, ...] = (len(factors) * base.shape[0], base.shape[1])
        self._base, self._factors = base, np.ascontiguousarray(factors, base.dtype)
        self._one, self._none = self.complex_dtype.type(1), np.empty(0, self.complex_dtype)
        self._vis = np.empty(self.size, self.complex_dtype)

    def _planes(self, image):
        return image.reshape(len(self._factors), *self._base.shape)

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the visibilities, complex (M,), of stacked images, in `out` where given.

        Parameters
        ----------
        image : real (T·nx, ny)
            z.
        out : array, optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        image, out = for_forward(self, image, out)
        for t, (plane, factor) in enumerate(zip(self._planes(image), self._factors)):
            self._base.forward(plane, self._vis)
            self.workers.run(add_term, t, self._one, factor, self._vis, out)
        return out

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return the stacked images, the adjoint for real inner products, of complex visibilities (M,).

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : array, optional
            Receives the result.

        Returns
        -------
        real (T·nx, ny)
        """
        vis, out = for_adjoint(self, vis, out)
        for plane, factor in zip(self._planes(out), self._factors):
            self.workers.run(take_term, self._one, factor, self._none, vis, self._vis)
            self._base.adjoint(self._vis, plane)
        return out


class SubbandDictionary:
    """Ψ of the orders of the spectra of stacked images: a Parseval frame, as the dictionary of one image is.

    Coefficients have the shape (T, *that of one image*).

    Parameters
    ----------
    dictionary : SaraDictionary
        Of one image.
    orders : float (T, T)
        F.
    nthreads : int
        Threads.
    """

    def __init__(self, dictionary: SaraDictionary, orders: np.ndarray, nthreads: int = 1) -> None:
        self._dictionary, self.n_bases = dictionary, dictionary.n_bases
        self._orders = np.ascontiguousarray(orders, dictionary.dtype)
        self._back = np.ascontiguousarray(self._orders.T)
        self.shape = (len(orders) * dictionary.shape[0], dictionary.shape[1])
        self._in, self._out = (np.empty((len(orders), *dictionary.shape), dictionary.dtype) for _ in range(2))
        self._workers = Workers(nthreads)

    def allocate(self) -> np.ndarray:
        """Return an array of coefficients, all 0."""
        one = self._dictionary.coef_shape
        return np.zeros((len(self._orders), *one), self._dictionary.dtype)

    def bands(self) -> list[Band]:
        """Return the list of all :class:`~casa_sara.operators.dictionary.Band`."""
        return [band._replace(slice=(order, *band.slice), order=order) for order in range(len(self._orders))
                for band in self._dictionary.bands()]

    def analysis(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ†·image, in `out` where given.

        Parameters
        ----------
        image : real (T·nx, ny)
            z.
        out : real, of the shape of coefficients, optional
            Receives the result.

        Returns
        -------
        real, of the shape of coefficients
        """
        out = self.allocate() if out is None else out
        for order, coefs in zip(self._mixed(self._orders, image, self._in), out):
            self._dictionary.analysis(order, coefs)
        return out

    def synthesis(self, coefs: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ·coefs, in `out` where given.

        Parameters
        ----------
        coefs : real, of the shape of coefficients
            The coefficients.
        out : real (T·nx, ny), optional
            Receives the result.

        Returns
        -------
        real (T·nx, ny)
        """
        for one, order in zip(coefs, self._out):
            self._dictionary.synthesis(one, order)
        return self._unmixed(out)

    def dual_step(self, model_bar: np.ndarray, dual: np.ndarray, threshold: float, weights: np.ndarray,
                  out: np.ndarray, relaxation: float = 1.0) -> np.ndarray:
        """Update the dual variables in place and return Ψ·dual: as `SaraDictionary.dual_step`, for every order.

        Parameters
        ----------
        model_bar : real (T·nx, ny)
            z̄.
        dual, weights : real, of the shape of coefficients
            u and W.
        threshold : float
            κ.
        out : real (T·nx, ny)
            Receives the result.
        relaxation : float
            ρ.

        Returns
        -------
        real (T·nx, ny)
        """
        self._mixed(self._orders, model_bar, self._in)
        for order, one, weight, gradient in zip(self._in, dual, weights, self._out):
            self._dictionary.dual_step(order, one, threshold, weight, gradient, relaxation)
        return self._unmixed(out)

    def reweight(self, image: np.ndarray, alpha: np.ndarray, scale: np.ndarray, out: np.ndarray) -> np.ndarray:
        """Fill `out` with the weights s·α/(α + d̄) of every order: as `SaraDictionary.reweight`.

        Parameters
        ----------
        image : real (T·nx, ny)
            z.
        alpha, scale : float (number of bands,)
            α and s, in the order of `bands`.
        out : real, of the shape of coefficients
            Receives the weights.

        Returns
        -------
        real, of the shape of coefficients
        """
        count = len(self._orders)
        orders = self._mixed(self._orders, image, self._in)
        for order, a, s, one in zip(orders, np.split(alpha, count), np.split(scale, count), out):
            self._dictionary.reweight(order, a, s, one)
        return out

    def scale_at(self, coefs: np.ndarray, pixels: np.ndarray, factor: float) -> None:
        """Multiply the coefficients that describe some pixels of any image, bool (T·nx, ny), in place.

        Parameters
        ----------
        coefs : real, of the shape of coefficients
            Changed in place.
        pixels : bool (T·nx, ny)
            Pixels whose coefficients are meant.
        factor : float
            Factor on their weights.
        """
        pixels = pixels.reshape(self._in.shape).any(axis=0)
        for one in coefs:
            self._dictionary.scale_at(one, pixels, factor)

    def _mixed(self, matrix, image, out):
        self._workers.run(_combine, matrix, image.reshape(len(matrix), -1), out.reshape(len(matrix), -1))
        return out

    def _unmixed(self, out):
        out = np.empty(self.shape, self._dictionary.dtype) if out is None else out
        self._mixed(self._back, self._out, out)
        return out


@jit.kernel(fastmath={"contract"})
def _combine(matrix, images, out, worker, workers):
    """out_s ← Σ_t matrix_st images_t, all (T, n): to the last bit for any number of workers, which BLAS is not."""
    size = images.shape[1]
    for start in range(PIXELS_AT_ONCE * worker, size, PIXELS_AT_ONCE * workers):
        stop = min(start + PIXELS_AT_ONCE, size)
        for s in range(len(matrix)):
            for k in range(start, stop):
                out[s, k] = matrix[s, 0] * images[0, k]
            for t in range(1, len(matrix)):
                for k in range(start, stop):
                    out[s, k] += matrix[s, t] * images[t, k]
