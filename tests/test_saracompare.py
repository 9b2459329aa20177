"""The comparison as a user calls it: products in, measures out, and every refusal."""

import dataclasses
import json
import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from astropy import units
from astropy.convolution import convolve_fft
from PIL import Image
from radio_beam import Beam
from simulated_ms import edit, simulate
from test_shell import SCRIPT

casatools = pytest.importorskip("casatools")

from casa_sara import saracompare, tsara
from casa_sara.analysis import metrics
from casa_sara.casa.images.image_sets import read_image_set
from casa_sara.casa.images.sky_image import read_header
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import imaging_weights
from casa_sara.comparison import injection
from casa_sara.comparison.compare_images import compare_images
from casa_sara.options import Comparing, ImageGrid, Selection, Weighting
from casa_sara.private.parameters import SARACOMPARE, TSARA
from casa_sara.runtime import jsonfile
from casa_sara.solver.record import STOPPED_BY_USER
from casa_sara.tasks import saracompare as compare_task, tsara as tsara_task

ARCSEC = np.radians(1 / 3600)
CENTRE = (np.radians(299.86875), np.radians(40 + 44 / 60 + 2 / 3600))  # of the simulated observation
BEAM = {"major": "3arcsec", "minor": "2arcsec", "pa": "30deg"}
# point sources on pixels of 0.5 arcsec and a patch: Jy, pixels to the west and to the north of the centre
SOURCES = [(1.0, 24, 14), (0.4, -18, -20)] + [(0.02, x, y) for x in range(-4, 5) for y in range(-4, 5)]


