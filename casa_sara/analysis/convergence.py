"""Plots of the record of a run: its convergence, and the noise of each snapshot."""

from __future__ import annotations

from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D

from casa_sara.analysis.comparison import Product
from casa_sara.analysis.diagnostics import SMALL, TEXT, legend, new_figure
from casa_sara.analysis.sheets import LINES, plain

__all__ = ["block_noise", "convergence"]

MOST_LABELS = 40  # scans that are named in the picture of the noise
LONGEST = 26  # letters of the name of a MeasurementSet
LONG_GAP_S = 3 * 3600.0


def convergence(path: str | Path, product: Product) -> bool:
    """Draw relative change, residual norm and bounds against the iteration; tell whether any was recorded.

    Vertical lines mark the re-weightings, numbered from 1.

    Parameters
    ----------
    path : str or Path
        File to write.
    product : casa_sara.analysis.comparison.Product
        The product whose record is drawn.

    Returns
    -------
    bool
    """
    record = product.record
    history, bounds = record.get("history") or {}, record.get("bounds") or []
    drawers = [(_change, "rel_change" in history), (_norms, "residual_norm" in history), (_bounds, len(bounds) > 0)]
    drawers = [draw for draw, there in drawers if there]
    if not drawers:
        return False
    figure, axes = new_figure(len(drawers), 1, 2.5, width=11.5, sharex=True)
    end = max([*np.atleast_1d(history.get("iteration", 0)), *(entry["iteration"] for entry in bounds),
               *(entry["iteration"] for entry in record.get("reweightings") or [])])
    for draw, panel in zip(drawers, axes[:, 0]):
        draw(panel, record, end)
        panel.yaxis.label.set_size(10.5)
    for number, entry in enumerate(record.get("reweightings") or [], 1):
        for panel in axes[:, 0]:
            panel.axvline(entry["iteration"], color="0.65", lw=0.8, zorder=0)
        axes[0, 0].annotate(str(number), (entry["iteration"], 1), xycoords=("data", "axes fraction"), ha="center",
                            va="bottom", fontsize=SMALL, color="0.3", xytext=(0, 2), textcoords="offset points")
    axes[-1, 0].set_xlabel("iteration", **TEXT)
    axes[-1, 0].set_xlim(0, 1.01 * max(end, 1))
    figure.savefig(path)
    return True


def _change(panel, record, end) -> None:
    history = record["history"]
    change = np.asarray(history["rel_change"], float)
    shown = np.isfinite(change) & (change > 0)
    panel.semilogy(np.asarray(history["iteration"])[shown], change[shown], color=LINES[0], lw=1.4)
    panel.set_ylabel("relative change")


def _norms(panel, record, end) -> None:
    history = record["history"]
    panel.plot(history["iteration"], history["residual_norm"], color=LINES[0], lw=1.6, label="residual norm")
    if record.get("bounds"):
        x, bounds = _steps(record, end)
        panel.plot(x, np.linalg.norm(bounds, axis=1), color=LINES[1], lw=1.4, ls="--", drawstyle="steps-post",
                   label="bounds of all blocks together")
    panel.set_yscale("log")
    panel.legend(fontsize=SMALL, frameon=False, loc="upper right")
    panel.set_ylabel("norm of residual / noise")
    panel.yaxis.set_minor_formatter(panel.yaxis.get_major_formatter())


def _bounds(panel, record, end) -> None:
    x, bounds = _steps(record, end)
    blocks = record.get("blocks") or []
    label, colours = _bound_unit(blocks, bounds)
    names, named = _short(colours), set()
    for j, line in enumerate((bounds / label[1]).T):
        ms = blocks[j]["ms"] if j < len(blocks) else ""
        shown = names[ms] if ms in names and ms not in named else None
        named.add(ms)
        panel.plot(x, line, color=colours.get(ms, LINES[0]), lw=1.0, alpha=0.75, drawstyle="steps-post", label=shown)
    panel.set_ylabel(label[0])
    if bounds.min() > 0 and (bounds / label[1]).max() > 10 * (bounds / label[1]).min():
        panel.set_yscale("log")
    if 1 < len(colours) <= 7:
        panel.legend(fontsize=SMALL, frameon=False, loc="upper right", ncols=len(colours))


def _bound_unit(blocks, bounds):
    """Return (axis label, divisor) of the bounds and the colour of each MeasurementSet."""
    if len(blocks) == bounds.shape[1]:
        unit = "bound ε/√(2M)", np.sqrt([2.0 * block["samples"] for block in blocks])
    else:
        unit = "bound ε over its first value", np.where(bounds[0] > 0, bounds[0], 1)
    return unit, _colours(blocks)


def _colours(blocks) -> dict[str, str]:
    names = list(dict.fromkeys(block["ms"] for block in blocks))
    return {name: LINES[number % len(LINES)] for number, name in enumerate(names)}


