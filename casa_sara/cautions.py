"""What the user should be told of data and results, beside what is refused."""

from __future__ import annotations

import numpy as np

from casa_sara.parallel import SERIAL

__all__ = ["check_confined", "left_outside", "thermal_noise"]

PEAK_OUTSIDE = 6.0  # standard deviations of the thermal noise
ABOVE_INSIDE = 1.5  # times the largest residual inside: calibration errors leave as much on either side


def check_confined(model, support):
    """Return a support as float32 ones and zeros; raise unless the model is exactly zero outside.

    Raises
    ------
    RuntimeError
    """
    outside = int(np.count_nonzero(model[~support]))
    if outside:
        raise RuntimeError(f"mask: {outside} pixels of the model outside the mask are not zero; please report this")
    return support.astype(np.float32)


def thermal_noise(data, weights, noise, offsets, comm=SERIAL):
    """Standard deviation of the thermal noise in the dirty image of some imaging weights W, in Jy/beam.

    √(Σ W²σ²)/Σ W, with σ_m = noise_j/√w_m of block j.

    Parameters
    ----------
    data : Visibilities
        In the order of their blocks.
    weights : real (M,)
    noise : float (d,)
        Of each block in units of what the weights say; where it is NaN the weights are taken at their word.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    comm : casa_sara.parallel.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float
    """
    level = np.repeat(np.where(np.isfinite(noise), noise, 1.0), np.diff(offsets))
    power = comm.total(float(np.sum((weights * level) ** 2 / data.weight, dtype=float)))
    return float(np.sqrt(power) / comm.total(float(weights.sum(dtype=float))))


def left_outside(residual, support, sigma):
    """Say where the residual outside the support holds what the model was kept from.

    Parameters
    ----------
    residual : real (nx, ny), Jy/beam
    support : bool (nx, ny)
    sigma : float
        Its thermal noise, Jy/beam.

    Returns
    -------
    list of at most one str
    """
    size = np.abs(residual)
    outside = np.where(support, 0, size)
    peak = float(outside.max())
    if peak <= PEAK_OUTSIDE * sigma or peak <= ABOVE_INSIDE * float(size[support].max()):
        return []
    x, y = np.unravel_index(np.argmax(outside), outside.shape)
    return [f"mask: the residual outside the mask reaches {peak:.3g} Jy/beam, {peak / sigma:.1f} times its noise, at pixel "
            f"[{x}, {y}]: what the model may not hold raises the noise found, and disturbs what is inside"]
