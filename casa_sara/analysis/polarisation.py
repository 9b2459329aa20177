"""Polarised intensity and angle of products that have Stokes Q and U: measures, and a picture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.colors import PowerNorm

from casa_sara.analysis import metrics
from casa_sara.analysis.comparison import WEIGHTINGS, Comparison, Product
from casa_sara.analysis.diagnostics import new_figure
from casa_sara.analysis.sheets import DPI, plain, prefix

__all__ = ["polarised_measures", "polarised_picture"]

LEVEL = 10.0  # times the noise of the residual, above which angles are compared
OF_PEAK = 0.05  # where no residual tells the noise
SHOWN = 0.5  # of LEVEL, above which an angle is drawn


def polarised_measures(products: Sequence[Product], cell_arcsec: tuple[float, float],
                       beams: dict[str, tuple[float, float, float]],
                       truth: np.ndarray | None = None) -> dict[str, dict[str, Any]]:
    """Measure polarised intensity and angle, of models smoothed with the first of the beams.

    Intensity P = |Q + iU| and angle ½ arg(Q + iU), from north through east, are looked at where P of the reference is
    above ten times the noise of the residual of Stokes I (5 % of its peak where there is no residual): where P is that
    much above the noise its positive bias is less than 1 %.

    Parameters
    ----------
    products : sequence of casa_sara.analysis.comparison.Product
        On one grid; those without `polarised` are passed over.
    cell_arcsec : (float, float)
        Pixel size along x and y in arcsec.
    beams : dict
        Weighting → (major, minor) in arcsec FWHM and position angle in degrees.
    truth : complex (nx, ny), optional
        Q + iU in Jy/pixel, the reference; without it that is the first product that has Q and U.

    Returns
    -------
    dict
        Name of the product → `peak_jy_per_beam`, `intensity_jy` (sum of P) and `fraction` (of Stokes I) where the
        reference is above the level, `pixels` there and, but for the reference, `snr` of Q + iU in dB and
        `angle_rms_deg` against it.
    """
    seen = {one.name: _smoothed(one.polarised, cell_arcsec, beams) for one in products if one.polarised is not None}
    if not seen:
        return {}
    reference = next(iter(seen.values())) if truth is None else _smoothed(truth, cell_arcsec, beams)
    area, level = _beam_pixels(cell_arcsec, beams), _level(products, reference, beams)
    bright, found = np.abs(reference) > level, {}
    for product in products:
        if product.name not in seen:
            continue
        p = seen[product.name]
        axes, angle = _axes(beams)
        total = float(metrics.smooth(product.model, axes, angle, cell_arcsec)[bright].sum())
        intensity = float(np.abs(p[bright]).sum() / area)
        entry = dict(peak_jy_per_beam=float(np.abs(p).max()), intensity_jy=intensity, pixels=int(bright.sum()),
                     level_jy_per_beam=level)
        if total > 0:
            entry["fraction"] = intensity / total
        if p is not reference:
            error = np.linalg.norm(p - reference)
            entry["snr"] = float(20 * np.log10(np.linalg.norm(reference) / error)) if error > 0 else float("inf")
            if bright.any():
                entry["angle_rms_deg"] = float(np.sqrt(np.mean(_turned(p, reference)[bright] ** 2)))
        found[product.name] = entry
    return found


def polarised_picture(path: str | Path, comparison: Comparison) -> bool:
    """Draw polarised intensity and angle of every product that has them; return whether any has.

    Parameters
    ----------
    path : str or Path
        PNG file to write.
    comparison : casa_sara.analysis.comparison.Comparison
        The products and what was measured.

    Returns
    -------
    bool
    """
    panels = [(one.name, one.polarised) for one in comparison.products if one.polarised is not None]
    if not panels:
        return False
    if comparison.polarised_truth is not None:
        panels.insert(0, ("truth", comparison.polarised_truth))
    seen = [(name, _smoothed(p, comparison.cell_arcsec, comparison.beams)) for name, p in panels]
    peak = max(float(np.abs(p).max()) for _, p in seen)
    factor, word = prefix(peak)
    level = next(entry["polarisation"]["level_jy_per_beam"] for entry in comparison.measures["products"].values()
                 if "polarisation" in entry)
    figure, axes = new_figure(2, len(seen), 3.4, 4.0, sharex=True, sharey=True)
    half = [0.5 * n * cell for n, cell in zip(seen[0][1].shape, comparison.cell_arcsec)]
    for (name, p), (above, below) in zip(seen, axes.T):
        options: dict[str, Any] = dict(origin="lower", extent=(half[0], -half[0], -half[1], half[1]))
        shown = above.imshow(np.abs(p).T * factor, norm=PowerNorm(0.5, 0, peak * factor), cmap="inferno", **options)
        above.set_title(plain(name), fontsize=10.5)
        angle = np.where(np.abs(p) > SHOWN * level, 0.5 * np.degrees(np.angle(p)), np.nan)
        turned = below.imshow(angle.T, vmin=-90, vmax=90, cmap="twilight", interpolation="nearest", **options)
        for panel in (above, below):
            panel.grid(False)
        below.set_xlabel("east offset [arcsec]")
    for panel in axes[:, 0]:
        panel.set_ylabel("north offset [arcsec]")
    figure.colorbar(shown, ax=axes[0].tolist(), label=f"polarised intensity [{word}Jy/beam]")
    figure.colorbar(turned, ax=axes[1].tolist(), label="angle, north through east [deg]")
    figure.savefig(path, dpi=DPI)
    return True


def _axes(beams):
    """Return the axes and the angle of the first of the beams."""
    *axes, angle = next(beams[name] for name in WEIGHTINGS if name in beams)
    return axes, angle


def _beam_pixels(cell_arcsec, beams):
    """Return the pixels of this beam."""
    return metrics.beam_pixels(_axes(beams)[0], cell_arcsec)


def _smoothed(p, cell_arcsec, beams):
    """Return Q + iU in Jy/beam, smoothed with the first of the beams."""
    axes, angle = _axes(beams)
    q, u = (metrics.smooth(part, axes, angle, cell_arcsec) for part in (p.real, p.imag))
    return _beam_pixels(cell_arcsec, beams) * (q + 1j * u)


def _level(products, reference, beams):
    """Return the polarised intensity, in Jy/beam, above which the reference is looked at."""
    weighting = next(name for name in WEIGHTINGS if name in beams)
    noise = [float(np.nanstd(one.residual[weighting])) for one in products if weighting in one.residual]
    return LEVEL * min(noise) if noise else OF_PEAK * float(np.abs(reference).max())


def _turned(p, reference):
    """Return by how many degrees the angle differs from that of the reference, -90 to 90."""
    return 0.5 * np.degrees(np.angle(p * np.conj(reference)))
