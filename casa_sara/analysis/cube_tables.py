"""The measures of cubes as tables: of the line, of each channel, and the islands of emission of each channel."""

from __future__ import annotations

from typing import Any

import numpy as np

from casa_sara.analysis.columns import Table, build, fixed, is_number, number
from casa_sara.analysis.cube_comparison import CubeComparison, CubeProduct

__all__ = ["cube_tables"]

MOST_ISLANDS = 100  # in the table of a product


def cube_tables(comparison: CubeComparison) -> list[Table]:
    """Return the tables for which there are measures.

    Parameters
    ----------
    comparison : CubeComparison
        The products and what was measured.

    Returns
    -------
    list of Table
    """
    made = [_line(comparison), _similarity(comparison), *(_channels(comparison, one) for one in comparison.products),
            *(_islands(comparison, one) for one in comparison.products)]
    return [table for table in made if table is not None]


def _line(comparison):
    rows = {}
    for name, entry in comparison.measures["products"].items():
        peak = comparison.values[entry["peak_channel"]]
        rows[name] = {"line_flux": entry["line_flux"], "peak": f"{peak:.6g}", **entry["sigma"],
                      **entry.get("truth", {})}
    columns = [("line_flux", "flux of the line", f"Jy {comparison.unit}"), ("peak", "brightest at", comparison.unit),
               ("natural", "σ, natural", "Jy/beam"), ("briggs", "σ, Briggs", "Jy/beam"), ("snr", "SNR", "dB")]
    return build("The line", columns, rows,
                 "Flux of the line: sum of the model over pixels and channels. Brightest at: the channel whose model "
                 "has most flux. σ: standard deviation of the residual, median of the channels.")


def _similarity(comparison):
    rows = {pair.replace("|", " and "): entry for pair, entry in comparison.measures["similarity"].items()}
    if not rows:
        return None
    columns = [("moment0_db", "S of moment 0", "dB"), ("moment1_rms", "rms difference of moment 1", comparison.unit)]
    return build("Similarity", columns, rows,
                 "S: norm of the larger moment 0 of the restored images over the difference. Moment 1 where the mean "
                 "of the products exceeds 5 σ.")


def _channels(comparison, product):
    """The channels of one product, each in a row."""
    recorded = _recorded(product)
    rows: dict[str, dict[str, Any]] = {}
    for channel, place in zip(comparison.measures["channels"], comparison.values):
        row = {"place": f"{place:.6g}"}
        measured = channel.get("products", {}).get(product.name)
        row["flux_jy"] = measured["flux_jy"] if measured else "blank"
        for weighting in ("natural", "briggs"):
            row |= {f"{weighting} {key}": value for key, value in (measured or {}).get(weighting, {}).items()
                    if key in ("sigma", "max_abs", "peak")}
        rows[str(channel["channel"])] = row | recorded.get(channel["channel"], {})
    weighting = comparison.weighting
    columns = [("place", "at", comparison.unit), ("flux_jy", "flux of the model", "Jy"),
               (f"{weighting} sigma", f"σ, {weighting}", "Jy/beam"),
               (f"{weighting} max_abs", "largest |r|", "Jy/beam"), (f"{weighting} peak", "peak restored", "Jy/beam"),
               ("islands", "islands", ""), ("noise", "noise found", "× weights"), ("iterations", "iterations", ""),
               ("ended", "ended", "")]
    return build(f"Channels of {product.name}", columns, rows,
                 "Islands: how many the model has above its significance. Noise found: median of the data blocks, "
                 "relative to the MS weights." if recorded else "")


def _recorded(product: CubeProduct) -> dict[int, dict[str, str]]:
    """Return what tsara recorded of each channel, as text."""
    found = {}
    for channel, entry in enumerate(product.record.get("channels") or []):
        if entry.get("blank"):
            continue
        blocks = [block["noise_found"] for block in entry.get("blocks", []) if is_number(block.get("noise_found"))]
        ended = entry.get("reweightings") or []
        found[channel] = {"ended": str(entry.get("stopDescription", "–")),
                          "islands": str(len(entry.get("islands", [])))}
        if blocks:
            found[channel]["noise"] = number(float(np.median(blocks)), 3)
        if ended:
            found[channel]["iterations"] = str(ended[-1]["iteration"])
    return found


def _islands(comparison, product):
    """The islands of emission that tsara recorded, channel by channel."""
    islands = [(channel, island) for channel, entry in enumerate(product.record.get("channels") or [])
               for island in entry.get("islands", []) if is_number(island.get("snr"))]
    if not islands:
        return None
    most = sorted(islands, key=lambda one: -one[1]["snr"])[:MOST_ISLANDS]
    rows = []
    for channel, island in sorted(most, key=lambda one: (one[0], -one[1]["snr"])):
        error = island.get("flux_error_jy")
        digits = max(1 - int(np.floor(np.log10(error))), 0) if is_number(error) and error > 0 else 4
        rows.append((str(channel), f"{comparison.values[channel]:.6g}", str(island.get("right_ascension", "–")),
                     str(island.get("declination", "–")), f"{fixed(island.get('flux_jy'), digits)} ± "
                     f"{fixed(error, digits)}", number(island["snr"], 3), number(island.get("fwhm_arcsec"), 3)))
    caption = "Emission that the model holds, each island with its error, S/N and width."
    if len(islands) > len(most):
        caption += f" The {len(most)} most significant of {len(islands)}."
    heads = ("channel", "at", "right ascension", "declination", "flux", "S/N", "FWHM")
    return Table(f"Islands of {product.name}", heads, ("", comparison.unit, "", "", "Jy", "", "arcsec"), tuple(rows),
                 caption)
