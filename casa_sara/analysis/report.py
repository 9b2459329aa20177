"""The report of a comparison: one self-contained HTML file, and its pictures as PNG files."""

from __future__ import annotations

import base64
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import jinja2
import numpy as np
from PIL import Image

from casa_sara.analysis import animation, convergence, diagnostics, error_pages, pages
from casa_sara.analysis.columns import Table
from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.cube_comparison import CubeComparison
from casa_sara.analysis.folder import MEASURES, PAGE, replaced
from casa_sara.analysis.polarisation import polarised_picture
from casa_sara.analysis.sheets import DPI
from casa_sara.analysis.tables import tables
from casa_sara.analysis.zooms import find_zooms
from casa_sara.runtime import jsonfile

__all__ = ["Picture", "page", "write_report"]

TEMPLATE = "report.html.j2"
ERRORS = (
    "Models, and their errors on the same scale: the root mean square of what new noise does to the model. Right: the "
    "model smoothed with the beam over the error of that, with contours at 3 (blue) and 5 (red); islands are numbered "
    "as in the record, the most significant first. Where nothing is detected, model and error are zero."
)
FEATURES = (
    "Models with emission free in the region, and without any there, on one scale, and their difference on its own; "
    "the table has the probabilities."
)


@dataclass(frozen=True)
class Picture:
    """A picture of the report: its file, the section it belongs to, title and caption."""

    path: Path
    section: str
    title: str
    caption: str

    @property
    def data(self) -> str:
        """The file as a data URI."""
        return "data:image/png;base64," + base64.b64encode(self.path.read_bytes()).decode("ascii")

    @property
    def size(self) -> tuple[int, int]:
        """Width and height at which it is shown, in pixels of the page."""
        with Image.open(self.path) as image:
            return tuple(round(100 * pixels / DPI) for pixels in image.size)


def write_report(comparison: Comparison, folder: Path, title: str = "SARA imaging report") -> Path:
    """Write the pictures of a comparison, report.html, which holds them all, and measures.json.

    Sections for which there is nothing are left out. The files of an earlier report are replaced, all together, when
    the new ones are complete; other files stay.

    Parameters
    ----------
    comparison : Comparison
        Of one product or more.
    folder : Path
        Made if it is not there.
    title : str
        Heading of the page.

    Returns
    -------
    Path
        Of report.html.

    Raises
    ------
    FileExistsError
        A file that is not of an earlier report has the name of one of the report's.
    """
    return write_page(comparison, folder, title, (_sky, _errors, _frames, _residuals, _runs), tables)


def write_page(comparison: Comparison | CubeComparison, folder: Path, title: str,
               sections: Sequence[Callable[..., list[Picture]]], tables_of: Callable[..., list[Table]]) -> Path:
    """Write a report as :func:`write_report` does, of given sections.

    Parameters
    ----------
    comparison : Comparison or CubeComparison
        What it is about.
    folder : Path
        Made if it is not there.
    title : str
        Heading of the page.
    sections : sequence of callable
        Each draws its pictures: called with the comparison and the folder, it returns a list of `Picture`.
    tables_of : callable
        Called with the comparison, it returns a list of `Table`.

    Returns
    -------
    Path
        Of report.html.
    """
    folder = Path(folder)
    with replaced(folder) as new:
        jsonfile.save(new / MEASURES, comparison.measures)
        pictures = [picture for draw in sections for picture in draw(comparison, new)]
        (new / PAGE).write_text(page(comparison, title, pictures, tables_of(comparison)), encoding="utf-8")
    return folder / PAGE


def page(comparison: Comparison | CubeComparison, title: str, pictures: Sequence[Picture],
         measured: Sequence[Table]) -> str:
    """Return the page of a report.

    Parameters
    ----------
    comparison : Comparison or CubeComparison
        What it is about.
    title : str
        Its heading.
    pictures : sequence of Picture
        Its pictures.
    measured : sequence of Table
        Its tables.

    Returns
    -------
    str
        HTML.
    """
    loader = jinja2.FileSystemLoader(Path(__file__).parent)
    template = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
                                  lstrip_blocks=True).get_template(TEMPLATE)
    return template.render(
        title=title,
        comparison=comparison,
        shape=comparison.products[0].model.shape,
        tables=measured,
        pictures=pictures,
        parameters=_parameters(comparison),
        is_single=len(comparison.products) == 1,
        has_residuals=any(product.residual for product in comparison.products),
        axis=comparison.axis_words if isinstance(comparison, CubeComparison) else "",
        negative=_negative(comparison),
    )  # fmt: skip


