"""The second part of the demo: the VLA 8 GHz observation of 3C273 that comes inside the casadata package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from casatools import ctsys

from casa_sara.analysis import metrics
from casa_sara.analysis.plots import Column, Zoom, compare
from casa_sara.demo.cyga import layout
from casa_sara.demo.imagers import Case, Product, quiet, run_tcleans, run_tsara, write_comparison

__all__ = ["run"]

IMSIZE = 192
CELL_ARCSEC = 0.5
CLEAN = {
    "scales": [0, 3, 9, 18], "gain": 0.2, "niter": 2000, "nsigma": 2.0,
    "usemask": "user", "mask": f"circle[[{IMSIZE // 2}pix, {IMSIZE // 2}pix], 60pix]",
}  # fmt: skip


def run(folder: Path) -> None:
    """Import the data, image them with tsara and tclean, write the picture and print the table."""
    print("\n3C273, observed by the VLA at 8 GHz: a core and a jet of 23 arcsec")
    vis = str(folder / "3C273.ms")
    with quiet(folder / "import.txt"):
        from casatasks import importuvfits

        importuvfits(fitsfile=ctsys.resolve("demo/3C273XC1.fits"), vis=vis)
    case = Case(folder, [vis], [IMSIZE, IMSIZE], CELL_ARCSEC, {"briggs": CLEAN, "natural": CLEAN})
    print("  tclean multiscale, Briggs −1 and natural, side by side …", flush=True)
    cleaned = run_tcleans(case)
    print("  tsara …", flush=True)
    products = [run_tsara(case), *cleaned]
    print("\n" + table(products))
    picture(folder / "3c273.png", products)
    text, page = write_comparison(case)
    print(f"\n{text}\n\n  report: {page}")


def table(products: list[Product]) -> str:
    """Return flux, peak, residual and dynamic range of each product as text."""
    head = ("image", "flux", "negative", "peak", "residual rms", "dynamic range", "iterations", "time", "CPU")
    rows = [head, ("", "Jy", "Jy", "Jy/beam", "mJy/beam", "", "", "s", "s")]
    rows += [(
        product.name, f"{product.model.sum():.3f}", f"{np.minimum(product.model, 0).sum():.3f}",
        f"{product.restored.max():.3f}", f"{1e3 * product.residual.std():.2f}",
        f"{metrics.dynamic_range(product.restored, product.residual):.0f}", str(product.iterations),
        f"{product.wall_s:.0f}", f"{product.cpu_s:.0f}") for product in products]
    return layout(rows)


def picture(path: Path, products: list[Product]) -> None:
    """Draw the inner arcminute of every product."""
    inner = slice(IMSIZE // 2 - 60, IMSIZE // 2 + 60)
    columns = [
        Column(
            product.name, *(x[inner, inner] for x in (product.model, product.restored, product.residual)), product.beam,
            f"model, {product.model.sum():.2f} Jy",
        )
        for product in products
    ]  # fmt: skip
    compare(path, columns, CELL_ARCSEC, [Zoom("jet", -7, -9, 30)], decades=5, title="3C273, VLA, 8 GHz")
