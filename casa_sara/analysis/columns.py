"""Numbers as text, in tables with common units, prefixes and decimals in each column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from casa_sara.analysis.sheets import prefix

__all__ = ["Table", "build", "fixed", "is_number", "number"]

NOTHING = "–"


@dataclass(frozen=True)
class Table:
    """A table of text: title, heads of the columns, their units, rows (the first cell names the row), explanation."""

    title: str
    heads: tuple[str, ...]
    units: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


def number(value: object, digits: int = 4) -> str:
    """Return a number with some significant digits; a dash for what there is not, ∞ for infinity.

    Parameters
    ----------
    value : float, str or None
        What is written.
    digits : int
        Number of significant digits.

    Returns
    -------
    str
    """
    if value is None or isinstance(value, float) and np.isnan(value):
        return NOTHING
    if not isinstance(value, (int, float, np.number)):
        return str(value)
    if np.isinf(value):
        return "∞" if value > 0 else "−∞"
    if value != 0 and not 1e-3 <= abs(value) < 1e7:
        mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
        return f"{mantissa}e{int(exponent)}".replace("-", "−")
    decimals = max(digits - 1 - int(np.floor(np.log10(abs(value)))), 0) if value != 0 else 0
    return f"{value:,.{decimals}f}".replace("-", "−")


def build(title: str, columns: Sequence[tuple[Any, str, str]], measured: dict[str, dict[Any, Any]],
          caption: str = "") -> Table | None:
    """Make a table of products from columns (key, head, unit), leaving out what no product has.

    Parameters
    ----------
    title : str
        Title.
    columns : sequence of (str, str, str)
        Key of the measure, head of the column, unit.
    measured : dict
        Name of the product → its measures by key.
    caption : str
        Explanation below the table.

    Returns
    -------
    Table or None
        None where no product has any of the measures.
    """
    columns = [column for column in columns if any(column[0] in entry for entry in measured.values())]
    if not columns:
        return None
    values = [[entry.get(key) for entry in measured.values()] for key, _, _ in columns]
    scales = {unit: _scale([column for column, (_, _, its) in zip(values, columns) if its == unit])
              for _, _, unit in columns if unit.startswith("Jy")}
    units, texts = zip(*(_column(column, unit, scales) for column, (_, _, unit) in zip(values, columns)))
    rows = tuple((name, *cells) for name, *cells in zip(measured, *texts))
    return Table(title, ("", *(head for _, head, _ in columns)), ("", *units), rows, caption)


def _scale(columns) -> tuple[float, str]:
    """Return factor and prefix for columns of one unit; the fainter ones may be below 1."""
    peaks = [max((abs(value) for value in column if is_number(value)), default=0) for column in columns]
    peaks = [peak for peak in peaks if peak > 0]
    return prefix(10 * min(peaks)) if peaks else (1.0, "")


def _column(values, unit, scales) -> tuple[str, list[str]]:
    """Return the unit of a column and its numbers in that unit, with one number of decimals where that says enough."""
    factor, sign = scales.get(unit, (1.0, ""))
    finite = [abs(float(value)) for value in values if is_number(value) and value != 0]
    if not finite:
        return sign + unit, [number(value) for value in values]
    if unit == "dB":
        return unit, [fixed(value, 1) for value in values]
    values = [value * factor if is_number(value) else value for value in values]
    largest, least = max(finite) * factor, min(finite) * factor
    decimals = max(3 - int(np.floor(np.log10(largest))), 0)
    if not unit:  # ratios and moments
        decimals = min(decimals, 0 if largest >= 100 else 1 if largest >= 10 else 3)
    if largest >= 1e7 or least < 2 * 10.0**-decimals:
        return sign + unit, [number(value, 3) for value in values]
    return sign + unit, [fixed(value, decimals) for value in values]


def is_number(value: object) -> bool:
    """Tell whether a value is a finite number.

    Parameters
    ----------
    value : object
        Anything.

    Returns
    -------
    bool
    """
    return isinstance(value, (int, float, np.number)) and bool(np.isfinite(value))


def fixed(value: float | None, decimals: int) -> str:
    """Return a number with some decimals.

    Parameters
    ----------
    value : float or None
        What is written.
    decimals : int
        Number of decimals.

    Returns
    -------
    str
    """
    return f"{value:,.{decimals}f}".replace("-", "−") if is_number(value) else number(value)