def write(name, pixels, unit="Jy/pixel", cell=0.5, centre=CENTRE, beam=None, frame="J2000", history=()):
    """Write a CASA image as tclean lays it out."""
    csys = casatools.coordsys()
    csys = csys.newcoordsys(direction=True, spectral=True, stokes=["I"])
    csys.setreferencecode(frame, "direction", adjust=False)
    csys.setunits(["rad", "rad", "", "Hz"])
    csys.setreferencevalue(list(centre), "direction")
    csys.setreferencepixel([n // 2 for n in pixels.shape], "direction")
    wide, high = np.broadcast_to(cell, 2) * ARCSEC
    csys.setincrement([-float(wide), float(high)], "direction")
    csys.setreferencevalue(8.4e9, "spectral")
    ia = casatools.image()
    pixels = np.asarray(pixels, np.float32)[:, :, None, None]
    ia.fromarray(str(name), pixels, csys=csys.torecord(), overwrite=True, log=False)
    ia.setbrightnessunit(unit)
    if beam:
        ia.setrestoringbeam(**beam)
    if history:
        ia.sethistory(origin="test", history=list(history))
    ia.close()
    return str(name)


def sky(shape=(128, 128), sources=SOURCES, scale=1):
    """The sources as an image, on pixels `scale` times as fine."""
    image = np.zeros(shape)
    for flux, west, north in sources:
        image[shape[0] // 2 + scale * west, shape[1] // 2 + scale * north] += flux
    return image


def product(root, model=None, seed=0, sigma=0.01, **about):
    """Write a model and a residual of noise, and return the root and both."""
    model = sky() if model is None else model
    residual = sigma * np.random.default_rng(seed).standard_normal(model.shape)
    write(f"{root}.model", model, **about)
    write(f"{root}.residual", residual, "", beam=BEAM, **about)
    return str(root), np.float32(model).astype(float), np.float32(residual).astype(float)


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    components = [(flux, -west * 0.5 * ARCSEC, north * 0.5 * ARCSEC) for flux, west, north in SOURCES]
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=14, sky=components, noise=0.05,
                    scans=2, integration=30.0, spacing_seconds=5400.0, hour_angle=-2.5, seed=6)


def imstat(name, **options):
    from casatasks import imstat as task

    return task(imagename=str(name), **options)


# Numbers ----------------------------------------------------------------------------------------


def test_measures_are_those_of_casa_and_numpy(tmp_path):
    one, model, residual = product(tmp_path / "one", seed=1)
    two, other, _ = product(tmp_path / "two", model=np.roll(sky(), 1, axis=1), seed=2)
    region = "19h59m28.5s +40d44m02s 3.3arcsec"
    found = saracompare(models=[one, two], regions=f"patch = {region}")
    mine = found["products"]["one"]
    # restored image by CASA's own convolution
    ia = casatools.image()
    ia.open(one + ".model")
    smoothed = ia.convolve2d(outfile=one + ".smoothed", axes=[0, 1], type="gaussian", major="3arcsec", minor="2arcsec",
                             pa="30deg", overwrite=True)
    pixels = smoothed.getchunk()[:, :, 0, 0].astype(float)
    smoothed.close()
    ia.close()
    restored = pixels + residual
    sigma = imstat(one + ".residual")["sigma"][0]  # of n − 1
    sigma *= np.sqrt((residual.size - 1) / residual.size)
    assert mine["natural"]["sigma"] == pytest.approx(sigma, rel=1e-6)
    assert mine["natural"]["dr"] == pytest.approx(restored.max() / sigma, rel=1e-6)
    # and by astropy's with radio-beam
    kernel = Beam(3 * units.arcsec, 2 * units.arcsec, 30 * units.deg).as_kernel(0.5 * units.arcsec, x_size=99,
                                                                                y_size=99)
    kernel = kernel.array / kernel.array.sum() * np.pi * 6 / (4 * np.log(2) * 0.25)
    theirs = convolve_fft(model.T, kernel, boundary="fill", normalize_kernel=False).T + residual
    assert mine["natural"]["dr"] == pytest.approx(theirs.max() / sigma, rel=1e-6)
    assert mine["natural"]["peak"] == pytest.approx(theirs.max(), rel=1e-6)
    assert mine["natural"]["max_abs"] == pytest.approx(np.abs(residual).max(), rel=1e-9)
    # flux: the model in the circle, and the restored image
    box = "circle[[19h59m28.5s, +40d44m02s], 3.3arcsec]"
    assert mine["flux_jy"] == pytest.approx(imstat(one + ".model")["sum"][0], rel=1e-6)
    inside = imstat(one + ".model", region=box)["sum"][0]
    assert mine["regions"]["patch"]["model_flux_jy"] == pytest.approx(inside, rel=1e-6)
    write(one + ".image", restored, "Jy/beam", beam=BEAM)
    statistics = imstat(one + ".image", region=box)
    assert mine["regions"]["patch"]["flux_jy"] == pytest.approx(statistics["flux"][0], rel=1e-6)
    beams = statistics["npts"][0] / (np.pi * 3 * 2 / (4 * np.log(2) * 0.25))
    assert mine["regions"]["patch"]["error_jy"] == pytest.approx(sigma * np.sqrt(beams), rel=1e-6)
    # similarity
    smooth = [metrics.smooth(image, (6.0, 4.0), 30.0) for image in (model, other)]
    by_hand = 20 * np.log10(max(map(np.linalg.norm, smooth)) / np.linalg.norm(smooth[0] - smooth[1]))
    assert found["similarity"] == {"natural": {"one|two": pytest.approx(by_hand, rel=1e-6)}}


def test_an_image_and_itself_are_infinitely_similar(tmp_path):
    one, *_ = product(tmp_path / "one")
    found = saracompare(models=[one, one], outdir="report")
    assert list(found["products"]) == ["one", one]
    assert found["similarity"]["natural"] == {f"one|{one}": np.inf}
    assert jsonfile.load("report/measures.json") == found
    text = Path("report/measures.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail)["similarity"]["natural"] == {f"one|{one}": "Infinity"}


@pytest.mark.parametrize("pixels, cell, factor", [((256, 256), 0.25, 2), ((150, 96), 0.5, 1), ((90, 90), 0.75, None)])
def test_other_pixels_keep_the_flux(tmp_path, pixels, cell, factor):
    one, model, _ = product(tmp_path / "one")
    other = sky(pixels, scale=factor) if factor else sky(pixels, [(1.0, 9, -5), (0.4, 3, 8)])
    found = saracompare(models=[one, write(tmp_path / "fine.model", other, cell=cell)])
    fine = found["products"]["fine"]
    assert fine["flux_jy"] == pytest.approx(other.sum(), rel=1e-6)
    if factor:  # every source is on a pixel of both
        assert fine["peak_jy_per_pixel"] == pytest.approx(model.max(), rel=1e-3)
        assert found["similarity"]["natural"]["one|fine"] > 50


def test_another_centre_and_frame_is_the_same_sky(tmp_path):
    """The same pixels of the sky around another centre."""
    one, model, _ = product(tmp_path / "one")
    shifted = np.roll(sky(), (-6, 4), axis=(0, 1))
    centre = CENTRE[0] - 6 * 0.5 * ARCSEC / np.cos(CENTRE[1]), CENTRE[1] - 4 * 0.5 * ARCSEC
    found = saracompare(models=[one, write(tmp_path / "two.model", shifted, centre=centre)])
    assert found["products"]["two"]["flux_jy"] == pytest.approx(model.sum(), rel=1e-6)
    assert found["similarity"]["natural"]["one|two"] > 50
    same = saracompare(models=[one, write(tmp_path / "wrong.model", shifted)])["similarity"]["natural"]["one|wrong"]
    assert same < 5


def test_a_point_in_galactic_coordinates_is_found_again(tmp_path):
    me = casatools.measures()
    offset = CENTRE[0] - 24 * 0.5 * ARCSEC / np.cos(CENTRE[1]), CENTRE[1] + 14 * 0.5 * ARCSEC
    there = me.measure(me.direction("J2000", *(f"{float(angle)!r}rad" for angle in offset)), "GALACTIC")
    point = sky(sources=[(1.0, 0, 0)])
    one, *_ = product(tmp_path / "one", sky(sources=[(1.0, 24, 14)]))
    two = write(tmp_path / "two.model", point, centre=[there[axis]["value"] for axis in ("m0", "m1")], frame="GALACTIC")
    found = saracompare(models=[one, two])
    assert found["products"]["two"]["flux_jy"] == pytest.approx(1.0, rel=1e-6)
    assert found["similarity"]["natural"]["one|two"] > 35
    with pytest.raises(ValueError,
                       match="models: '.*two.model' is in GALACTIC: the first should be in J2000, ICRS or B1950"):
        saracompare(models=[two, one])


def test_fits_is_read_like_casa(tmp_path):
    from casatasks import exportfits

    one, *_ = product(tmp_path / "one")
    for kind in ("model", "residual"):
        exportfits(imagename=f"{one}.{kind}", fitsimage=str(tmp_path / f"two.{kind}.fits"))
    shutil.copy(tmp_path / "two.model.fits", tmp_path / "three.fits")
    found = saracompare(models=[one, str(tmp_path / "two"), str(tmp_path / "three.fits")])
    assert found["products"]["two"]["natural"] == pytest.approx(found["products"]["one"]["natural"])
    assert set(found["similarity"]["natural"].values()) == {np.inf}
    assert "natural" not in found["products"]["three"]
    assert read_header(str(tmp_path / "two.residual.fits"))[0] == pytest.approx((3.0, 2.0, 30.0))


def test_history_says_weighting_and_parameters(tmp_path):
    lines = ["taskname=tclean", "version: CASA 6.7", 'vis = "a.ms"', 'weighting   = "briggs"', "robust      = -1.0"]
    one, *_ = product(tmp_path / "one", history=lines)
    two, *_ = product(tmp_path / "two", seed=1)
    comparison = compare_images(Comparing((one, two)))
    assert comparison.products[0].parameters | {"robust": "-1.0", "vis": "a.ms", "weighting": "briggs"} \
        == comparison.products[0].parameters
    assert list(comparison.products[0].residual) == ["briggs"] and list(comparison.products[1].residual) == ["natural"]
    assert any("'two' has an unknown weighting" in note for note in comparison.notes)
    assert comparison.centre_deg == pytest.approx(np.degrees(CENTRE))
    assert comparison.cell_arcsec == pytest.approx((0.5, 0.5))


def test_record_of_tsara_is_read(tmp_path):
    one, *_ = product(tmp_path / "one")
    record = {"blocks": [{"ms": "a.ms", "scans": [1], "noise_measured": float("nan")}],
              "history": {"iteration": [1, 2], "rel_change": [np.inf, 0.5]}}
    jsonfile.save(one + ".sara.json", record)
    comparison = compare_images(Comparing((one,)), single=True)
    assert np.isnan(comparison.products[0].record["blocks"][0]["noise_measured"])
    assert comparison.products[0].record["history"] == record["history"]


def test_a_record_is_written_whole_or_not_at_all(tmp_path):
    jsonfile.save("record.json", {"values": np.array([1.5, np.nan, -np.inf]), 3: (np.int64(2), "NaNs", None, True)})
    kept = jsonfile.load("record.json")
    assert kept["values"][0] == 1.5 and np.isnan(kept["values"][1]) and kept["values"][2] == -np.inf
    assert kept["3"] == [2, "NaNs", None, True]
    before = Path("record.json").read_bytes()
    with pytest.raises(TypeError):
        jsonfile.save("record.json", {"values": [1.0] * 10_000, "more": object()})
    assert Path("record.json").read_bytes() == before and os.listdir() == ["record.json"]
    os.umask(old := os.umask(0o022))
    assert os.stat("record.json").st_mode & 0o777 == 0o666 & ~old


@pytest.mark.parametrize("support", ["region", "mask", "file"])
def test_support_can_be_given(tmp_path, support):
    model = sky()
    model[100, 20] = 0.05
    one, *_ = product(tmp_path / "one", model)
    mask = np.hypot(*(np.indices((128, 128)) - 64)) < 41
    write(tmp_path / "s.mask", mask, "")
    (tmp_path / "s.crtf").write_text("#CRTFv0\ncircle[[19h59m28.5s, 40d44m02s], 20.5arcsec], coord=J2000\n")
    given = {"region": "19h59m28.5s +40d44m02s 20.5arcsec", "mask": "s.mask", "file": "s.crtf"}
    found = saracompare(models=[one, one], support=given[support])
    assert found["products"]["one"]["mdr"] == pytest.approx(1 / 0.05, rel=1e-6)


def test_truth_is_brought_to_the_same_pixels(tmp_path):
    one, model, _ = product(tmp_path / "one", sky() + 1e-3 * np.random.default_rng(2).random((128, 128)))
    truth = write(tmp_path / "truth.im", sky((256, 256), scale=2), cell=0.25)
    found = saracompare(models=[one, one], truth=truth)["products"]["one"]
    by_hand = 20 * np.log10(np.linalg.norm(sky()) / np.linalg.norm(model - sky()))
    assert found["truth"]["snr"] == pytest.approx(by_hand, abs=0.1)
    assert set(found["truth"]) == {"snr", "log_snr", "ssim", "ssim_range_jy_per_pixel", "snr_at_scale"}
    peak = found["truth"]["ssim_range_jy_per_pixel"]
    assert peak == pytest.approx(1.0, rel=1e-3)  # of the truth
    assert found["truth"]["ssim"] == pytest.approx(metrics.ssim(sky(), model, peak), rel=1e-3)


@pytest.mark.slow
def test_frames_are_animated_in_the_report(tmp_path):
    """The field, and the region that holds emission; each with a frame for each image, in their order."""
    one, *_ = product(tmp_path / "one")
    fine = write(tmp_path / "fine.model", sky((256, 256), scale=2), cell=0.25)
    regions = ["patch = 19h59m28.5s +40d44m02s 3.3arcsec", "empty = 19h59m28.5s +40d44m20s 2arcsec"]
    saracompare(models=[one, one], outdir="report", frames=[one, fine], regions=regions)
    drawn = sorted(path.name for path in Path("report").glob("cells*.png"))
    assert drawn == ["cells.png", "cells_1.png"]
    page = Path("report/report.html").read_text()
    assert page.count("Pixel by pixel: ") == 2 * len(drawn) and 'id="frames"' in page
    with Image.open("report/cells.png") as image:
        assert image.n_frames == 2
    comparison = compare_images(Comparing((one, one), frames=(fine, one)))
    assert [(name, pixels.shape, round(cell, 9)) for name, pixels, cell in comparison.frames] \
        == [("fine", (256, 256), 0.25), ("one", (128, 128), 0.5)]


# Visibilities -----------------------------------------------------------------------------------


def oracle(vis, model, weighting, cell=0.5, shape=(128, 128)):
    """The residual image by the explicit Fourier sum, and its weights' χ² of all samples."""
    data = read_visibilities(Selection((vis,), datacolumn="data"))
    grid = ImageGrid(shape, (cell * ARCSEC,) * 2)
    weights = imaging_weights(data, grid, weighting).astype(float)
    l, m = (np.arange(n) - n // 2 for n in shape)  # pixels to the west, to the north
    turn = 2j * np.pi * cell * ARCSEC
    west, north = np.exp(turn * np.outer(-data.uvw[0], l)), np.exp(turn * np.outer(data.uvw[1], m))
    left = data.vis - np.einsum("ki,ij,kj->k", west, model, north, optimize=True)
    image = np.einsum("k,ki,kj->ij", weights * left, west.conj(), north.conj(), optimize=True).real / weights.sum()
    return image, (data.weight * np.abs(left) ** 2).sum() / (2 * data.size)


def test_residuals_are_made_by_one_operator(tmp_path, vis):
    """Against the explicit sum, for both weightings, whatever stands beside the models."""
    one, model, _ = product(tmp_path / "one")
    worse = model.copy()
    worse[80, 80] += 0.1
    two, *_ = product(tmp_path / "two", worse, seed=4)
    comparison = compare_images(Comparing((one, two)), Selection((vis,), datacolumn="data"))
    for item, pixels in zip(comparison.products, (model, worse)):
        for name, weighting in (("natural", Weighting("natural")), ("briggs", Weighting("briggs", -1.0))):
            image, chi_square = oracle(vis, pixels, weighting)
            np.testing.assert_allclose(item.residual[name], image, atol=2e-5 * np.abs(image).max())
            measured = comparison.measures["products"][item.name]
            assert measured[name]["sigma"] == pytest.approx(image.std(), rel=1e-4)
            *axes, angle = comparison.beams[name]
            restored = metrics.smooth(pixels, axes, angle, (0.5, 0.5)) * metrics.beam_pixels(axes, (0.5, 0.5)) + image
            assert measured[name]["dr"] == pytest.approx(restored.max() / image.std(), rel=1e-4)
        assert np.mean(measured["natural"]["chi_square"]) == pytest.approx(chi_square, rel=2e-2)
    best, other = comparison.measures["products"].values()
    assert best["natural"]["chi_square"] == pytest.approx([1.0, 1.0], abs=0.05)  # the true sky leaves noise
    assert min(other["natural"]["chi_square"]) > 1.1
    assert best["natural"]["whiteness"] > other["natural"]["whiteness"]
    assert comparison.beams["briggs"][0] < comparison.beams["natural"][0]


def test_beams_are_those_of_tclean(tmp_path, vis):
    from casatasks import tclean

    one, *_ = product(tmp_path / "one")
    comparison = compare_images(Comparing((one,)), Selection((vis,), datacolumn="data"), single=True)
    for name, extra in (("natural", {}), ("briggs", {"robust": -1.0})):
        root = str(tmp_path / name)
        tclean(vis=vis, imagename=root, imsize=128, cell="0.5arcsec", datacolumn="data", niter=0, weighting=name,
               **extra)
        assert comparison.beams[name] == pytest.approx(read_header(root + ".psf")[0], rel=2e-3)


@pytest.mark.parametrize("scale", [2, 3])
def test_models_on_finer_pixels_are_not_blurred(tmp_path, vis, scale):
    """A model is held against the data on its own pixels: one between the common pixels fits as well."""
    one, *_ = product(tmp_path / "one")
    fine = sky((128 * scale,) * 2, scale=scale)
    two = write(tmp_path / "two.model", fine, cell=0.5 / scale)
    three = write(tmp_path / "three.model", np.roll(fine, 1, axis=0), cell=0.5 / scale)
    found = saracompare(models=[one, two, three], vis=vis, datacolumn="data")["products"]
    for name in ("sigma", "dr", "max_abs", "whiteness"):
        assert found["two"]["natural"][name] == pytest.approx(found["one"]["natural"][name], rel=1e-3)
    image, _ = oracle(vis, np.roll(fine, 1, axis=0), Weighting("natural"), 0.5 / scale, fine.shape)
    first = fine.shape[0] // 2 - 64 * scale
    assert found["three"]["natural"]["sigma"] == pytest.approx(image[first::scale, first::scale].std(), rel=1e-3)


def test_the_frame_of_the_first_model_is_kept(tmp_path, vis):
    me = casatools.measures()
    there = me.measure(me.direction("J2000", *(f"{float(angle)!r}rad" for angle in CENTRE)), "ICRS")
    centre = [there[axis]["value"] for axis in ("m0", "m1")]
    one, *_ = product(tmp_path / "one")
    two, *_ = product(tmp_path / "two", frame="ICRS", centre=centre)
    region = ["patch = 19h59m28.5s +40d44m02s 3.3arcsec"]
    first = saracompare(models=[one, two], vis=vis, datacolumn="data", regions=region)["products"]
    second = saracompare(models=[two, one], vis=vis, datacolumn="data", regions=region)["products"]
    for name in ("one", "two"):
        assert first[name]["natural"]["chi_square"] == pytest.approx([1.0, 1.0], abs=0.05)
        assert second[name]["natural"]["sigma"] == pytest.approx(first["one"]["natural"]["sigma"], rel=1e-2)
        assert second[name]["regions"]["patch"]["model_flux_jy"] == pytest.approx(81 * 0.02, rel=1e-2)


def test_visibilities_are_selected_and_untouched(tmp_path, vis):
    one, *_ = product(tmp_path / "one")
    before = {path: path.read_bytes() for path in Path(vis).rglob("*") if path.is_file()}
    both = saracompare(models=[one, one], vis=vis, datacolumn="data")["products"]["one"]["natural"]
    first = saracompare(models=[one, one], vis=[vis], scan="1", datacolumn="data")["products"]["one"]["natural"]
    assert len(both["chi_square"]) == 2 and len(first["chi_square"]) == 1 and first["sigma"] > both["sigma"]
    assert first["chi_square"][0] == pytest.approx(both["chi_square"][0], rel=1e-6)
    assert before == {path: path.read_bytes() for path in Path(vis).rglob("*") if path.is_file()}


# Injection --------------------------------------------------------------------------------------

EMPTY = "19h59m27.35632s +40d43m49.99965s"  # pixel (90, 40) of 128


@pytest.fixture(scope="module")
def deep(tmp_path_factory):
    """A MeasurementSet with little noise and an image of tsara of it, made with parameters of its own."""
    folder = tmp_path_factory.mktemp("deep")
    components = [(flux, -west * 0.5 * ARCSEC, north * 0.5 * ARCSEC) for flux, west, north in SOURCES]
    name = simulate(folder / "c.ms", configuration="c", antennas=14, sky=components, noise=0.01, scans=2,
                    integration=30.0, spacing_seconds=5400.0, hour_angle=-2.5, seed=6)
    root = str(folder / "sara")
    tsara(vis=name, imagename=root, imsize=128, cell="0.5arcsec", datacolumn="data", blocks=3, wavelevels=3,
          wavelets=["dirac", "db1", "db4"], nreweights=12)
    return name, root


@pytest.mark.slow
def test_an_injected_source_is_recovered(tmp_path, deep):
    """A point of known flux on a pixel of the empty sky, narrower than the beam; CLEAN's is not asked again."""
    vis, root = deep
    before = {path: path.read_bytes() for path in Path(vis).rglob("*") if path.is_file()}
    one, *_ = product(tmp_path / "one")
    models = [one, root]
    found = saracompare(models=models, vis=vis, datacolumn="data", inject=EMPTY, injectflux=0.3, outdir="report")
    assert "injected" not in found["products"]["one"]
    (source,) = found["products"]["sara"]["injected"].values()
    assert source["injected_jy"] == 0.3
    assert source["flux_jy"] == pytest.approx(0.3, rel=0.04)
    assert source["offset_arcsec"] < 0.1
    assert 0.35 < source["fwhm_arcsec"] < 0.9  # pixels are 0.5 arcsec wide
    beam = compare_images(Comparing((root,)), single=True).beams["natural"]  # of the PSF
    in_beams = source["fwhm_arcsec"] / np.sqrt(beam[0] * beam[1])
    assert source["fwhm_in_beams"]["natural"] == pytest.approx(in_beams, rel=0.01)
    assert source["fwhm_in_beams"]["natural"] < 0.35
    assert f"sara, {EMPTY}" in Path("report/report.html").read_text()
    assert before == {path: path.read_bytes() for path in Path(vis).rglob("*") if path.is_file()}


def test_a_source_between_pixels_of_a_model_elsewhere(tmp_path, deep):
    """The first model has other pixels and another centre: places are on the sky; the flux is of the noise."""
    vis, root = deep
    centre = CENTRE[0] - 6 * 0.5 * ARCSEC / np.cos(CENTRE[1]), CENTRE[1] - 4 * 0.5 * ARCSEC
    two = write(tmp_path / "two.model", np.roll(sky(), (-6, 4), axis=(0, 1)), centre=centre)
    place = "19h59m27.33432s +40d43m50.14963s"
    found = saracompare(models=[two, root], vis=vis, datacolumn="data", inject=[place])["products"]["sara"]
    source = found["injected"][place]
    assert source["injected_jy"] == pytest.approx(100 * found["natural"]["sigma"], rel=1e-6)
    assert source["flux_jy"] == pytest.approx(source["injected_jy"], rel=0.1)
    assert source["offset_arcsec"] < 0.3 and source["fwhm_in_beams"]["natural"] < 0.8


def test_a_run_is_repeated_to_the_last_digits(deep):
    """Parameters in the history are all that a run needs: without a source the same model comes out."""
    vis, root = deep
    one = read_image_set(root)
    without, with_source = injection._repeat(one, [(90, 40)], 0.3, Selection((vis,), datacolumn="data"), 1)
    peak = one.model.pixels.max()
    np.testing.assert_allclose(without, one.model.pixels, atol=1e-4 * peak)
    assert np.abs(with_source - without).max() > 0.1 * peak


def test_a_run_that_is_stopped_measures_nothing(deep, monkeypatch):
    vis, root = deep
    solve = injection.solve_image

    def stopped(*arguments):
        solved = solve(*arguments[:-1], dataclasses.replace(arguments[-1], niter=3))
        solved.record.stop_code = STOPPED_BY_USER
        return solved

    monkeypatch.setattr(injection, "solve_image", stopped)
    with pytest.raises(KeyboardInterrupt):
        saracompare(models=[root, root], vis=vis, datacolumn="data", inject=EMPTY)


# Refusals ---------------------------------------------------------------------------------------

FAR = (CENTRE[0], CENTRE[1] + np.radians(0.1))
OPPOSITE = (CENTRE[0] + np.pi, -CENTRE[1])


@pytest.mark.parametrize("about, message", [
    (dict(unit="Jy/beam"), "models = '.*two.model' is in 'Jy/beam': should be in 'Jy/pixel'; the model is the image"),
    (dict(unit="K"), "models = '.*two.model' is in 'K': should be in 'Jy/pixel'"),
    (dict(centre=FAR), "models: '.*two.model' does not overlap '.*one.model' on the sky"),
    (dict(centre=OPPOSITE), "models: '.*two.model' does not overlap"),
    (dict(pixels=np.full((128, 128), np.nan)), "models = '.*two.model' holds 16384 pixels that are not finite"),
    (dict(pixels=np.zeros((128, 128))), "models: '.*two.model' is zero everywhere"),
])
def test_models_that_cannot_be_compared_are_refused(tmp_path, about, message):
    one, *_ = product(tmp_path / "one")
    two = write(tmp_path / "two.model", **(dict(pixels=sky()) | about))
    with pytest.raises(ValueError, match=message):
        saracompare(models=[one, two], outdir="report")
    assert not Path("report").exists()


def test_models_beside_each_other_do_not_overlap(tmp_path):
    one, *_ = product(tmp_path / "one")
    for pixels, refused in ((130, True), (100, False)):
        centre = CENTRE[0], CENTRE[1] + pixels * 0.5 * ARCSEC
        two = write(tmp_path / "two.model", np.ones((128, 128)), centre=centre)
        if refused:
            with pytest.raises(ValueError, match="does not overlap"):
                saracompare(models=[one, two])
        else:
            assert saracompare(models=[one, two])["products"]["two"]["flux_jy"] == pytest.approx(128 * 28, rel=0.01)


@pytest.mark.parametrize("parameters, error, message", [
    (dict(models=[]), ValueError, r"models = \[\]: must be given"),
    (dict(models="one"), ValueError, r"models = \['one'\]: should be 2 or more products"),
    (dict(models="one", features=EMPTY), ValueError, "features = .*has no effect without vis"),
    (dict(models=["one", "absent"]), FileNotFoundError, "models = 'absent': neither it nor 'absent.model'"),
    (dict(names=["a"]), ValueError, r"names = \['a'\]: 1 for 2 models"),
    (dict(names=["a", "a"]), ValueError, "names = .*should differ"),
    (dict(names=["a", "b|c"]), ValueError, "names = .*no '|'"),
    (dict(truth="absent"), FileNotFoundError, "truth = 'absent' does not exist"),
    (dict(truth="one.residual"), ValueError, "truth = 'one.residual' is in ''"),
    (dict(truth="far.model"), ValueError, "truth: 'far.model' does not overlap"),
    (dict(regions="0deg 0deg 1arcsec"), ValueError, "regions = '0deg 0deg 1arcsec' is outside the image"),
    (dict(regions="19h59m28.51s +40d44m02.1s 0.01arcsec"), ValueError, "regions = .* is empty"),
    (dict(support="19h59m28.51s +40d44m02.1s 0.01arcsec"), ValueError, "support = .* is empty"),
    (dict(support="far.model"), ValueError, "support = 'far.model' holds 0 of 16384 pixels"),
    (dict(support="all.mask"), ValueError, "support = 'all.mask' holds 16384 of 16384 pixels"),
    (dict(threshold=2.0), ValueError, "threshold = 2.0"),
    (dict(inject=EMPTY), ValueError, f"inject = '{re.escape(EMPTY)}' has no effect without vis"),
    (dict(injectflux=1.0), ValueError, "injectflux = 1.0 has no effect without vis"),
    (dict(frames=["one", "two"]), ValueError, "frames = .*has no effect without outdir"),
    (dict(frames="one", outdir="new"), ValueError, r"frames = \['one'\]: should be two or more images"),
    (dict(frames=["one", "absent"], outdir="new"), FileNotFoundError, "frames = 'absent': neither it nor"),
    (dict(frames=["one", "oblong.model"], outdir="new"), ValueError, "frames = .*pixels of 1 x 0.5 arcsec: should be"),
    (dict(frames=["one", "far.model"], outdir="new"), ValueError, "frames = 'far.model' has another centre"),
    (dict(robust=0.5), ValueError, "robust = 0.5 has no effect without vis"),
    (dict(scan="1"), ValueError, "scan = '1' has no effect without vis"),
    (dict(datacolumn="data"), ValueError, "datacolumn = 'data' has no effect without vis"),
    (dict(vis="absent.ms"), FileNotFoundError, "vis = .*'absent.ms' not found"),
    (dict(outdir="full"), FileExistsError, "outdir = 'full' holds files"),
    (dict(outdir="full/file"), ValueError, "outdir = 'full/file' is a file"),
    (dict(outdir="absent/report"), FileNotFoundError, "outdir = 'absent/report': the folder"),
    (dict(models=["one", "cube.model"]), ValueError, r"models = 'one.model' has the shape .* as the other cubes"),
    (dict(models=["one", "text.fits"]), ValueError, "models = 'text.fits' cannot be read as an image"),
])
def test_bad_parameters_raise_and_name_themselves(tmp_path, parameters, error, message):
    product("one")
    product("two", seed=1)
    write("far.model", sky(), centre=FAR)
    write("oblong.model", sky((64, 128), [(1.0, 0, 0)]), cell=(1.0, 0.5))
    write("all.mask", np.ones((128, 128)), "")
    Path("text.fits").write_text("no image")
    Path("full").mkdir()
    Path("full/file").touch()
    ia = casatools.image()
    ia.fromshape("cube.model", [8, 8, 1, 2], log=False)
    ia.setbrightnessunit("Jy/pixel")
    ia.close()
    with pytest.raises(error, match=message):
        saracompare(**(dict(models=["one", "two"]) | parameters))


@pytest.mark.parametrize("parameters, message", [
    (dict(inject="19h59m28.51s"), "inject = '19h59m28.51s' is not a position: should be right ascension"),
    (dict(inject="here there"), "inject = 'here there' is not a position"),
    (dict(inject="0deg 0deg"), "inject = '0deg 0deg' is outside the image"),
    (dict(inject="19h59m28.51s +40d44m33.4s"), "inject = .* is outside of 'sara', or closer to its edge than 2.5"),
    (dict(inject=EMPTY, models=["one", "one"]), "inject = .*needs vis, and images of tsara with their history"),
    (dict(injectflux=1.0), "injectflux = 1.0 has no effect without inject"),
])
def test_injections_that_make_no_sense_are_refused(tmp_path, deep, parameters, message):
    vis, root = deep
    product("one")
    with pytest.raises(ValueError, match=message):
        saracompare(**(dict(models=[root, "one"], vis=vis, datacolumn="data") | parameters))


def test_names_in_the_data_do_no_harm_in_the_report(tmp_path, vis):
    """Fields, antennas, histories and records may hold anything."""
    evil = "<script>alert('1')</script>"
    copy = shutil.copytree(vis, tmp_path / "evil.ms")
    edit(f"{copy}/FIELD", "NAME", lambda names: np.full_like(names, evil))
    edit(f"{copy}/ANTENNA", "NAME", lambda names: np.array([f"{evil}{n}" for n in range(len(names))]))
    one, *_ = product(tmp_path / "one", history=["taskname=tsara", f'field = "{evil}"', f'antenna = "{evil}&{evil}"'])
    block = {"ms": evil, "scans": [1], "start_mjd_s": 4.9e9, "end_mjd_s": 4.9e9 + 60, "samples": 500,
             "noise_measured": 1.0, "noise_found": 1.1, "l2_bound": 30.0}
    jsonfile.save(one + ".sara.json", {"wild": [{"antenna1": evil}], "blocks": [block]})
    saracompare(models=[one, one], names=[evil, "b"], vis=str(copy), datacolumn="data", outdir="report")
    page = Path("report/report.html").read_text()
    assert "<script" not in page and page.count("&lt;script&gt;") >= 3


def test_an_image_without_a_beam_is_refused(tmp_path, vis):
    one = write(tmp_path / "one.model", sky())
    with pytest.raises(ValueError, match="none of them has an .image, .residual or .psf with a beam"):
        saracompare(models=[one, one])
    write(tmp_path / "one.residual", sky(), "Jy/beam")
    with pytest.raises(ValueError,
                       match="'.*one.residual' has no beam, and there is no image or PSF with a beam: give vis"):
        saracompare(models=[one, one])
    assert saracompare(models=[one, one], vis=vis, datacolumn="data")["products"]["one"]["natural"]["dr"] > 10
    write(tmp_path / "one.psf", sky(), "", beam=BEAM)
    assert compare_images(Comparing((one, one))).beams["natural"] == pytest.approx((3.0, 2.0, 30.0))


def test_products_of_different_data_are_refused_without_vis(tmp_path, vis):
    one, *_ = product(tmp_path / "one", history=['vis = "a.ms"'])
    two, *_ = product(tmp_path / "two", history=["vis = ['run/b.ms', 'c.ms']"])
    with pytest.raises(ValueError, match=r"'one' \(a.ms\) and 'two' \(b.ms, c.ms\) are made from different data"):
        saracompare(models=[one, two])
    jsonfile.save(one + ".sara.json", {"wild": [{"row": 5}]})
    comparison = compare_images(Comparing((one, two)), Selection((vis,), datacolumn="data"))
    assert comparison.measures["similarity"]["natural"] == {"one|two": np.inf}
    assert "'two' was made from b.ms, c.ms, and is compared with c.ms like the others" in comparison.notes
    assert "1 outliers that 'one' left out are included in the residuals of all" in comparison.notes
    three, *_ = product(tmp_path / "three", history=["vis = ['other/a.ms']"])
    assert saracompare(models=[one, three])["similarity"]["natural"] == {"one|three": np.inf}


def test_a_residual_that_does_not_cover_the_image_is_refused(tmp_path, vis):
    one, *_ = product(tmp_path / "one")
    two, *_ = product(tmp_path / "two", sky((100, 100)), seed=1)
    with pytest.raises(ValueError, match="'.*two.residual' covers 61 % of '.*one.model' and cannot be put on its"):
        saracompare(models=[one, two])
    assert "natural" in saracompare(models=[two, one])["products"]["one"]
    found = saracompare(models=[one, two], vis=vis, datacolumn="data")["products"]
    for name in ("sigma", "dr", "chi_square"):
        assert found["two"]["natural"][name] == pytest.approx(found["one"]["natural"][name], rel=1e-3)


def test_pixels_too_coarse_for_the_visibilities_are_refused(tmp_path, vis):
    one = write(tmp_path / "one.model", sky((32, 32), [(1.0, 0, 0)]), cell=5.0)
    with pytest.raises(ValueError, match="models.*visibilities cannot be computed for vis.*cell"):
        saracompare(models=[one, one], vis=vis, datacolumn="data")


def test_overwrite_replaces_the_report_and_leaves_other_files(tmp_path):
    one, *_ = product(tmp_path / "one")
    Path("report").mkdir()
    saracompare(models=[one, one], outdir="report")  # an empty folder will do
    Path("report/mine.txt").write_text("mine")
    before = Path("report/measures.json").read_text()
    with pytest.raises(FileExistsError, match="outdir"):
        saracompare(models=[one, one], names=["a", "b"], outdir="report")
    assert Path("report/measures.json").read_text() == before
    found = saracompare(models=[one, one], names=["a", "b"], outdir="report", overwrite=True)
    assert jsonfile.load("report/measures.json") == found and list(found["products"]) == ["a", "b"]
    assert Path("report/mine.txt").read_text() == "mine"
    Path("report/report.files").unlink()
    with pytest.raises(FileExistsError, match="outdir = 'report' holds report.html, measures.json, not of an earlier"):
        saracompare(models=[one, one], outdir="report", overwrite=True)


# Task -------------------------------------------------------------------------------------------


def test_parameters_of_the_selection_are_tsaras():
    theirs = {parameter.name: parameter for parameter in TSARA}
    ours = {parameter.name: parameter for parameter in SARACOMPARE}
    assert set(Selection.PARAMETERS) <= ours.keys() and tsara_task is not compare_task
    for name in (*Selection.PARAMETERS, "selectdata", "datacolumn"):
        assert ours[name]._replace(summary="") == theirs[name]._replace(summary=""), name


@pytest.mark.slow
@pytest.mark.skipif(find_spec("casashell") is None, reason="casashell is not installed")
def test_the_task_in_the_casa_shell(tmp_path):
    product(tmp_path / "one")
    product(tmp_path / "two", np.roll(sky(), 1, axis=0), seed=1)
    cells = ["inp saracompare", "models = ['one', 'two']; names = ['a', 'b']; outdir = 'report'", "inp saracompare",
             "result = go(saracompare)", "list(result['products'])", "go saracompare", "taskhelp()"]
    (tmp_path / "cells.json").write_text(json.dumps(cells))
    (tmp_path / "script.py").write_text(SCRIPT)
    (tmp_path / "startup.py").write_text("from casa_sara.gotasks import *\n")
    flags = "--nogui --nologger --nologfile --agg --colors NoColor --cachedir cache"
    environment = os.environ | {"HOME": str(tmp_path), "COLUMNS": "110", "PYTHONPATH": str(Path(__file__).parents[1])}
    run = subprocess.run([sys.executable, "-m", "casashell", *flags.split(), "--startupfile", "startup.py", "-c",
                          "script.py"],
                         cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=120)
    assert (tmp_path / "records.json").exists(), run.stdout + run.stderr
    shown, _, again, went, names, refused, tasks = json.loads((tmp_path / "records.json").read_text())
    assert shown["printed"].startswith("# saracompare -- Compare images") and "threshold" in shown["printed"]
    assert "['one', 'two']" in again["printed"]
    assert went["error"] == "NoneType", went["printed"]
    assert names["result"] == ["a", "b"]
    assert json.loads((tmp_path / "report/measures.json").read_text())["similarity"]["natural"]["a|b"] < 20
    assert refused["error"] == "FileExistsError"  # the report is there now
    assert "saracompare" in tasks["printed"]


def test_regions_on_an_image_in_b1950():
    """A circle in J2000 falls on its place in an image whose frame is B1950."""
    from astropy import units
    from astropy.coordinates import FK4, SkyCoord

    from casa_sara.analysis.areas import Frame, region_masks

    place = SkyCoord("12h29m06.7s", "+2d03m09s", frame="fk5")
    old = place.transform_to(FK4(equinox="B1950"))
    frame = Frame((old.ra.deg, old.dec.deg), (1.0, 1.0), (64, 64), "FK4")
    north = place.directional_offset_by(0 * units.deg, 10 * units.arcsec)
    mask = region_masks([f"{north.ra.deg}deg {north.dec.deg}deg 3arcsec"], frame)
    x, y = np.argwhere(next(iter(mask.values()))).mean(axis=0)
    assert x == pytest.approx(32, abs=0.5) and y == pytest.approx(42, abs=0.5)
