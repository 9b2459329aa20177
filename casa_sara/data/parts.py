"""Samples of a mosaic as those of parts of an image: each part, that of one primary beam, has its own middle.

A sample sees nothing beyond its part, and around the middle (l0, m0) of that its visibility is

    V exp(−2πi [u l0 + v m0 + w (n0 − 1)]),    with baselines (u − w l0/n0, v − w m0/n0),

which varies over the uv plane as slowly as that of an image of the size of the part.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

__all__ = ["Parts"]


@dataclass(frozen=True)
class Parts:
    """Of each sample, what it is in the part of the image that it sees.

    Attributes
    ----------
    number : int32 (M,)
        Of the part.
    uv : float64 (2, M)
        Baselines in wavelengths, around the middle of the part.
    turn : complex64 (M,)
        exp(2πi [u l0 + v m0 + w (n0 − 1)]), with the baselines of the image.
    middles : float64 (P, 2)
        (l0, m0) of each part.
    sides : float64 (P, 2)
        Along u and v, in wavelengths, of the cells within which its samples are averaged.
    """

    number: np.ndarray
    uv: np.ndarray
    turn: np.ndarray
    middles: np.ndarray
    sides: np.ndarray

    def place(self, axis: int) -> Callable[[slice], np.ndarray]:
        """Return what gives u (axis 0) or v (1), or that of the conjugate where v < 0, in sides of the part's cells.

        Parameters
        ----------
        axis : int
            0 or 1.

        Returns
        -------
        callable
            Takes a slice of the samples, and returns float64.
        """
        def of(piece):
            return self.uv[axis, piece] * np.where(self.uv[1, piece] < 0, -1, 1) / self.sides[self.number[piece], axis]

        return of

    def straight(self, vis: np.ndarray, piece: slice) -> np.ndarray:
        """Return visibilities of a slice of the samples, complex, around the middles of their parts.

        Parameters
        ----------
        vis : complex
            Around the centre of the image.
        piece : slice
            Of the samples.

        Returns
        -------
        complex
        """
        return vis * np.conj(self.turn[piece])

    def turn_of(self, uv: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Return exp(2πi [u l0 + v m0]) of baselines of an image without w, complex128 (C,).

        Parameters
        ----------
        uv : float64 (2, C)
            Wavelengths.
        number : int (C,)
            Of their parts.

        Returns
        -------
        complex128 (C,)
        """
        return np.exp(2j * np.pi * (uv * self.middles[number].T).sum(axis=0))
