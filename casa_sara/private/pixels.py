"""Numbers and sizes of pixels, as parameters give them."""

from __future__ import annotations

import math
from typing import Any

from casa_sara.casa.runtime.quantities import radians

__all__ = ["cell_rad", "pair"]

ARCSEC = math.pi / 180 / 3600


def pair(value: Any, name: str, right: str) -> list[Any]:
    """Return two values, of one or of two; `right` says what parameter `name` should be."""
    values = list(value) if isinstance(value, (list, tuple)) else [value]
    if len(values) not in (1, 2):
        raise ValueError(f"{name} = {value!r}: should be {right}")
    return values * 2 if len(values) == 1 else values


def cell_rad(value: Any) -> float:
    """Return one pixel size in radians; a number without unit is in arcsec, as in tclean."""
    try:
        size = float(value) * ARCSEC
    except ValueError:
        size = radians(value, "cell")
    if not 0 < size < 1:
        raise ValueError(f"cell = {value!r}: should be a positive angle, e.g. '0.1arcsec'")
    return size
