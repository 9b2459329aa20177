"""Cubes beside each other: measures by channel, line maps against CASA's, FITS, the report, and every refusal."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from simulated_ms import column, edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import saracompare, tsara
from casa_sara.analysis.cube_comparison import LineMaps
from casa_sara.comparison.compare_cubes import compare_cubes
from casa_sara.options import Comparing, Selection

ARCSEC = np.pi / 180 / 3600
GRID = dict(imsize=[64, 60], cell="10arcsec", datacolumn="data", specmode="cube", restfreq="1.4202GHz", nthreads=1,
            wavelets=["dirac", "db1", "db4"])
LINE = np.array([0.2, 0.5, 1.0, 0.3])  # Jy in each channel
BLANK = 3


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run of tsara, and the truth made to look like another product; one channel of the data is flagged."""
    folder = tmp_path_factory.mktemp("runs")
    vis = simulate(folder / "line.ms", frame="LSRK", spws=(("1.42GHz", "50kHz", 4),), scans=2, antennas=10, noise=0.02,
                   sky=((1.0, 20 * ARCSEC, -30 * ARCSEC),), columns=("DATA", "MODEL_DATA"))
    model = column(vis, "MODEL_DATA")
    edit(vis, "DATA", lambda data: data + (LINE[:, None] - 1) * model)
    edit(vis, "FLAG", lambda flag: flag | (np.arange(4) == BLANK)[:, None])
    tsara(vis=vis, imagename=str(folder / "run"), niter=120, **GRID)
    shutil.copytree(folder / "run.model", folder / "truth")
    ia = casatools.image()
    ia.open(str(folder / "truth"))
    pixels = np.zeros((64, 60, 1, 4), np.float32)
    pixels[30, 27, 0] = LINE
    ia.putchunk(pixels)
    ia.close()
    tsara(vis=vis, imagename=str(folder / "true"), niter=0, startmodel=str(folder / "truth"), **GRID)
    return folder


def pixels_of(name):
    ia = casatools.image()
    ia.open(str(name))
    try:
        return np.squeeze(ia.getchunk()).astype(float)
    finally:
        ia.close()


def compared(runs, vis=True, **options):
    selection = Selection((str(runs / "line.ms"),), datacolumn="data") if vis else None
    models = options.pop("models", (str(runs / "run"), str(runs / "true")))
    return compare_cubes(Comparing(models, **options), selection)


@pytest.fixture(scope="module")
def both(runs):
    return compared(runs, regions=("source = 19h59m30.3s +40d43m32s 60arcsec",), truth=str(runs / "truth"))


def test_channels_are_measured_as_their_images_say(runs, both):
    """Residuals from the visibilities are those that the run wrote; the blank channel has no measures."""
    channels = both.measures["channels"]
    assert [("products" in channel) for channel in channels] == [k != BLANK for k in range(4)]
    residual, model = pixels_of(runs / "run.residual"), pixels_of(runs / "run.model")
    freqs = 1.42e9 + 50e3 * np.arange(4)
    for k, channel in enumerate(channels):
        assert channel["frequency_hz"] == pytest.approx(freqs[k], abs=1)
        assert channel["velocity_km_s"] == pytest.approx(299792.458 * (1 - freqs[k] / 1.4202e9), abs=1e-3)
        if k != BLANK:
            entry = channel["products"]["run"]
            assert entry["natural"]["sigma"] == pytest.approx(residual[:, :, k].std(), rel=1e-4)
            assert entry["flux_jy"] == pytest.approx(model[:, :, k].sum(), rel=1e-5)
            of_truth = channel["products"]["true"]["regions"]["source"]
            assert of_truth["model_flux_jy"] == pytest.approx(LINE[k], rel=1e-5)
            assert channel["products"]["true"]["truth"]["snr"] == np.inf and entry["truth"]["snr"] > 5
            assert len(channel["beams"]["natural"]) == 3
    width = 299792.458 * 50e3 / 1.4202e9
    truth = pixels_of(runs / "truth")
    assert both.measures["products"]["run"]["line_flux"] == pytest.approx(width * model.sum(), rel=1e-4)
    snr = 10 * np.log10((truth**2).sum() / ((model - truth) ** 2).sum())
    assert both.measures["products"]["run"]["truth"]["snr"] == pytest.approx(snr, abs=1e-3)
    assert both.measures["products"]["run"]["peak_channel"] == 2