def _sky(comparison, folder) -> list[Picture]:
    """Draw the pictures of the sky."""
    stretch = "One logarithmic scale for all that is per arcsec²" + (
        "; residuals have a scale of their own. Ellipses are the CLEAN beam." if comparison.beams else ".")
    boxes = " Boxes are enlarged below." if find_zooms(comparison) else ""
    made = []
    for weighting in list(comparison.beams) or [None]:
        path = folder / (f"sky_{weighting}.png" if weighting else "sky.png")
        pages.overview(path, comparison, weighting)
        name = f"All products, {weighting} weighting" if weighting else "All products"
        made.append(Picture(path, "sky", name, stretch + boxes))
    path = folder / "zooms.png"
    if pages.zoomed(path, comparison):
        made.append(Picture(path, "sky", "Models, enlarged",
                            "The scale is that of the picture above." +
                            (" The ellipse is the finest CLEAN beam." if comparison.beams else "")))
    path = folder / "polarisation.png"
    if polarised_picture(path, comparison):
        made.append(Picture(path, "sky", "Polarisation", "Polarised intensity of the models smoothed with the CLEAN "
                            "beam, on one scale, and its angle where it is above five times the noise of the residual "
                            "of Stokes I. The pictures and measures above are of Stokes I."))
    path = folder / "differences.png"
    if pages.differences(path, comparison):
        what = "the first product" if comparison.truth is None else "the truth"
        made.append(Picture(path, "sky", "Differences", f"Models minus that of {what}, as they are and smoothed with "
                            "each CLEAN beam. Red: more than there; blue: less. The scales are linear and end at the "
                            "99.8th percentile."))
    return made


def _errors(comparison, folder) -> list[Picture]:
    """Draw the errors that draws give, and the features that were tested."""
    made = []
    for weighting in comparison.beams:
        path = folder / f"errors_{weighting}.png"
        if error_pages.error_maps(path, comparison, weighting):
            made.append(Picture(path, "sky", f"Errors, {weighting} beam", ERRORS))
    path = folder / "features.png"
    if error_pages.features(path, comparison):
        made.append(Picture(path, "sky", "Is it real?", FEATURES))
    return made


def _frames(comparison, folder) -> list[Picture]:
    """Animate the images on different pixels: the field, and the regions in which all of them have emission."""
    if not comparison.frames:
        return []
    parts: list[tuple[str, tuple[float, float, float] | None]] = [("the field", None)]
    if comparison.regions:
        parts += [(zoom.name, zoom.on_sky(comparison)) for zoom in find_zooms(comparison)]
    made = []
    for number, (name, zoom) in enumerate(parts):
        path = folder / (f"cells_{number}.png" if number else "cells.png")
        if zoom is None or animation.has_emission(comparison.frames, zoom):
            animation.animate(path, comparison.frames, zoom)
            made.append(Picture(path, "frames", f"Pixel by pixel: {name}", "One part of the sky, imaged with different "
                                "pixels, on one logarithmic scale. Grey: beyond an image."))
    return made


def _residuals(comparison, folder) -> list[Picture]:
    """Draw the spectra and histograms."""
    made = []
    path = folder / "spectra.png"
    caption = "Averages over rings of the Fourier plane. "
    if comparison.truth is None:
        caption += "Where a model falls off, it resolves no further."
    else:
        caption += (
            "Where a model falls below the truth, it resolves no further; what it has above the truth is made up: "
            "noise, or flux put into too few pixels."
        )
    if comparison.beams:
        caption += " Vertical lines: one over the width of the CLEAN beam (dash-dotted: natural)."
    if any(product.residual for product in comparison.products):
        caption += (
            " Residuals that are noise follow the weights of the data; what one product has more than the others was "
            "left unmodelled at that scale."
        )
    if diagnostics.spectra(path, comparison):
        made.append(Picture(path, "residuals", "Radial power spectra", caption))
    path = folder / "histograms.png"
    if diagnostics.histograms(path, comparison):
        made.append(Picture(path, "residuals", "Histograms of the residuals", "Noise follows the Gaussian. Wings: "
                            "emission left unmodelled, or artefacts (pixels beyond the ends are in the last bin). "
                            "Flanks steeper than the Gaussian's: noise was put into the model."))
    return made


def _runs(comparison, folder) -> list[Picture]:
    """Draw what tsara recorded of each run."""
    made = []
    for index, product in enumerate(comparison.products, 1):
        path = folder / f"convergence_{index}.png"
        if convergence.convergence(path, product):
            made.append(Picture(path, "runs", f"Convergence of {product.name}", "Numbered lines: re-weightings. The "
                                "bound of each block is what its residual norm may be."))
        path = folder / f"blocks_{index}.png"
        if convergence.block_noise(path, product):
            made.append(Picture(path, "runs", f"Calibration of {product.name}, block by block", "Open: thermal noise, "
                                "measured in the data. Filled: the level that the image had to be allowed; what it has "
                                "more are calibration errors (and whatever the model cannot represent). 1 (dotted): "
                                "the weights are right. Names above: scans."))
    return made


def _parameters(comparison) -> list[tuple[str, bool, list[str]]]:
    """Return rows (name, whether it differs among the products, a value for each product)."""
    given = [product for product in comparison.products if product.parameters]
    rows = []
    for name in dict.fromkeys(name for product in given for name in product.parameters):
        values = [str(product.parameters[name]) if name in product.parameters else "–" for product in given]
        rows.append((name, len(set(values) - {"–"}) > 1, values))
    return rows


def _negative(comparison) -> list[str]:
    """Return the names of the products whose models have negative pixels."""
    return [product.name for product in comparison.products if np.nanmin(product.model) < 0]
