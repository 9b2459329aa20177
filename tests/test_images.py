"""Coordinates, primary beam, beam, restored image and metadata against tclean's; reading and writing of images."""

import os
import shutil
import time
from collections import namedtuple
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from simulated_ms import CYGNUS_A, edit, simulate

from casa_sara.casa.images.image_files import read_model, write_image
from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.images.products import (
    PRODUCTS,
    check_imagename,
    existing_products,
    history_lines,
    new_products,
    remove_products,
    write_products,
)
from casa_sara.casa.images.restore import fit_beam, restore, restoring_beam_words
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime import log
from casa_sara.imaging.run_solver import Preparing
from casa_sara.options import ImageGrid, Output, Selection

ARCSEC = np.pi / 180 / 3600
OFF_CENTRE = "J2000 19h59m40.5s +40d40m02s"
# shape, cell in arcsec, tclean's parameters
CASES = {
    "plain": ((100, 100), (3.0, 3.0), {}),
    "wide, beyond the primary beam": ((128, 90), (9.0, 9.0), {"weighting": "briggs", "robust": 0.0}),
    "odd, not square, elsewhere": (
        (101, 81),
        (3.0, 4.0),
        {"phasecenter": "J2000 20h00m00s +40d40m00s", "reffreq": "8.45GHz", "projection": "TAN"},
    ),
    "a channel range": ((90, 100), (3.0, 3.0), {"spw": "1:1~2"}),
    "another field": ((80, 80), (3.0, 3.0), {"field": "FIELD1"}),
    "field number, B1950": ((80, 80), (3.0, 3.0), {"phasecenter": "B1950 19h57m44.4s +40d35m46s"}),
}
Run = namedtuple("Run", "root plane")


@pytest.fixture(scope="session")
def name(tmp_path_factory):
    """Two spectral windows, TOPO, two fields of two scans each, an observer."""
    path = tmp_path_factory.mktemp("ms") / "sim.ms"
    spws = (("8.4GHz", "10MHz", 3), ("8.6GHz", "10MHz", 3))
    fields = (CYGNUS_A, OFF_CENTRE)
    simulate(path, frame="TOPO", fields=fields, spws=spws, scans=2, antennas=10, integration=20.0, noise=0.05)
    edit(f"{path}/OBSERVATION", "OBSERVER", lambda old: np.array(["Karl Jansky"]))
    return str(path)


@pytest.fixture(scope="session")
def runs(name, tmp_path_factory):
    """tclean's niter=0 products of a case, and the image plane made for it; each once."""
    folder, made = tmp_path_factory.mktemp("tclean"), {}

    def run(case):
        if case not in made:
            import casatasks

            shape, cell, options = CASES[case]
            root = str(folder / str(len(made)))
            arcsec = [f"{c}arcsec" for c in cell]
            options = {"imsize": list(shape), "cell": arcsec, "datacolumn": "data"} | options
            casatasks.tclean(vis=name, imagename=root, niter=0, **options)
            made[case] = Run(root, plane_of(name, case))
        return made[case]

    return run


def plane_of(name, case):
    shape, cell, options = CASES[case]
    chosen = {key: options[key] for key in ("field", "spw") if key in options}
    selection = Selection(vis=(name,) if isinstance(name, str) else name, datacolumn="data", **chosen)
    given = {key: options[key] for key in ("phasecenter", "projection", "reffreq") if key in options}
    grid = ImageGrid(shape, tuple(c * ARCSEC for c in cell), **given)
    return define_image_plane(read_visibilities(selection, grid.phasecenter), selection, grid)


def contents(path):
    """Return what an image holds: pixels, mask, coordinates, unit, beam, imageinfo."""
    import casatools

    ia, tb = casatools.image(), casatools.table()
    ia.open(str(path))
    held = {
        "pixels": ia.getchunk()[:, :, 0, 0],
        "mask": ia.getchunk(getmask=True)[:, :, 0, 0],
        "masks": (ia.maskhandler("get"), ia.maskhandler("default")),
        "csys": ia.coordsys().torecord(),
        "unit": ia.brightnessunit(),
        "beam": ia.restoringbeam(),
        "history": ia.history(list=False),
        "miscinfo": ia.miscinfo(),
    }
    ia.close()
    tb.open(str(path))
    held["imageinfo"] = tb.getkeyword("imageinfo")
    tb.close()
    return held