def test_line_maps_are_casas(runs):
    """Moment 0 and 1 of the restored cube by CASA's immoments, with its own pixels above a limit."""
    import casatasks

    found = compared(runs, vis=False, models=(str(runs / "run"),) * 2, names=("a", "b")).products[0]
    casatasks.immoments(str(runs / "run.image"), moments=[0], outfile="zero")
    width = 299792.458 * 50e3 / 1.4202e9
    image, residual = pixels_of(runs / "run.image"), pixels_of(runs / "run.residual")
    np.testing.assert_allclose(found.moment0, pixels_of("zero"), atol=2e-3 * width * image.max())
    line = image > 5 * residual.std(axis=(0, 1))
    line[:, :, BLANK] = False
    velocity = 299792.458 * (1 - (1.42e9 + 50e3 * np.arange(4)) / 1.4202e9)
    with np.errstate(invalid="ignore"):
        expected = (image * line * velocity).sum(axis=2) / (image * line).sum(axis=2)
    inner = line.all(axis=2) | line[:, :, :BLANK].all(axis=2)
    assert inner.sum() > 20
    np.testing.assert_allclose(found.moment1[inner], expected[inner], atol=0.05)
    assert np.isnan(found.moment1[0, 0])


def test_moments_of_known_lines():
    """Two products, of which one has a line where the mean of both has none."""
    maps = LineMaps(("a", "b"), (1, 2))
    for value, flux in ((10.0, 1.0), (20.0, 3.0)):
        maps.add_models({"a": np.array([[flux, 0]]), "b": np.array([[flux, 0]])}, 2.0)
        restored = {"a": np.array([[flux, 0.15]]), "b": np.array([[flux, 0.0]])}
        maps.add_restored(restored, {"a": 0.02, "b": 0.02}, value, 2.0)
    assert maps.moment0["a"].tolist() == [[8.0, 0.6]] and maps.model["b"].tolist() == [[8.0, 0.0]]
    assert maps.moment1("a")[0, 0] == pytest.approx(17.5) and np.isnan(maps.moment1("a")[0, 1])


def test_cubes_as_fits_are_the_same(runs, both):
    for name in ("run.model", "true.model"):
        ia = casatools.image()
        ia.open(str(runs / name))
        ia.tofits(f"{name}.fits", velocity=False, dropstokes=name.startswith("true"))
        ia.close()
    found = compared(runs, models=("run", "true"))
    for ours, theirs in zip(found.measures["channels"], both.measures["channels"]):
        for name, entry in ours.get("products", {}).items():
            for key in ("flux_jy", "peak_jy_per_pixel"):
                assert entry[key] == pytest.approx(theirs["products"][name][key], rel=1e-5)
            assert entry["natural"]["sigma"] == pytest.approx(theirs["products"][name]["natural"]["sigma"], rel=1e-4)
    tsara(vis=str(runs / "line.ms"), imagename="again", niter=0, startmodel="run.model.fits", **GRID)
    np.testing.assert_allclose(pixels_of("again.model"), pixels_of(runs / "run.model"), atol=1e-6)


@pytest.mark.slow
def test_reports_show_every_channel(runs):
    """Of a run, and of two products; the table of islands is that of the record."""
    result = tsara(vis=str(runs / "line.ms"), imagename="run", report=True, **GRID)
    page = Path("run.report/report.html").read_text(encoding="utf-8")
    for word in ("Channels of run", "Islands of run", "Line maps", "4 channels, 42.21", "converged", "blank"):
        assert word in page, word
    island = result["sara"]["channels"][2]["islands"][0]
    assert island["right_ascension"] in page
    found = saracompare(models=["run", str(runs / "true")], vis=str(runs / "line.ms"), datacolumn="data", outdir="two")
    assert json.loads(Path("two/measures.json").read_text())["products"].keys() == found["products"].keys()
    names = {path.name for path in Path("two").iterdir()}
    assert {"spectrum.png", "moments.png", "noise.png", "channels_restored_2.png", "channels_residual_1.png"} <= names


@pytest.mark.parametrize("options, words", [
    (dict(inject=("19h59m30s +40d43m32s",)), "inject = .* with cubes: for images of one channel only; should be"),
    (dict(support="x.mask"), "support = 'x.mask' with cubes"),
    (dict(models=("one", "run")), r"models = 'one.model' has the shape \[64, 60, 1, 1\]: should be one Stokes, and"),
    (dict(models=("run", "less")), "'less.model' has 2 channels, .*'run.model' 4 channels, .*of the same channels"),
    (dict(models=("run", "shifted")), "should be cubes of the same channels"),
    (dict(models=("run", "empty")), "models: 'empty' is zero in all channels"),
])
def test_refusals(runs, options, words):
    shutil.copytree(runs / "run.model", "run.model")
    ia = casatools.image()
    ia.open("run.model")
    pixels, csys = ia.getchunk(), ia.coordsys()
    ia.close()
    made = dict(one=pixels[..., :1], less=pixels[..., :2], shifted=pixels, empty=0 * pixels)
    for name, values in made.items():
        there = csys.copy()
        if name == "shifted":
            there.setreferencevalue(there.referencevalue(format="n", type="spectral")["numeric"][0] + 50e3, "spectral")
        image = ia.newimagefromarray(f"{name}.model", values, csys=there.torecord(), overwrite=True)
        image.setbrightnessunit("Jy/pixel")
        image.close()
    with pytest.raises(ValueError, match=words):
        compared(runs, **{"models": ("run", "run")} | options)
