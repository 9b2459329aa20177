"""Random noise of the data, the same for any number of ranks."""

from __future__ import annotations

import numpy as np

from casa_sara.solver.adaptive_ppd import AdaptivePPD

__all__ = ["draw_noise"]

DRAWN = 1 << 20  # random numbers at a time


def draw_noise(ppd: AdaptivePPD, rng: np.random.Generator, levels: np.ndarray, out: np.ndarray) -> None:
    """Fill `out` with Gaussian noise: of standard deviation `levels` per block, in the real and in the imaginary part.

    Parameters
    ----------
    ppd : AdaptivePPD
        Of whose data the noise is.
    rng : numpy.random.Generator
        In the same state on all ranks.
    levels : float (d,)
        Of each block.
    out : complex (M,)
        Of this rank's samples.
    """
    for j, (a, b) in enumerate(ppd.blocks() if ppd.vis.size else ()):
        here = ppd.begins[j], b - a, ppd.block_sizes[j]
        out[a:b] = _normal(rng, *here) + 1j * _normal(rng, *here)
        out[a:b] *= levels[j]


def _normal(rng, begin, count, size):
    """Return `count` of `size` standard normal numbers, from number `begin` on; all are drawn, as by one rank alone."""
    if count == size:
        return rng.standard_normal(size)
    chosen = np.empty(count)
    for start in range(0, size, DRAWN):
        drawn = rng.standard_normal(min(DRAWN, size - start))
        first, end = (int(np.clip(edge - start, 0, drawn.size)) for edge in (begin, begin + count))
        if first < end:
            chosen[start + first - begin : start + end - begin] = drawn[first:end]
    return chosen