def assert_same_record(one, other, path=""):
    """Every number of two records agrees to the round-off of a written-out angle."""
    assert set(one) == set(other), path
    for key, value in one.items():
        if isinstance(value, dict):
            assert_same_record(value, other[key], f"{path}/{key}")
        elif np.asarray(value).dtype.kind == "f":
            np.testing.assert_allclose(value, other[key], rtol=1e-14, atol=1e-16, err_msg=f"{path}/{key}")
        else:
            assert np.array_equal(value, other[key]), f"{path}/{key}"


@pytest.mark.parametrize("case", CASES)
def test_coordinates_and_primary_beam_are_tcleans(runs, case):
    run = runs(case)
    reference = contents(run.root + ".pb")
    assert_same_record(run.plane.csys, reference["csys"])
    np.testing.assert_allclose(run.plane.pb, reference["pixels"], atol=1e-7)
    np.testing.assert_array_equal(run.plane.mask, reference["mask"])
    assert not (case.startswith("wide") and run.plane.mask.all())
    assert run.plane.imageinfo == reference["imageinfo"]
    assert run.plane.miscinfo.items() <= reference["miscinfo"].items()
    assert reference["csys"]["observer"] == "Karl Jansky"


def test_the_measurement_set_that_begins_first_gives_the_date(name, runs, tmp_path):
    later = simulate(tmp_path / "later.ms", date="2016/03/01", spws=(("8.4GHz", "10MHz", 3),))
    plane = plane_of((later, name), "plain")
    assert_same_record(plane.csys["obsdate"], runs("plain").plane.csys["obsdate"])


def test_a_measurement_set_without_selected_data_does_no_harm(name, tmp_path):
    far = simulate(tmp_path / "far.ms", configuration="a", antennas=5)
    selection = Selection(vis=(name, far), datacolumn="data", uvrange="<1500m")
    grid = ImageGrid((64, 64), (ARCSEC, ARCSEC))
    plane = define_image_plane(read_visibilities(selection), selection, grid)
    assert plane.imageinfo["objectname"] == "FIELD0"


@pytest.mark.parametrize("parameter, value", [("projection", "XYZ"), ("reffreq", "3m"), ("reffreq", "x")])
def test_wrong_image_parameters_are_refused(name, parameter, value):
    selection = Selection(vis=(name,), datacolumn="data")
    grid = ImageGrid((64, 64), (ARCSEC, ARCSEC), **{parameter: value})
    with pytest.raises(ValueError, match=f"{parameter} = '{value}'"):
        define_image_plane(read_visibilities(selection), selection, grid)


def test_making_the_plane_leaves_no_trace(name, tmp_path):
    def bytes_of(folder):
        return {path: path.read_bytes() for path in Path(folder).rglob("*") if path.is_file()}

    before = bytes_of(name)
    plane_of(name, "plain")
    assert bytes_of(name) == before
    assert os.listdir(tmp_path) == []


# ---- beam and restored image


@pytest.mark.parametrize("case", ["plain", "wide, beyond the primary beam", "odd, not square, elsewhere"])
def test_beam_is_tcleans(runs, case):
    run = runs(case)
    beam, reference = fit_beam(contents(run.root + ".psf")["pixels"], run.plane), contents(run.root + ".psf")["beam"]
    for axis in ("major", "minor", "positionangle"):
        assert beam[axis]["unit"] == reference[axis]["unit"]
        assert beam[axis]["value"] == pytest.approx(reference[axis]["value"], rel=4e-7)


def test_beam_that_cannot_be_fitted_is_refused(runs):
    plane = runs("plain").plane
    psf = np.ones(plane.shape, np.float32)
    with pytest.raises(ValueError, match="cell = '3arcsec' is too large"):
        fit_beam(psf, plane)


