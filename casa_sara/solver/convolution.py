"""Convolution by FFT: scipy.signal has it too, and takes half a second to import."""

from __future__ import annotations

import numpy as np
from scipy import fft

__all__ = ["convolve_valid"]


def convolve_valid(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Return Σ_q kernel[q]·image[p + (m, n) − 1 − q], where the kernel lies on the image with all of its pixels.

    Parameters
    ----------
    image : real (M, N)
        The image.
    kernel : real (m, n)
        m ≤ M, n ≤ N.

    Returns
    -------
    real (M − m + 1, N − n + 1)
    """
    axes = [axis for axis in range(2) if min(image.shape[axis], kernel.shape[axis]) > 1]  # along others it is a product
    whole = [fft.next_fast_len(image.shape[axis] + kernel.shape[axis] - 1, real=True) for axis in axes]
    product = fft.irfftn(fft.rfftn(image, whole, axes) * fft.rfftn(kernel, whole, axes), whole, axes) if axes \
        else image * kernel
    (first, last), (left, right) = ((size - 1, n) for n, size in zip(image.shape, kernel.shape))
    return product[first:last, left:right].copy()
