"""Squared operator norms."""

from __future__ import annotations

import numpy as np

__all__ = ["power_method"]


def power_method(apply, shape, dtype=np.float64, tol=1e-4, max_iter=200, seed=0):
    """Largest eigenvalue of the symmetric positive `apply`: ‖A‖² for apply = A†A."""
    x = np.random.default_rng(seed).standard_normal(shape).astype(dtype)
    x /= np.linalg.norm(x)
    value = 0.0
    for _ in range(max_iter):
        y = apply(x)
        previous, value = value, float(np.linalg.norm(y))
        if value == 0.0:
            return 0.0
        x = y / dtype(value) if callable(dtype) else y / value
        if abs(value - previous) <= tol * value:
            break
    return value * (1 + 10 * tol)