@pytest.mark.parametrize(
    "case, restoringbeam",
    [
        ("plain", ""),
        ("plain", ["25arcsec", "18arcsec", "30deg"]),
        ("wide, beyond the primary beam", "20arcsec"),
        ("odd, not square, elsewhere", "common"),
    ],
    ids=str,
)
def test_products_and_restored_image_are_tcleans(name, runs, tmp_path, case, restoringbeam):
    """Given tclean's own PSF and residual, every product equals what tclean writes of the same model."""
    import casatasks

    run = runs(case)
    shape, cell, options = CASES[case]
    model = np.random.default_rng(5).exponential(0.01, shape).astype(np.float32)
    given = str(tmp_path / "given.model")
    write_image(given, model, run.plane, unit="Jy/pixel")
    theirs, ours = str(tmp_path / "theirs"), str(tmp_path / "ours")
    casatasks.tclean(
        vis=name, imagename=theirs, imsize=list(shape), cell=[f"{c}arcsec" for c in cell], niter=0, datacolumn="data",
        startmodel=given, restoringbeam=restoringbeam, **options,
    )  # fmt: skip
    reference = {product: contents(theirs + product) for product in PRODUCTS}
    images = {kind: reference["." + kind]["pixels"] for kind in ("psf", "residual", "model")}
    sumwt = reference[".sumwt"]["pixels"].item()
    output = Output(ours, restoringbeam=restoringbeam, history=("a line",))
    write_products(output, run.plane, images, sumwt, reference[".psf"]["beam"])
    assert existing_products(ours) == [ours + product for product in PRODUCTS]
    for product in PRODUCTS:
        made = contents(ours + product)
        scale = np.abs(reference[product]["pixels"]).max()
        np.testing.assert_allclose(made["pixels"], reference[product]["pixels"], rtol=0, atol=4e-7 * scale,
                                   err_msg=product)
        for what in ("mask", "masks", "unit"):
            np.testing.assert_array_equal(made[what], reference[product][what], err_msg=product)
        assert_same_record(made["csys"], reference[product]["csys"], product)
        assert_same_record(made["imageinfo"], reference[product]["imageinfo"], product)
        assert made["history"] == ["a line"]
        assert made["miscinfo"].items() <= reference[product]["miscinfo"].items()
    written = [root + product for root in ("ours", "theirs") for product in PRODUCTS]
    assert sorted(os.listdir(tmp_path)) == sorted([*written, "given.model"])


def test_residual_is_left_as_it_is_by_a_smaller_beam(runs, tmp_path):
    """A restoring beam smaller than the fitted one smooths the model alone, as in tclean."""
    run = runs("plain")
    root = str(tmp_path / "x")
    for product in (".psf", ".residual", ".model"):
        shutil.copytree(run.root + product, root + product)
    restore(root, "4arcsec")
    image = contents(root + ".image")
    np.testing.assert_allclose(image["pixels"], contents(run.root + ".residual")["pixels"], atol=1e-6)
    assert image["beam"]["major"] == {"value": 4.0, "unit": "arcsec"}


@pytest.mark.parametrize("words", ["", [], [""], "common", ["common"]], ids=str)
def test_restoring_beam_words_for_the_fitted_beam(words):
    assert restoring_beam_words(words) == (["common"] if "common" in words else [])  # which differs for cubes


@pytest.mark.parametrize(
    "words",
    [
        "3",
        "large",
        "0arcsec",
        "-1arcsec",
        ["3arcsec", "2arcsec"],
        ["2arcsec", "3arcsec", "0deg"],
        ["3arcsec", "2arcsec", "5"],
    ],
    ids=str,
)
def test_wrong_restoring_beam_is_refused(words):
    with pytest.raises(ValueError, match="restoringbeam = "):
        restoring_beam_words(words)


# ---- writing under the final name only when all is there


def test_products_replace_an_older_set_only_when_complete(tmp_path):
    root = str(tmp_path / "run")
    for product in (".psf", ".image"):
        os.mkdir(root + product)
        (tmp_path / f"run{product}" / "old").touch()
    with pytest.raises(RuntimeError, match="on the way"), new_products(root) as scratch:
        os.mkdir(scratch + ".psf")
        raise RuntimeError("on the way")
    assert sorted(os.listdir(tmp_path)) == ["run.image", "run.psf"]
    assert os.listdir(root + ".psf") == ["old"]
    (tmp_path / "run.sara.json").touch()
    with new_products(root) as scratch:
        os.mkdir(scratch + ".psf")
    assert os.listdir(tmp_path) == ["run.psf"]
    assert os.listdir(root + ".psf") == []
    (tmp_path / "run.sara.json").touch()
    assert existing_products(root) == [root + ".psf", root + ".sara.json"]
    remove_products(root)
    assert existing_products(root) == []


def test_a_name_without_folder_means_this_folder(tmp_path):
    check_imagename("run", (64, 64))
    with new_products("run") as scratch:
        os.mkdir(scratch + ".model")
    assert os.listdir(tmp_path) == ["run.model"]


def test_imagename_that_cannot_be_written_is_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="imagename = 'folder/' is not a name"):
        check_imagename("folder/", (8, 8))
    with pytest.raises(FileNotFoundError, match="the folder 'absent' does not exist"):
        check_imagename("absent/run", (8, 8))
    with pytest.raises(OSError, match=r"imagename = 'run', imsize = .*: the images take [\d.]+ MB, '\.' has"):
        check_imagename("run", (10**7, 10**7))
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(PermissionError, match="cannot be written to"):
        check_imagename("run", (8, 8))