def _short(names) -> dict[str, str]:
    """Return names of MeasurementSets without folders, unless these tell them apart, and not too long."""
    last = {name: Path(name).name for name in names}
    if len(set(last.values())) < len(last):
        last = {name: "/".join(Path(name).parts[-2:]) for name in names}
    return {name: plain(text if len(text) <= LONGEST else f"{text[:10]}…{text[11 - LONGEST:]}")
            for name, text in last.items()}


def _steps(record, end):
    """Return iterations and bounds (n, blocks), continued to the last iteration."""
    x = [entry["iteration"] for entry in record["bounds"]]
    bounds = [np.asarray(entry["l2_bounds"], float) for entry in record["bounds"]]
    return np.array([*x, max(end, x[-1])]), np.array([*bounds, bounds[-1]])


def block_noise(path: str | Path, product: Product) -> bool:
    """Draw the noise found and measured in each block over time; tell whether there are blocks.

    A panel for each MeasurementSet (one configuration, as a rule), with time running along it; gaps of
    more than three hours are cut out. Names along the upper edge are scans.

    Parameters
    ----------
    path : str or Path
        File to write.
    product : casa_sara.analysis.comparison.Product
        The product whose record is drawn.

    Returns
    -------
    bool
    """
    blocks = [block for block in product.record.get("blocks") or [] if "noise_found" in block]
    if not blocks:
        return False
    colours = _colours(blocks)
    names = _short(colours)
    rows = -(-len(colours) // 4)
    columns = min(len(colours), 4)
    figure, axes = new_figure(rows, columns, 3.6, width=11.5, sharey=True)
    every = -(-len(blocks) // MOST_LABELS)
    for panel in axes.flat[len(colours) :]:
        panel.set_axis_off()
    for panel, (ms, colour) in zip(axes.flat, colours.items()):
        own = sorted((block for block in blocks if block["ms"] == ms), key=lambda block: block["start_mjd_s"])
        _noise_panel(panel, own, colour, every)
        panel.set_title(f"{names[ms]}\n{_date(own[0]['start_mjd_s'])}", **TEXT)
    values = [block[name] for block in blocks for name in ("noise_found", "noise_measured")]
    if max(values) > 4 * min(values) > 0:
        axes[0, 0].set_yscale("log")
    else:
        axes[0, 0].set_ylim(0, 1.35 * max(values))
    for panel in axes[:, 0]:
        panel.set_ylabel("noise relative to the MS weights", **TEXT)
    grey = {"ls": "", "marker": "o"}
    legend(figure, [Line2D([], [], mfc="white", mec="0.35", ms=5, label="measured: thermal noise", **grey),
                    Line2D([], [], color="0.35", ms=5.5, label="found: with calibration errors", **grey)])
    figure.savefig(path)
    return True


def _noise_panel(panel, blocks, colour, every) -> None:
    """Draw the blocks of one MeasurementSet."""
    times, cut = _hours(blocks)
    unit = "hours" if times[-1] > 2 else "minutes"
    times = times if unit == "hours" else 60 * times
    found = np.array([block["noise_found"] for block in blocks])
    measured = np.array([block["noise_measured"] for block in blocks])
    panel.axhline(1, color="0.6", lw=1, ls=":")
    panel.vlines(times, measured, found, color=colour, lw=1, alpha=0.5)
    panel.plot(times, measured, "o", mfc="white", mec="0.35", ms=5)
    panel.plot(times, found, "o", color=colour, ms=5.5)
    for number, (x, y, block) in enumerate(zip(times, np.maximum(found, measured), blocks)):
        if number % every == 0:
            scans = [str(scan) for scan in block["scans"]]
            text = scans[0] if len(scans) == 1 else f"{scans[0]}–{scans[-1]}" if scans else ""
            panel.annotate(plain(text), (x, y), xytext=(0, 6), textcoords="offset points", fontsize=8.5, rotation=90,
                           ha="center", va="bottom", color="0.25")
    span = max(times[-1] - times[0], 1e-3)
    panel.set_xlim(times[0] - 0.08 * span, times[-1] + 0.08 * span)
    panel.set_xlabel(f"{unit} from start" + (", gaps cut" if cut else ""), **TEXT)


def _hours(blocks) -> tuple[np.ndarray, bool]:
    """Return the middle of each block in hours, with long gaps shortened to a tenth of the whole."""
    start = np.array([block["start_mjd_s"] for block in blocks])
    end = np.array([block["end_mjd_s"] for block in blocks])
    gaps = start[1:] - end[:-1]
    long = gaps > LONG_GAP_S
    spent = (end - start).sum() + gaps[~long].sum()
    shorter = np.where(long, gaps - 0.1 * max(spent, 60.0), 0.0)
    return ((start + end) / 2 - start[0] - np.concatenate([[0], np.cumsum(shorter)])) / 3600, bool(long.any())


def _date(mjd_s) -> str:
    return (datetime(1858, 11, 17) + timedelta(seconds=float(mjd_s))).strftime("%Y-%m-%d")
