"""The report: pictures that follow the data, a page that is whole, harmless and fits the window."""

import dataclasses
import html.parser
import re
import shutil
import subprocess

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image
from synthetic_comparison import BEAMS, CELL, SHAPE, comparison, measures, record

from casa_sara.analysis import animation, convergence, diagnostics, pages, zooms
from casa_sara.analysis.columns import number
from casa_sara.analysis.comparison import Product
from casa_sara.analysis.report import write_report
from casa_sara.analysis.sheets import celestial, draw_beam, plain
from casa_sara.analysis.tables import as_text, tables

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome", "chromium-browser"))), None)
EVIL = '<script>alert("1")</script>$x_$ & co'
FRAMES = (("coarse", np.ones((24, 16)), 0.4), ("fine", np.eye(48, 32) + 1, 0.2))


class Page(html.parser.HTMLParser):
    """Ids, texts of headings, tags, and what the page would load."""

    def __init__(self, path):
        super().__init__()
        self.ids, self.tags, self.links, self.titles, self.text = [], [], [], [], ""
        self.source = path.read_text(encoding="utf-8")
        self.feed(self.source)

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value)
            if name in ("src", "href", "srcset", "data", "poster", "action"):
                self.links.append(value)

    def handle_data(self, data):
        self.text += data
        if self.lasttag in ("h1", "h2", "h3") and data.strip():
            self.titles.append(data.strip())


@pytest.fixture(scope="module")
def full():
    return comparison(frames=FRAMES)


@pytest.fixture(scope="module")
def report(full, tmp_path_factory):
    return write_report(full, tmp_path_factory.mktemp("report"), title="A test")


def pixels(path):
    return np.asarray(Image.open(path).convert("RGB"), float)


def test_report_has_every_section_and_picture(report):
    page = Page(report)
    assert page.ids == ["warnings", "measures", "sky", "frames", "residuals", "runs", "notes", "parameters", "versions"]
    expected = ["Models", "Residual and restored images, natural weighting", "χ² of the blocks",
                "Regions, flux of the models", "Regions, flux of the restored images", "Against the truth",
                "Injected point sources: resolution reached", "Similarity", "All products, natural weighting",
                "All products, briggs weighting", "Models, enlarged",
                "Differences", "Pixel by pixel: the field", "Pixel by pixel: core",
                "Pixel by pixel: lobe", "Radial power spectra", "Histograms of the residuals",
                "Convergence of tsara", "Calibration of tsara, block by block"]  # fmt: skip
    assert set(expected) <= set(page.titles)
    drawn = {path.name for path in report.parent.glob("*.png")}
    assert drawn == {"sky_natural.png", "sky_briggs.png", "zooms.png", "differences.png", "cells.png", "cells_1.png",
                     "cells_2.png", "spectra.png", "histograms.png", "convergence_1.png", "blocks_1.png"}  # fmt: skip
    assert page.tags.count("img") == len(drawn)
    for word in ("imsize", "1.2.3", "one sample was wild & left out", "0.1160 ± 0.0013", "weighting"):
        assert word in page.text


