"""An animation of one part of the sky imaged with different pixel sizes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from PIL import Image

from casa_sara.analysis.sheets import BRIGHTNESS_MAP, DPI, plain, prefix

__all__ = ["animate", "has_emission"]

SIDE = 4.2  # of a square frame without its labels, in inches


def animate(path: str | Path, frames: Sequence[tuple[str, np.ndarray, float]],
            zoom: tuple[float, float, float] | None = None, decades: float = 3.0, seconds: float = 1.2) -> None:
    """Write an animation over reconstructions of one sky with different pixels.

    Parameters
    ----------
    path : str or Path
        An animated '.png' (all colours) or '.gif'.
    frames : sequence of (str, ndarray, float)
        Title, model (nx, ny) in Jy/pixel and pixel size in arcsec; pixel (nx//2, ny//2) of all is the same point.
    zoom : (float, float, float), optional
        The part that is shown: centre in arcsec to the east and to the north, and side in arcsec. By default
        as much as the smallest of the frames has.
    decades : float
        Range of the logarithmic scale of brightness, which is the same in all frames.
    seconds : float
        For which a frame stands still; the last one stands twice as long.
    """
    if not frames:
        raise ValueError("frames is empty: there is nothing to animate")
    part = _part(frames, zoom)
    if not has_emission(frames, zoom):
        raise ValueError(f"zoom={zoom} holds no emission of one of the frames")
    peak = np.median([_peak(image, cell, part) / cell**2 for _, image, cell in frames])
    factor, sign = prefix(peak)
    norm = LogNorm(peak * factor / 10**decades, peak * factor)
    drawn = [_frame(title, image * factor / cell**2, cell, part, (norm, f"{sign}Jy arcsec$^{{-2}}$"))
             for title, image, cell in frames]
    waits = [int(1e3 * seconds)] * (len(drawn) - 1) + [int(2e3 * seconds)]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=waits, loop=0)


def has_emission(frames: Sequence[tuple[str, np.ndarray, float]], zoom: tuple[float, float, float] | None) -> bool:
    """Tell whether every frame has emission in the part of the sky that `animate` would show of it.

    Parameters
    ----------
    frames : sequence of (str, ndarray, float)
        Title, model (nx, ny) in Jy/pixel and pixel size in arcsec.
    zoom : (float, float, float) or None
        Centre in arcsec to the east and to the north, and side in arcsec; None as in `animate`.

    Returns
    -------
    bool
    """
    return all(_peak(image, cell, _part(frames, zoom)) > 0 for _, image, cell in frames)


def _part(frames, zoom) -> tuple[float, float, float, float]:
    """Return centre to the east and to the north, width and height of what is shown, in arcsec."""
    if zoom is not None:
        return (*zoom, zoom[2])
    width, height = (min(image.shape[axis] * cell for _, image, cell in frames) for axis in (0, 1))
    return 0.0, 0.0, width, height


def _edges(shape, cell):
    """Return west, east, south and north edge of an image in arcsec from its centre, as imshow takes them."""
    nx, ny = shape
    return (nx // 2 + 0.5) * cell, (nx // 2 + 0.5 - nx) * cell, -(ny // 2 + 0.5) * cell, (ny - ny // 2 - 0.5) * cell


def _peak(image, cell, part) -> float:
    """Return the peak within a part, 0 where the image does not reach."""
    nx, ny = image.shape
    east, north = (nx // 2 - np.arange(nx)) * cell, (np.arange(ny) - ny // 2) * cell
    inside = image[np.abs(east - part[0]) <= part[2] / 2][:, np.abs(north - part[1]) <= part[3] / 2]
    return float(np.nanmax(inside)) if inside.size else 0.0


def _frame(title, image, cell, part, scale) -> Image.Image:
    """Draw one frame; `scale` is the norm and the unit."""
    norm, unit = scale
    east, north, width, height = part
    size = SIDE * np.sqrt(width / height), SIDE * np.sqrt(height / width)
    figure = Figure(figsize=(size[0] + 1.5, size[1] + 0.9), dpi=DPI, facecolor="white", layout="compressed")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    drawn = axes.imshow(np.maximum(image, norm.vmin).T, origin="lower", extent=_edges(image.shape, cell), norm=norm,
                        cmap=BRIGHTNESS_MAP, interpolation="nearest")
    axes.set_facecolor("0.6")  # beyond the image
    axes.set(xlim=(east + width / 2, east - width / 2), ylim=(north - height / 2, north + height / 2))
    axes.set_title(f'{plain(title)} ({cell:.3g}" pixels)', fontsize=11)
    axes.locator_params(nbins=6)
    axes.set_xlabel("east [arcsec]", fontsize=10)
    axes.set_ylabel("north [arcsec]", fontsize=10)
    figure.colorbar(drawn, ax=axes, pad=0.02).set_label(unit, fontsize=10)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
