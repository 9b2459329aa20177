"""Exact visibilities of a known sky."""

from __future__ import annotations

import finufft
import numpy as np

from casa_sara.demo.sky import Sky

__all__ = ["predict"]

LEFT_OUT = 1e-9  # of the total flux, at most, by ending the Taylor series in w


def predict(sky: Sky, uvw: np.ndarray) -> np.ndarray:
    """Predict the visibilities of a sky, V = Σ I exp(2πi [u l + v m + w (n − 1)]).

    The term in w is expanded in its Taylor series, one NUFFT for each power, until what is left is
    below 1e-9 of the total flux.

    Parameters
    ----------
    sky : Sky
        The model of the sky.
    uvw : float64 (3, M)
        Baselines in wavelengths.

    Returns
    -------
    complex128 (M,)
        Visibilities in Jy.
    """
    nx, ny = sky.image.shape
    l = (np.arange(nx) - nx // 2)[:, None] * sky.cell_rad
    m = (np.arange(ny) - ny // 2)[None, :] * sky.cell_rad
    n_minus_1 = np.sqrt(1 - l**2 - m**2) - 1
    u, v, w = uvw
    x, y = -2 * np.pi * sky.cell_rad * u, 2 * np.pi * sky.cell_rad * v
    largest = 2 * np.pi * np.abs(w).max() * np.abs(n_minus_1).max()

    vis = np.zeros(u.size, complex)
    image, factor = np.array(sky.image, complex, order="C"), np.ones(u.size, complex)
    bound, power = 1.0, 0
    while bound > LEFT_OUT:
        vis += factor * finufft.nufft2d2(x, y, image, isign=1, eps=1e-12)
        power += 1
        image = image * n_minus_1
        factor = factor * 2j * np.pi * w / power
        bound *= largest / power
    for l, m, flux in sky.points:
        vis += flux * np.exp(2j * np.pi * (u * l + v * m + w * (np.sqrt(1 - l**2 - m**2) - 1)))
    return vis