@pytest.mark.slow
def test_a_report_replaces_the_earlier_one_whole(report, tmp_path, monkeypatch):
    """Pictures of the earlier report go, other files stay, and a report that fails changes nothing."""
    few = comparison(names=("one",), with_truth=False)
    shutil.copytree(report.parent, tmp_path, dirs_exist_ok=True)
    (tmp_path / "mine.png").write_text("mine")
    (tmp_path / "differences.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.setattr(diagnostics, "histograms", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_report(few, tmp_path)
    with pytest.raises(ZeroDivisionError):
        write_report(few, tmp_path / "new")
    assert before == {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    monkeypatch.undo()
    write_report(few, tmp_path)
    after = {path.name for path in tmp_path.iterdir()}
    gone = {"cells.png", "cells_1.png", "cells_2.png", "differences.png"}
    assert gone < before.keys() and after == before.keys() - gone
    assert (tmp_path / "mine.png").read_text() == (tmp_path / "differences.txt").read_text() == "mine"
    assert "tclean natural" not in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_a_file_that_is_not_the_reports_is_not_replaced(tmp_path):
    few = comparison(names=("one",), with_truth=False)
    (tmp_path / "zooms.png").write_text("mine")
    with pytest.raises(FileExistsError, match="holds zooms.png, not of an earlier report"):
        write_report(few, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["zooms.png"]
    folder, outside = tmp_path / "folder", tmp_path / "outside.txt"
    folder.mkdir()
    outside.write_text("mine")
    (folder / "report.files").write_text("../outside.txt\n..\nreport.files\n")
    write_report(few, folder)
    assert outside.read_text() == "mine" and (folder / "report.html").exists()


def test_report_is_self_contained(report):
    page = Page(report)
    assert all(link.startswith(("data:image/png;base64,", "#")) for link in page.links)
    assert {link[1:] for link in page.links if link.startswith("#")} <= set(page.ids)
    assert "script" not in page.tags and "link" not in page.tags
    assert not re.search(r"https?://|file:|@import|url\(", page.source)


@pytest.mark.slow
def test_what_comes_from_data_is_escaped(tmp_path):
    made = comparison(names=(EVIL, "other"))
    first = dataclasses.replace(made.products[0], parameters={EVIL: EVIL})
    blocks = [{**block, "ms": EVIL} for block in first.record["blocks"]]
    first = dataclasses.replace(first, record={**first.record, "blocks": blocks})
    masks = {EVIL: made.regions["core"]}
    products = (first, made.products[1])
    made = dataclasses.replace(made, products=products, regions=masks, versions={EVIL: EVIL}, notes=(EVIL,),
                               measures=measures(products, made.truth, masks))
    page = Page(write_report(made, tmp_path, title=EVIL))
    assert "script" not in page.tags and "<script" not in page.source
    assert page.text.count(EVIL) > 10
    assert EVIL in as_text(made)


def test_single_product(tmp_path):
    made = comparison(names=("tsara",), with_truth=False, with_regions=False)
    page = Page(write_report(made, tmp_path))
    assert {"measures", "sky", "residuals", "runs", "notes"} <= set(page.ids)
    assert not {"Similarity", "Differences", "Against the truth"} & set(page.titles)
    assert not any("Regions" in title for title in page.titles)
    assert "S measures how similar" not in page.text and "parameters that differ" not in page.text
    assert "Boxes are enlarged" in page.text  # the brightest peaks


@pytest.mark.parametrize("model", [np.ones(SHAPE), np.zeros(SHAPE), np.full(SHAPE, -1.0)])
def test_nothing_but_a_model(tmp_path, model):
    made = dataclasses.replace(comparison(), products=(Product("one", model),), truth=None, beams={}, regions={},
                               measures={}, versions={}, notes=())
    page = Page(write_report(made, tmp_path))
    assert set(page.ids) in ({"sky", "residuals", "notes"}, {"sky", "notes"})
    assert (tmp_path / "sky.png").exists()
    assert "DR" not in page.text and "beam" not in page.text.replace("Smoothing", "")
    assert ("negative pixels here: one" in page.text) == (model.min() < 0)
    assert as_text(made) == "nothing was measured\n"


@pytest.mark.parametrize("missing", ["history", "bounds", "reweightings", "blocks"])
def test_parts_of_a_record(tmp_path, missing):
    parts = {key: value for key, value in record().items() if key != missing}
    made = Product("tsara", np.ones(SHAPE), record=parts)
    assert convergence.convergence(tmp_path / "c.png", made)
    assert convergence.block_noise(tmp_path / "b.png", made) == (missing != "blocks")
    assert not convergence.convergence(tmp_path / "n.png", Product("other", np.ones(SHAPE)))
    assert not (tmp_path / "n.png").exists()


@pytest.mark.slow
def test_blank_pixels_and_zero_residuals(tmp_path):
    made = comparison(names=("_one", "two"))
    model = made.products[0].model.copy()
    model[:5] = np.nan
    zero = {weighting: np.zeros(SHAPE) for weighting in BEAMS}
    products = (dataclasses.replace(made.products[0], model=model),
                dataclasses.replace(made.products[1], residual=zero))
    made = dataclasses.replace(made, products=products)
    assert write_report(made, tmp_path).exists()
    assert write_report(dataclasses.replace(made, products=products[:1]), tmp_path / "hidden_label").exists()


@pytest.mark.slow
def test_pictures_differ_where_the_data_do(tmp_path, full):
    """A source put into the last residual image shows there, in red, at its place, and nowhere else."""
    last = full.products[-1]  # with the largest residuals: the scales, of the median and the least, stay
    residual = {weighting: image.copy() for weighting, image in last.residual.items()}
    residual["natural"][5:20, 45:60] += 3e-3
    changed = dataclasses.replace(full, products=(*full.products[:-1], dataclasses.replace(last, residual=residual)))
    for name, made in (("before", full), ("after", changed)):
        pages.overview(tmp_path / f"{name}.png", made, "natural")
        diagnostics.histograms(tmp_path / f"{name}_histogram.png", made)
    before, after = pixels(tmp_path / "before.png"), pixels(tmp_path / "after.png")
    assert before.shape == after.shape
    rows, columns = np.nonzero(np.abs(after - before).sum(axis=2) > 30)
    panel = (SHAPE[0] * 4.0, SHAPE[1] * 4.0)  # of about 400 screen pixels, as four panels share 11.5 inches
    assert np.ptp(columns) == pytest.approx(15 / SHAPE[0] * panel[0], rel=0.1)
    assert np.ptp(rows) == pytest.approx(15 / SHAPE[1] * panel[1], rel=0.1)
    height, width = before.shape[:2]
    assert 0.76 * width < columns.min() and columns.max() < 0.85 * width  # the left of the last column
    assert 0.65 * height < rows.min() and rows.max() < 0.8 * height  # the top of the last row
    colours = after[rows, columns]
    assert np.mean(colours[:, 0] > colours[:, 2] + 50) > 0.95
    assert np.any(pixels(tmp_path / "before_histogram.png") != pixels(tmp_path / "after_histogram.png"))


def test_axes_put_north_up_and_east_left(full):
    wcs = celestial(full)
    centre = wcs.wcs_pix2world([[SHAPE[0] // 2, SHAPE[1] // 2]], 0)[0]
    np.testing.assert_allclose(centre, full.centre_deg, atol=1e-10)
    east, north = wcs.wcs_pix2world([[SHAPE[0] // 2 - 10, SHAPE[1] // 2], [SHAPE[0] // 2, SHAPE[1] // 2 + 10]], 0)
    scale = 3600 / CELL / 10
    assert (east[0] - centre[0]) * np.cos(np.deg2rad(centre[1])) * scale == pytest.approx(1, rel=1e-6)
    assert (north[1] - centre[1]) * scale == pytest.approx(1, rel=1e-6)


@pytest.mark.parametrize("cell", [(0.1, 0.1), (0.1, 0.2)])
def test_beam_is_turned_from_north_through_east(cell):
    axes = Figure().subplots()
    axes.set(xlim=(-0.5, 99.5), ylim=(-0.5, 99.5))
    draw_beam(axes, (2.0, 0.5, 30.0), cell)
    (ellipse,) = axes.patches
    (outline,) = ellipse.get_transform().transform_path(ellipse.get_path()).to_polygons()
    outline = axes.transData.inverted().transform(outline)
    middle = (outline.max(axis=0) + outline.min(axis=0)) / 2
    outline = (outline - middle) * cell * (-1, 1)  # to the east and to the north, in arcsec
    tip = outline[np.argmax(outline @ (0.5, 0.866))]
    np.testing.assert_allclose(tip, (np.sin(np.pi / 6), np.cos(np.pi / 6)), atol=0.03)
    assert np.hypot(*outline.T).max() == pytest.approx(1, rel=0.02)
    assert np.hypot(*outline.T).min() == pytest.approx(0.25, rel=0.02)


@pytest.mark.parametrize("cell", [(0.1, 0.1), (0.1, 0.2)])
def test_models_are_smoothed_with_the_beam_on_the_sky(full, cell):
    """Second moments of a smoothed point, in arcsec, are those of the beam."""
    point = np.zeros((96, 96))
    point[48, 48] = 1.0
    made = dataclasses.replace(full, cell_arcsec=cell, beams={"briggs": (2.0, 1.0, 30.0)})
    image = pages.smoothed(made, point, "briggs")
    east, north = (48 - np.arange(96))[:, None] * cell[0], (np.arange(96) - 48)[None, :] * cell[1]
    sin, cos = 0.5, np.sqrt(0.75)
    assert image.sum() == pytest.approx(1)
    for along, fwhm in ((east * sin + north * cos, 2.0), (east * cos - north * sin, 1.0)):
        assert np.sqrt(8 * np.log(2) * np.sum(image * along**2)) == pytest.approx(fwhm, rel=1e-3)


def test_zooms_are_around_regions_or_peaks(full):
    found = {zoom.name: zoom.box for zoom in zooms.find_zooms(full)}
    assert list(found) == ["core", "lobe"]
    x0, x1, y0, y1 = found["core"]
    assert x0 <= 18 and x1 >= 33 and y0 <= 14 and y1 >= 28 and x1 - x0 == y1 - y0
    peaks = zooms.find_zooms(dataclasses.replace(full, regions={}))
    for x, y in ((25, 20), (60, 20), (70, 45)):
        assert any(z.box[0] <= x < z.box[1] and z.box[2] <= y < z.box[3] for z in peaks)


def test_a_zoom_is_where_its_region_is(full):
    """The box around the core is centred, in arcsec to the east and north, on the middle of its mask."""
    core = zooms.find_zooms(full)[0]
    east, north, side = core.on_sky(full)
    x, y = np.argwhere(full.regions["core"]).mean(axis=0)
    assert (east, north) == pytest.approx(((SHAPE[0] // 2 - x) * CELL, (y - SHAPE[1] // 2) * CELL), abs=CELL)
    assert side == pytest.approx(1.3 * 15 * CELL, abs=CELL)


def test_spectrum_of_white_noise_and_of_a_point():
    noise = np.random.default_rng(1).standard_normal((128, 96)) * 3
    for window in (False, True):
        frequency, power = diagnostics.radial_spectrum(noise, (0.1, 0.1), window)
        assert np.mean(power[5:]) == pytest.approx(9 * noise.size, rel=0.05)
    point = np.zeros((32, 31))
    point[7, 9] = 2.0
    frequency, power = diagnostics.radial_spectrum(point, (0.1, 0.2))
    np.testing.assert_allclose(power, 4.0)
    assert frequency[-1] == pytest.approx(0.5 / np.deg2rad(0.2 / 3600), rel=0.1)


@pytest.mark.parametrize("shape", [(24, 20), (25, 21)])
def test_spectrum_is_the_mean_over_rings(shape):
    image = np.random.default_rng(2).standard_normal(shape)
    frequency, power = diagnostics.radial_spectrum(image, (0.1, 0.1))
    full = np.abs(np.fft.fft2(image)) ** 2
    radius = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n, np.deg2rad(0.1 / 3600)) for n in shape), indexing="ij"))
    for ring in (0, 1, 4, 9):
        inside = np.abs(radius / frequency[1] - ring) < 0.5
        assert power[ring] == pytest.approx(full[inside].mean())


def test_spectrum_is_at_the_frequency_of_a_wave():
    wave = np.cos(2 * np.pi * 10 * np.arange(64) / 64)[:, None] * np.ones((1, 48))
    frequency, power = diagnostics.radial_spectrum(wave, (0.1, 0.1))
    assert frequency[np.argmax(power)] == pytest.approx(10 / 6.4 / np.deg2rad(1 / 3600))


def test_animation_has_a_frame_for_each_image(tmp_path):
    path = tmp_path / "cells.png"
    animation.animate(path, FRAMES, zoom=(0.0, 0.0, 1.6))
    with Image.open(path) as image:
        assert image.n_frames == 2
        first = np.asarray(image.convert("RGB"), float)
        image.seek(1)
        assert np.any(np.asarray(image.convert("RGB"), float) != first)
    with pytest.raises(ValueError, match="zoom=.* holds no emission"):
        animation.animate(path, FRAMES, zoom=(50.0, 0.0, 1.0))
    square = first.shape
    animation.animate(path, FRAMES)  # the field of 48 x 32 pixels
    with Image.open(path) as image:
        assert image.width > 1.1 * square[1] and image.height < 0.9 * square[0]
    one = [*FRAMES, ("dark", np.zeros((8, 8)), 0.4)]
    assert animation.has_emission(FRAMES, (0.0, 0.0, 1.0)) and not animation.has_emission(one, (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="frames is empty"):
        animation.animate(path, [])


def test_table_as_text(full):
    text = as_text(full)
    titles = [table.title for table in tables(full)]
    assert len(titles) == 9 and all(title in text for title in titles)
    assert "note: one sample was wild & left out" in text
    flux = full.measures["products"]["tsara"]["flux_jy"]
    assert re.search(rf"^ +flux .*\n +Jy .*\n  tsara +{flux:.4f} ", text, re.MULTILINE)
    for table in tables(full):
        assert {len(row) for row in (table.heads, table.units, *table.rows)} == {len(table.heads)}
    widths = [len(line.rstrip()) for line in text.split("\n\n")[0].splitlines()[1:2] + text.splitlines()[3:6]]
    assert len(set(widths)) == 1  # columns end below each other


@pytest.mark.parametrize(
    ("value", "text"),
    [(None, "–"), (float("nan"), "–"), (float("inf"), "∞"), (-float("inf"), "−∞"), (0, "0"), (0.0, "0"),
     (12345.6, "12,346"), (1.5, "1.500"), (-0.25, "−0.2500"), (2.5e-5, "2.500e−5"), ("text", "text")],
)  # fmt: skip
def test_numbers(value, text):
    assert number(value) == text


def test_units_and_decimals_follow_the_numbers(full):
    """One prefix for one unit of a table; as many decimals as the error has."""
    sigmas = {"one": 2e-4, "two": 8.5e-4}
    measured = {"products": {
        name: {"natural": {"sigma": sigma, "peak": 0.5, "dr": 0.5 / sigma},
               "regions": {"core": {"flux_jy": 12.3456, "error_jy": 0.0321}, "lobe": {"flux_jy": 1.0}}}
        for name, sigma in sigmas.items()
    }}  # fmt: skip
    products = tuple(Product(name, np.ones(SHAPE)) for name in sigmas)
    residuals, regions = tables(dataclasses.replace(full, products=products, measures=measured))
    assert residuals.units == ("", "mJy/beam", "mJy/beam", "")
    assert residuals.rows == (("one", "0.2000", "500.0", "2,500"), ("two", "0.8500", "500.0", "588"))
    assert regions.rows == (("core", *["12.346 ± 0.032"] * 2), ("lobe", *["1.000"] * 2))


def test_names_are_printed_as_they_are():
    """Matplotlib reads $…$ as mathematics and leaves labels that start with an underscore out of a legend."""
    assert plain("_a $b$") == r" _a \$b\$" and plain("a_b") == "a_b"


def test_chi_square_of_the_blocks_and_the_range_of_ssim(full):
    made = {table.title: table for table in tables(full)}
    blocks, against = made["χ² of the blocks"], made["Against the truth"]
    assert blocks.heads == ("", "median", "least", "most", "blocks")
    assert blocks.rows[0] == ("tsara", "1.100", "1.000", "1.400", "3")
    number_of = against.heads.index("SSIM")
    assert against.heads[number_of + 1] == "its range" and against.units[number_of + 1] == "mJy/pixel"
    assert float(against.rows[0][number_of + 1]) == pytest.approx(1e3 * full.truth.max(), rel=1e-3)


def test_injected_sources_beside_the_beams(full):
    """Widths in arcsec and in beams; a restored image is as wide as its own beam."""
    made = {table.title: table for table in tables(full)}["Injected point sources: resolution reached"]
    assert made.heads == ("", "injected", "recovered", "recovered", "offset", "width", "width", "width")
    assert made.units == ("", "mJy", "mJy", "%", "arcsec", "arcsec", "natural beams", "briggs beams")
    assert made.rows == (
        ("tsara, 19h59m28.3s +40d44m12s", "20.00", "19.00", "95.00", "0.02000", "0.2500", "0.315", "0.559"),
        ("restored images, natural weighting", "–", "–", "–", "–", "0.7937", "1.000", "1.775"),
        ("restored images, briggs weighting", "–", "–", "–", "–", "0.4472", "0.563", "1.000"),
    )
    assert "in a circle of 0.447″" in made.caption and "other imagers were not run again" in made.caption


def test_what_was_not_measured_is_left_out(full):
    measured = {"products": {"tsara": {"flux_jy": 1.0}, "tclean briggs": {"flux_jy": 2.0, "mdr": float("inf")}},
                "similarity": {"natural": {"tsara|tclean briggs": float("inf")}}}
    made = tables(dataclasses.replace(full, measures=measured))
    assert [table.title for table in made] == ["Models", "Similarity"]
    assert made[0].rows == (("tsara", "1.000", "–"), ("tclean briggs", "2.000", "∞"))
    assert made[0].units == ("", "Jy", "")
    assert made[1].rows == (("tsara and tclean briggs", "∞"),)


@pytest.mark.slow
@pytest.mark.skipif(not CHROMIUM, reason="no Chromium to render the page")
@pytest.mark.parametrize("width", [1024, 1400])
def test_page_fits_the_window(report, width, tmp_path):
    """The page is no wider than the window, nor a table than the page: asked of the layout, and seen."""
    probe = tmp_path / "probe.html"
    script = """<script>document.title = [document.documentElement.scrollWidth, innerWidth,
        ...[...document.querySelectorAll(".wide")].map(box => box.scrollWidth - box.clientWidth)].join(" ")
        </script></body>"""
    probe.write_text(report.read_text(encoding="utf-8").replace("</body>", script), encoding="utf-8")
    picture = tmp_path / "page.png"
    browser = [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
               f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},3000"]
    dom = subprocess.run([*browser, "--dump-dom", probe.as_uri()], capture_output=True, text=True, timeout=120)
    page_width, window, *beyond = map(int, re.search(r"<title>([\d ]+)</title>", dom.stdout)[1].split())
    assert page_width == window == width
    assert len(beyond) == 11 and not any(beyond)  # nine tables of measures, parameters and versions
    subprocess.run([*browser, f"--screenshot={picture}", report.as_uri()], capture_output=True, check=True, timeout=120)
    page = pixels(picture)
    assert page.shape == (3000, width, 3)
    assert np.all(page[:, -8:] == 255)
    assert np.mean(page != 255) > 0.05 and len(np.unique(page.astype(np.uint8).reshape(-1, 3), axis=0)) > 100