def test_history_lines_as_a_casa_task():
    lines = history_lines("tsara", {"vis": "a.ms", "imsize": [64, 64], "niter": 100})
    assert lines[0] == "taskname=tsara"
    assert lines[1].startswith("version: casa_sara ")
    assert lines[2:] == ['vis         = "a.ms"', "imsize      = [64, 64]", "niter       = 100"]


# ---- start model


def plane_like(plane, shape, scale, shift=(0.0, 0.0)):
    """Return the plane with pixels `scale` times as large, its reference pixel shifted."""
    csys = {**plane.csys, "direction0": dict(plane.csys["direction0"])}
    csys["direction0"]["cdelt"] = plane.csys["direction0"]["cdelt"] * scale
    csys["direction0"]["crpix"] = np.array([n // 2 + s for n, s in zip(shape, shift)], float)
    empty = np.zeros(shape, np.float32)
    return type(plane)(csys, empty, empty == 0, plane.imageinfo, plane.miscinfo)


def test_model_on_the_same_grid_is_read_as_it_is(runs, tmp_path):
    plane = runs("odd, not square, elsewhere").plane
    model = np.random.default_rng(1).normal(size=plane.shape).astype(np.float32)
    write_image(str(tmp_path / "m"), model, plane, unit="Jy/pixel")
    np.testing.assert_array_equal(read_model(str(tmp_path / "m"), plane), model)


@pytest.mark.parametrize("scale", [0.4, 0.77, 1.0, 2.0, 3.3])
def test_model_on_another_grid_keeps_flux_and_place(runs, tmp_path, scale):
    plane = runs("plain").plane
    other = plane_like(plane, (150, 120), scale, shift=(3.25, -2.5))
    model = np.zeros(other.shape, np.float32)
    model[70, 65], model[80:90, 50:58] = 2.0, 0.25
    write_image(str(tmp_path / "m"), model, other, unit="Jy/pixel")
    read = read_model(str(tmp_path / "m"), plane)
    assert read.sum() == pytest.approx(model.sum(), rel=1e-5)
    for axis in (0, 1):
        here, there = np.arange(plane.shape[axis]), np.arange(other.shape[axis])
        middle = other.csys["direction0"]["crpix"][axis]
        place = (model.sum(axis=1 - axis) @ (there - middle) / model.sum()) * scale + plane.shape[axis] // 2
        assert read.sum(axis=1 - axis) @ here / read.sum() == pytest.approx(place, abs=1e-2)
    # an extended source keeps its surface brightness: no holes between pixels cut into parts
    middle = other.csys["direction0"]["crpix"]
    x, y = (round((k - c) * scale + n // 2) for k, c, n in zip((84.5, 53.5), middle, plane.shape))
    if scale > 0.5:
        assert read[x, y] == pytest.approx(0.25 / scale**2, rel=0.25)


def test_model_in_another_frame_stays_on_the_sky(runs, tmp_path):
    import casatools

    j2000, b1950 = runs("plain").plane, runs("field number, B1950").plane
    model = np.zeros(b1950.shape, np.float32)
    model[30, 55] = 1.0
    write_image(str(tmp_path / "m"), model, b1950, unit="Jy/pixel")
    read = read_model(str(tmp_path / "m"), j2000)
    assert read.sum() == pytest.approx(1, rel=1e-6)
    me, one, other = casatools.measures(), casatools.coordsys(), casatools.coordsys()
    one.fromrecord(b1950.csys)
    other.fromrecord(j2000.csys)
    me.doframe(j2000.csys["obsdate"])
    sky = one.toworld([30, 55, 0, 0], "m")["measure"]["direction"]
    lon, lat = (me.measure(sky, "J2000")[axis]["value"] for axis in ("m0", "m1"))
    world = [lon % (2 * np.pi), lat, 1.0, other.referencevalue()["numeric"][3]]
    pixel = other.topixel(world)["numeric"][:2]
    centre = [read.sum(axis=1 - axis) @ np.arange(read.shape[axis]) for axis in (0, 1)]
    np.testing.assert_allclose(centre, pixel, atol=1e-3)


def test_model_beyond_the_image_is_cut_off(runs, tmp_path):
    plane = runs("plain").plane
    model = np.ones((60, 60), np.float32)
    write_image(str(tmp_path / "m"), model, plane_like(plane, (60, 60), 1.0, shift=(0, 70)), unit="Jy/pixel")
    assert read_model(str(tmp_path / "m"), plane).sum() == pytest.approx(60 * 10, rel=1e-6)


def test_masked_pixels_of_a_model_count_as_zero(runs, tmp_path):
    plane = runs("wide, beyond the primary beam").plane
    write_image(str(tmp_path / "m"), np.ones(plane.shape, np.float32), plane, unit="Jy/pixel", masked=True)
    np.testing.assert_array_equal(read_model(str(tmp_path / "m"), plane), plane.mask)


def test_wrong_startmodel_is_refused(runs, name, tmp_path):
    plane = runs("plain").plane
    with pytest.raises(FileNotFoundError, match="startmodel = 'absent.model' does not exist"):
        read_model("absent.model", plane)
    with pytest.raises(ValueError, match="cannot be read as an image"):
        read_model(name, plane)
    pixels = np.zeros(plane.shape, np.float32)
    write_image(str(tmp_path / "beam"), pixels, plane, unit="Jy/beam")
    with pytest.raises(ValueError, match="is in 'Jy/beam': it takes 'Jy/pixel'"):
        read_model(str(tmp_path / "beam"), plane)
    pixels[3, 4] = np.nan
    write_image(str(tmp_path / "nan"), pixels, plane, unit="Jy/pixel")
    with pytest.raises(ValueError, match="not finite"):
        read_model(str(tmp_path / "nan"), plane)


def test_tclean_goes_on_from_our_products(name, runs, tmp_path):
    """A user may clean on: tclean takes our images as its own."""
    import casatasks

    run = runs("plain")
    images = {kind: contents(f"{run.root}.{kind}")["pixels"] for kind in ("psf", "residual", "model")}
    root = str(tmp_path / "on")
    sumwt, beam = contents(run.root + ".sumwt")["pixels"].item(), contents(run.root + ".psf")["beam"]
    write_products(Output(root, restoringbeam=""), run.plane, images, sumwt, beam)
    record = casatasks.tclean(
        vis=name, imagename=root, imsize=list(run.plane.shape), cell="3.0arcsec", niter=20, datacolumn="data",
        calcpsf=False, calcres=False,
    )  # fmt: skip
    assert record["iterdone"] == 20
    assert contents(root + ".model")["pixels"].max() > 0.1


# ---- log


class Terminal:
    """A stream that says whether it is a terminal and keeps what is written."""

    def __init__(self, live):
        self.live, self.text = live, ""

    def isatty(self):
        return self.live

    def write(self, text):
        self.text += text

    def flush(self):
        pass


def test_messages_go_to_the_log(monkeypatch):
    posted = []
    monkeypatch.setattr(log._sink(), "post", lambda *words: posted.append(words), raising=False)
    log.info("one")
    log.warn("two")
    log.error("three")
    assert posted == [("one", "INFO", "casa_sara"), ("two", "WARN", "casa_sara"), ("three", "SEVERE", "casa_sara")]


@pytest.mark.parametrize("live", [False, True])
def test_progress(monkeypatch, live):
    lines, clock, stream = [], iter([0.0, 1.0, 100.0, 101.0, 165.0, 170.0, 4000.0]), Terminal(live)
    monkeypatch.setattr(log, "info", lines.append)
    monkeypatch.setattr(time, "monotonic", lambda: next(clock))
    progress = log.Progress(interval=10, stream=stream)
    progress.prepare("first")
    progress.prepare("second", log=False)
    progress(1, "a", 0.1)
    progress(10, "b", 0.5)  # 0.4 in 64 s: what came before the iterations does not count
    progress(11, "c", 0.6)
    progress(20, "d", 1.0)
    progress.close()
    assert lines == [
        "first; 1 s elapsed",
        "iteration 1: a; 1 min 41 s elapsed",
        "iteration 10: b; 2 min 45 s elapsed, about 1 min 20 s left",
        "iteration 20: d; 1 h 06 min elapsed, about 0 s left",
    ]
    assert stream.text.count("\r") == (6 if live else 0)
    assert ("[############............] iteration 10" in stream.text) == live
    assert stream.text.endswith("\n" if live else "")


def test_progress_of_the_first_image():
    """A line in the log every 3 s, the live line at every iteration, and nothing once the solver iterates."""
    calls, clock = [], iter([0.0, 1.0, 3.5, 3.6, 4.0])
    progress = SimpleNamespace(prepare=lambda message, log: calls.append((message, log)))
    preparing = Preparing(progress, lambda: next(clock))
    for _ in range(3):
        preparing()
    preparing.over = True
    preparing()
    assert calls == [("NNLS iteration 1", False), ("NNLS iteration 2", True), ("NNLS iteration 3", False)]
