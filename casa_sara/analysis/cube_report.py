"""The report of a comparison of cubes: one self-contained HTML file, and its pictures as PNG files."""

from __future__ import annotations

from pathlib import Path

from casa_sara.analysis import cube_pictures
from casa_sara.analysis.cube_comparison import CubeComparison
from casa_sara.analysis.cube_tables import cube_tables
from casa_sara.analysis.report import Picture, write_page

__all__ = ["write_cube_report"]

MOMENTS = (
    "Moment 0 is the sum over the channels times their width; moment 1 the mean place of the line on the axis, where "
    "the mean of the products exceeds 5 σ. All products have one scale; differences have their own, in their corners."
)


def write_cube_report(comparison: CubeComparison, folder: Path, title: str = "SARA imaging report") -> Path:
    """Write the pictures of a comparison of cubes, report.html, which holds them all, and measures.json.

    The files of an earlier report are replaced, all together, when the new ones are complete; other files stay.

    Parameters
    ----------
    comparison : CubeComparison
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
    return write_page(comparison, folder, title, (_line, _channels, _noise), cube_tables)


def _line(comparison, folder) -> list[Picture]:
    """Draw spectrum and line maps."""
    made = [Picture(folder / "spectrum.png", "sky", "Spectrum", "Flux of the models in each channel."),
            Picture(folder / "moments.png", "sky", "Line maps", MOMENTS)]
    cube_pictures.spectrum(made[0].path, comparison)
    cube_pictures.line_maps(made[1].path, comparison)
    return made


def _channels(comparison, folder) -> list[Picture]:
    """Draw the channels of each product."""
    made = []
    for index, product in enumerate(comparison.products, 1):
        for kind, words in (("restored", "Model smoothed with the beam, plus residual; the scale is linear up to 3 σ "
                                         "and logarithmic above."),
                            ("residual", "The scale ends at 4 σ.")):
            path = folder / f"channels_{kind}_{index}.png"
            if cube_pictures.channel_maps(path, comparison, product, kind):
                left = comparison.values.size - len(getattr(product, kind))
                skipped = f" {left} channels are blank or not shown." if left else ""
                made.append(Picture(path, "sky" if kind == "restored" else "residuals",
                                    f"Channels of {product.name}, {kind}", words + skipped))
    return made


def _noise(comparison, folder) -> list[Picture]:
    """Draw the noise of every channel."""
    path = folder / "noise.png"
    if not cube_pictures.noise(path, comparison):
        return []
    return [Picture(path, "residuals", "Noise by channel", "Standard deviation of the residual image, and its largest "
                    "pixel. A channel whose σ stands out has emission left in its residual, or bad data.")]
