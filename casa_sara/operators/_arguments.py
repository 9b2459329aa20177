"""What operators ask of their arguments: shapes and types, and an array for the result where none is given."""

from __future__ import annotations

from typing import Any

import numpy as np

__all__ = ["checked", "for_adjoint", "for_forward"]


def for_forward(operator: Any, image: np.ndarray, out: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the image (nx, ny) and the array for its visibilities (M,), C-contiguous and of the operator's types.

    Raises
    ------
    ValueError
        A shape is wrong, or the type of `out`.
    """
    image = checked(np.ascontiguousarray(image, operator.dtype), "image", operator.shape, operator.dtype)
    out = np.empty(operator.size, operator.complex_dtype) if out is None else out
    return image, checked(out, "out", (operator.size,), operator.complex_dtype)


def for_adjoint(operator: Any, vis: np.ndarray, out: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the visibilities (M,) and the array for their image (nx, ny), as :func:`for_forward` does."""
    vis = checked(np.ascontiguousarray(vis, operator.complex_dtype), "vis", (operator.size,), operator.complex_dtype)
    out = np.empty(operator.shape, operator.dtype) if out is None else out
    return vis, checked(out, "out", operator.shape, operator.dtype)


def checked(array: np.ndarray, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """Return a C-contiguous array of this shape and type; raise ValueError where it is another."""
    if not isinstance(array, np.ndarray) or array.shape != shape or array.dtype != dtype \
            or not array.flags.c_contiguous:
        raise ValueError(f"{name} must be a C-contiguous {dtype} array of shape {shape}")
    return array
