"""One part of the sky imaged with ever smaller pixels, as an animated picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from PIL import Image

from casa_sara.analysis.sheets import BRIGHTNESS_MAP, DPI, plain, prefix

__all__ = ["animate", "has_emission"]


def animate(path, frames: Sequence[tuple[str, np.ndarray, float]], zoom=None, decades=3.0, seconds=1.2) -> None:
    """Write an animation over reconstructions of one sky with different pixels.

    Parameters
    ----------
    path : str or Path
        An animated '.png' (all colours) or '.gif'.
    frames : sequence of (str, ndarray, float)
        Title, model (nx, ny) in Jy/pixel and pixel size in arcsec; pixel (nx//2, ny//2) of all is the same point.
    zoom : (float, float, float), optional
        The part that is shown: centre in arcsec to the east and to the north, and side in arcsec. By default
        what all frames have in common.
    decades : float
        Range of the logarithmic scale of brightness, which is the same in all frames.
    seconds : float
        For which a frame stands still; the last one stands twice as long.
    """
    if not frames:
        raise ValueError("frames is empty: there is nothing to animate")
    zoom = zoom or (0.0, 0.0, min(min(image.shape) * cell for _, image, cell in frames))
    if not has_emission(frames, zoom):
        raise ValueError(f"zoom={zoom} holds no emission of one of the frames")
    peak = np.median([_peak(image, cell, zoom) / cell**2 for _, image, cell in frames])
    factor, sign = prefix(peak)
    norm = LogNorm(peak * factor / 10**decades, peak * factor)
    drawn = [_frame(title, image * factor / cell**2, cell, zoom, (norm, f"{sign}Jy arcsec$^{{-2}}$"))
             for title, image, cell in frames]
    waits = [int(1e3 * seconds)] * (len(drawn) - 1) + [int(2e3 * seconds)]
    drawn[0].save(path, save_all=True, append_images=drawn[1:], duration=waits, loop=0)


def has_emission(frames, zoom) -> bool:
    """Tell whether every frame has emission in the part of the sky that `animate` would show of it."""
    return all(_peak(image, cell, zoom) > 0 for _, image, cell in frames)


def _edges(shape, cell):
    """Return west, east, south and north edge of an image in arcsec from its centre, as imshow takes them."""
    nx, ny = shape
    return (nx // 2 + 0.5) * cell, (nx // 2 + 0.5 - nx) * cell, -(ny // 2 + 0.5) * cell, (ny - ny // 2 - 0.5) * cell


def _peak(image, cell, zoom) -> float:
    """Return the peak within the zoom, 0 where the image does not reach."""
    nx, ny = image.shape
    east, north = (nx // 2 - np.arange(nx)) * cell, (np.arange(ny) - ny // 2) * cell
    inside = image[np.abs(east - zoom[0]) <= zoom[2] / 2][:, np.abs(north - zoom[1]) <= zoom[2] / 2]
    return float(np.nanmax(inside)) if inside.size else 0.0


def _frame(title, image, cell, zoom, scale) -> Image.Image:
    """Draw one frame; `scale` is the norm and the unit."""
    norm, unit = scale
    east, north, side = zoom
    figure = Figure(figsize=(5.6, 5.0), dpi=DPI, facecolor="white", layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots()
    drawn = axes.imshow(np.maximum(image, norm.vmin).T, origin="lower", extent=_edges(image.shape, cell), norm=norm,
                        cmap=BRIGHTNESS_MAP, interpolation="nearest")
    axes.set_facecolor("0.6")  # beyond the image
    axes.set(xlim=(east + side / 2, east - side / 2), ylim=(north - side / 2, north + side / 2))
    axes.set_title(f'{plain(title)} ({cell:.3g}" pixels)', fontsize=11)
    axes.set_xlabel("east [arcsec]", fontsize=10)
    axes.set_ylabel("north [arcsec]", fontsize=10)
    figure.colorbar(drawn, ax=axes, pad=0.02).set_label(unit, fontsize=10)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())
