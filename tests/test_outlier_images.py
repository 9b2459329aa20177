"""Outliers, small images elsewhere on the sky: operator and prior, what their file may say, and whole runs."""

import os
import shutil

import numpy as np
import pytest

pytest.importorskip("casatools")

from simulated_ms import CYGNUS_A, column, pixels, simulate
from test_visibilities import observation

from casa_sara import saracompare, tsara
from casa_sara.casa.ms.frames import direction_measure, direction_on_sky, rotation_between
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.data.noise import noise_from_differences
from casa_sara.imaging.outliers import with_turns
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.outliers import ImagesDictionary, extents, rotation, stacked
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, Outlier, Selection, SolverOptions, images_in
from casa_sara.private.outlier_file import read_outlier_file
from casa_sara.reconstruction.problem import Samples, averaging_cell
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.reconstruction.state_file import CheckpointError
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.planes import Images
from casa_sara.solver.point_sources import PointSources

ARCSEC = np.pi / 180 / 3600
MAIN, FAR, NORTH = (5.233, 0.711), (5.258, 0.705), (5.23, 0.73)  # rad; 1.1 and 1.1 degrees away
SHAPES = ((24, 20), (16, 12), (10, 30))  # the last is wider than the main image
CELLS = ((1e-4, 1.2e-4), (0.9e-4, 0.8e-4), (1e-4, 1e-4))


def axes(longitude, latitude):
    """East, north and towards a direction, (3, 3)."""
    sin, cos = np.sin, np.cos
    return np.array([[-sin(longitude), cos(longitude), 0],
                     [-sin(latitude) * cos(longitude), -sin(latitude) * sin(longitude), cos(latitude)],
                     [cos(latitude) * cos(longitude), cos(latitude) * sin(longitude), sin(latitude)]])


def grid_of(gridder, places=(FAR, NORTH)):
    direction = [direction_measure("J2000", *place) for place in (MAIN, *places)]
    outliers = tuple(Outlier(str(k), ImageGrid(SHAPES[k], CELLS[k], gridder=gridder),
                             turn=rotation_between(direction[0], direction[k])) for k in range(1, len(direction)))
    return ImageGrid(SHAPES[0], CELLS[0], gridder=gridder, outliers=outliers)


def baselines(count=400, seed=3):
    return np.random.default_rng(seed).uniform(-3500, 3500, (3, count))


def fourier_sum(uvw, images, places=(MAIN, FAR, NORTH)):
    """Σ x exp(2πi b·(s − s_0)) over the pixels of all images, b and s on the celestial sphere."""
    b, vis = axes(*MAIN).T @ uvw, 0
    for image, place, cell in zip(images, places, CELLS):
        x, y = np.indices(image.shape)
        l, m = -(x - image.shape[0] // 2) * cell[0], (y - image.shape[1] // 2) * cell[1]
        s = axes(*place).T @ np.array([l, m, np.sqrt(1 - l**2 - m**2)]).reshape(3, -1) - axes(*MAIN)[2][:, None]
        vis = vis + np.exp(2j * np.pi * (b.T @ s)) @ image.ravel()
    return vis


def skies(rng, dtype=np.float64):
    return [rng.standard_normal(shape).astype(dtype) for shape in SHAPES]


# The operator and the prior ---------------------------------------------------------------------


def test_the_operator_is_the_fourier_sum_of_all_images():
    """With the w-term of each image, to the accuracy asked for."""
    uvw, images = baselines(), skies(np.random.default_rng(0))
    operator = sky_operator(uvw, grid_of("wproject"), eps=1e-9, dtype=np.float64)
    expected = fourier_sum(uvw, images)
    found = operator.forward(stacked(images))
    # the turns to the outliers are kept in single precision
    assert np.linalg.norm(found - expected) < 1e-6 * np.linalg.norm(expected)


def test_without_the_w_term_the_geometry_is_exact_at_the_centres():
    uvw = baselines()
    operator = sky_operator(uvw, grid_of("standard"), eps=1e-9, dtype=np.float64)
    for part in range(3):
        images = [np.zeros(shape) for shape in SHAPES]
        images[part][SHAPES[part][0] // 2, SHAPES[part][1] // 2] = 1
        np.testing.assert_allclose(operator.forward(stacked(images)), fourier_sum(uvw, images), atol=1e-6)


@pytest.mark.parametrize("gridder", ["standard", "wproject"])
def test_adjoint(gridder):
    uvw, rng = baselines(), np.random.default_rng(1)
    weights = rng.uniform(0.5, 2, uvw.shape[1])
    operator = sky_operator(uvw, grid_of(gridder), row_scale=weights, eps=1e-9, dtype=np.float64)
    image, vis = stacked(skies(rng)), rng.standard_normal(400) + 1j * rng.standard_normal(400)
    out = np.full(operator.shape, np.nan)
    assert np.vdot(operator.forward(image), vis).real == pytest.approx(np.vdot(image, operator.adjoint(vis, out)),
                                                                       rel=1e-6)
    beside = np.ones(operator.shape, bool)
    for own in images_in(beside, SHAPES):
        own[...] = False
    assert beside.any() and not out[beside].any()


def test_the_dictionary_is_that_of_each_image():
    rng = np.random.default_rng(2)
    each = [SaraDictionary(shape, ("dirac", "db1", "db3"), 2, np.float64) for shape in SHAPES]
    dictionary, images = ImagesDictionary(each), skies(rng)
    image = stacked(images)
    coefs = dictionary.analysis(image)
    for band, (one, own) in zip(dictionary.bands(), [(one, own) for one, own in zip(each, images)
                                                     for _ in one.bands()]):
        np.testing.assert_array_equal(band.of(coefs), one.analysis(own)[band.slice])
    np.testing.assert_allclose(dictionary.synthesis(coefs), image, atol=1e-12)
    # a step, and the weights
    dual, weights = dictionary.allocate(), dictionary.allocate()
    count = len(dictionary.bands())
    alpha, scale = rng.uniform(0.1, 1, (2, count))
    dictionary.reweight(image, alpha, scale, weights)
    out = dictionary.dual_step(image, dual, 0.3, weights, np.full(dictionary.shape, np.nan), 1.5)
    marked = np.zeros(image.shape, bool)
    marked[SHAPES[0][0] + 3, 5] = True  # of the second image
    dictionary.scale_at(weights, marked, 0.5)
    for k, (one, own, found) in enumerate(zip(each, images, images_in(out, SHAPES))):
        part = slice(k * count // 3, (k + 1) * count // 3)
        w, u = one.reweight(own, alpha[part], scale[part], one.allocate()), one.allocate()
        np.testing.assert_array_equal(found, one.dual_step(own, u, 0.3, w, relaxation=1.5))
        one.scale_at(w, images_in(marked, SHAPES)[k], 0.5)
        for band, other in zip(dictionary.bands()[part], one.bands()):
            np.testing.assert_array_equal(band.of(weights), w[other.slice])
            np.testing.assert_array_equal(band.of(dual), u[other.slice])


def test_images_in_one_array():
    """Where points and pixels of each image are."""
    planes, points = Images(SHAPES), [PointSources([[8, 7]]), PointSources(), PointSources([[3, 20], [4.5, 11]])]
    joined = planes.points(points, None)
    array = np.zeros(np.sum(SHAPES, axis=0)[:1].tolist() + [30])
    joined.project(array + 0, array, array, joined.values(array))
    found = planes.split(joined.pixels(array.shape))
    for own, alone in zip(found, points):
        np.testing.assert_array_equal(own, alone.pixels(own.shape))
    assert [list(place) for place in planes.places(joined)] == [[0], [], [1, 2]]
    planes.set_pixel(array, (2, 3), 1)
    assert array.sum() == 1 and planes.split(array)[1][2, 3] == 1
    each = planes.each(lambda image: image * 0 + image.shape[1], array)
    assert [np.unique(own).tolist() for own in planes.split(each)] == [[20], [12], [30]]
    assert not each[:24, 20:].any()


def test_a_bright_outlier_does_not_hide_that_the_main_image_changes():
    """σ is the larger of that of all and that of the main image, points included; flux and maximum are of the main."""
    rng, uvw = np.random.default_rng(8), baselines()
    operator = sky_operator(uvw, grid_of("standard"))
    dictionary = ImagesDictionary([SaraDictionary(shape, ("dirac", "db1"), 2) for shape in SHAPES])
    sky = stacked(skies(rng, np.float32))
    images_in(sky, SHAPES)[1][8, 6] = 3e4
    ppd = AdaptivePPD(operator, dictionary, operator.forward(sky), np.array([0, 400]), np.ones(400, np.float32), 4e5)
    ppd.planes = planes = Images(SHAPES)
    everywhere = [np.ones(shape, bool) for shape in SHAPES]
    ppd.confine(planes.joined(everywhere))
    ppd.support_only(planes.joined(everywhere), planes.points(
        [PointSources([[9.4, 7.7]]), PointSources([[8.2, 6.1]]), PointSources()], sky.shape))
    ppd.start_from(np.abs(sky))
    ppd.threshold = 0.1
    ppd.penalise(np.ones(1))
    changes = []
    for _ in range(12):
        before = ppd.model.astype(float)
        ppd.step()
        main, model = planes.main(ppd.model).astype(float), ppd.model.astype(float)
        changes.append((np.linalg.norm(model - before) / np.linalg.norm(model),
                        np.linalg.norm(main - planes.main(before)) / np.linalg.norm(main)))
        assert ppd.rel_change == pytest.approx(max(changes[-1]), rel=1e-3)
        assert (ppd.model_flux, ppd.model_max) == pytest.approx((main.sum(), main.max()), rel=1e-4)
    assert all(of_main > of_all for of_all, of_main in changes)


def test_kappa_follows_from_the_main_image():
    """However bright the outlier is."""
    data = observation([(0, 0, 0, 0, 40)])
    data.uvw[:], rng = baselines(400), np.random.default_rng(9)
    grid = grid_of("standard")
    images, thresholds = [np.zeros(shape, np.float32) for shape in SHAPES], []
    images[0][10, 9] = 1
    noise = 0.1 * (rng.standard_normal(400) + 1j * rng.standard_normal(400))
    data.weight[:] = 0.1**-2
    control = Control(lambda ppd, record: thresholds.append(ppd.threshold * ppd.unit_jy))
    for flux in (1, 1000):
        images[1][8, 6] = flux
        data.vis[:] = sky_operator(data.uvw, grid).forward(stacked(images)) + noise
        reconstruct(Samples(data, np.array([0, 400]), np.ones(400), np.ones(1)), grid,
                    SolverOptions(niter=1, wavelevels=1), control=control,
                    support=stacked([np.ones(shape, bool) for shape in SHAPES]))
    assert 0.05 < thresholds[0] < 0.2 and thresholds[1] == pytest.approx(thresholds[0], rel=0.3)


def test_averages_are_made_for_the_farthest_corner():
    """The rms phase of a source there is 0.1 rad along each axis of a full cell."""
    grid = grid_of("standard")
    l, m, depth = extents(grid)
    corners = []
    for place, shape, cell in zip((FAR, NORTH), SHAPES[1:], CELLS[1:]):
        for sign in np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]):
            lm = sign * shape * np.array(cell) / 2
            corners.append(axes(*MAIN) @ axes(*place).T @ [*lm, np.sqrt(1 - lm @ lm)])
    corners = np.abs(np.array(corners) - [0, 0, 1]).max(axis=0)
    np.testing.assert_allclose([l, m, depth], corners, rtol=1e-9)
    np.testing.assert_allclose(averaging_cell(grid)[:3] * [m, l, depth], np.sqrt(6) * 0.1 / (2 * np.pi))


@pytest.mark.parametrize("integrations", [4, 6])
def test_the_noise_is_measured_beside_a_bright_source_far_off(integrations):
    """Its phase changes by a radian from one integration to the next."""
    data = observation([(0, 0, 0, 0, integrations)], baselines=20, channels=30)
    rng, time = np.random.default_rng(5), data.rows.time[data.row]
    data.uvw[:] = rng.uniform(-4000, 4000, (3, 20))[:, data.rows.antenna2[data.row] - 1]
    data.uvw += 0.002 * (time / 10) * np.roll(data.uvw, 1, axis=0)
    outlier = grid_of("standard").outliers[0]
    noise = 3 / np.sqrt(data.weight) * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    turn = rotation(data.uvw, outlier)
    data.vis[:] = noise + 40 + 500 * turn
    offsets = np.array([0, data.size])
    assert noise_from_differences(data, offsets) > 6
    np.testing.assert_allclose(noise_from_differences(data, offsets, turns=[turn]), 3, rtol=0.05)


# What the file may say --------------------------------------------------------------------------


TEXT = """# a comment

imagename = far
nchan=1
imsize=[80, 60]
cell=[8.0arcsec,7arcsec]
phasecenter=J2000 19:58:40.895 +40.55.58.543
mask=circle[[40pix,40pix],10pix]
imagename='north'
phasecenter='J2000 19h58m40.9s +42d55m58s'
usemask=pb
pbmask=0.1
startmodel=old.model
"""


def read(text, **changes):
    with open("out.txt", "w") as file:
        file.write(text)
    return read_outlier_file("out.txt", ImageGrid((128, 100), (1e-5, 1e-5), **changes), "main")


def test_the_file_of_tclean():
    far, north = read(TEXT)
    assert (far.imagename, far.grid.shape, far.grid.mask) == ("far", (80, 60), ("circle[[40pix,40pix],10pix]",))
    np.testing.assert_allclose(far.grid.cell_rad, np.array([8, 7]) * ARCSEC)
    assert (north.imagename, north.grid.shape, north.grid.cell_rad) == ("north", (128, 100), (1e-5, 1e-5))
    assert (north.grid.usemask, north.grid.pbmask, north.startmodel) == ("pb", 0.1, "old.model")
    two, = read("imagename=a\nphasecenter=J2000 1h 2deg\nimsize=50\nmask=['box[[1pix,1pix],[5pix,5pix]]', 'b.mask']")
    assert two.grid.shape == (50, 50) and two.grid.mask == ("box[[1pix,1pix],[5pix,5pix]]", "b.mask")


@pytest.mark.parametrize("line, words", [
    ("deconvolver=hogbom", "line 3.*'deconvolver' is no parameter of an outlier"),
    ("nchan=5", "line 3.*nchan of an outlier is that of the main image"),
    ("specmode=cube", "line 3.*specmode"),
    ("gridder=mosaic", "line 3.*gridder"),
    ("nonsense", "line 3.*name=value"),
    ("imsize=[0,5]", "imsize = .0,5.: should be"),
    ("imsize=[1.5,5]", "imsize = .1.5,5.: should be"),
    ("cell=8furlongs", "cell = '8furlongs'"),
    ("cell=", "line 3.*should have a value"),
    ("imsize=5\nimsize=6", "line 4.*given twice"),
    ("usemask=auto-multithresh", "usemask = 'auto-multithresh'"),
    ("pbmask=x", "could not convert"),
    ("imagename=main\nphasecenter=J2000 1h 2deg", "'main' is that of another image"),
    ("imagename=b", "'b'.*phasecenter is missing"),
    ("imagename=b\nphasecenter=3", "phasecenter = '3': should be a direction"),
    ("imagename=b\nphasecenter=J2000 here there", "not an angle"),
])
def test_what_the_file_may_not_say(line, words):
    with pytest.raises(ValueError, match="(?s)out.txt.*" + words):
        read("imagename=a\nphasecenter=J2000 1h 2deg\n" + line)


def test_files_that_define_nothing():
    with pytest.raises(FileNotFoundError, match="outlierfile = 'absent'"):
        read_outlier_file("absent", ImageGrid((4, 4), (1e-5, 1e-5)), "main")
    with pytest.raises(ValueError, match="defines no image"):
        read("# nothing\n")
    with pytest.raises(ValueError, match="line 1.*the first line should be imagename"):
        read("imsize=5\nimagename=a")


# Whole runs -------------------------------------------------------------------------------------


SIZE, CELL, NOISE = 80, 12.0, 0.02
PLACE = (0.8 * np.pi / 180, 0.3 * np.pi / 180)  # of the outlier, l and m
FLUX, OFFSET = 3.0, np.array([2e-5, -3e-5])  # of the source, and where it is in its image
NEAR = ((0.2, 0.0, 0.0), (0.1, 6e-4, -7e-4))
RUN = dict(imsize=SIZE, cell=f"{CELL}arcsec", datacolumn="data", nthreads=1)


@pytest.fixture(scope="module")
def observed(tmp_path_factory):
    """With the source far off, and without it."""
    folder, names = tmp_path_factory.mktemp("outlier"), {}
    for name, sky in (("both", (*NEAR, (FLUX, *(PLACE + OFFSET)))), ("alone", NEAR)):
        names[name] = simulate(folder / f"{name}.ms", antennas=12, spws=(("1.4GHz", "1MHz", 3),), scans=5,
                               scan_seconds=100, integration=20, hour_angle=-2, spacing_seconds=3000, sky=sky,
                               noise=NOISE)
    return names


def outlier_file(extra="", name="far"):
    """Write the file of an outlier; return its name."""
    l, m = PLACE
    centre = direction_on_sky(CYGNUS_A)
    s = axes(*(centre[axis]["value"] for axis in ("m0", "m1"))).T @ [l, m, np.sqrt(1 - l * l - m * m)]
    ra, dec = np.degrees([np.arctan2(s[1], s[0]), np.arcsin(s[2])]).tolist()
    with open("outliers.txt", "w") as file:
        file.write(f"imagename={name}\nnchan=1\nimsize=[48,40]\ncell=10arcsec\nphasecenter=J2000 {ra!r}deg {dec!r}deg\n"
                   + extra)
    return "outliers.txt"


@pytest.fixture(scope="module")
def solved(observed, tmp_path_factory):
    """The folder of a run with its model column, and what the task returned."""
    folder, here = tmp_path_factory.mktemp("solved"), os.getcwd()
    os.chdir(folder)
    try:
        vis = shutil.copytree(observed["both"], "both.ms")
        result = tsara(vis=vis, imagename="main", outlierfile=outlier_file("mask=circle[[24pix,20pix],9pix]\n"),
                       savemodel="modelcolumn", **RUN)
    finally:
        os.chdir(here)
    return folder, result


def test_a_bright_source_far_off(observed, solved):
    folder, result = solved
    sara = result["sara"]
    # main image
    fluxes = sorted(island["flux_jy"] for island in sara["islands"] if island["snr"] > 20)
    np.testing.assert_allclose(fluxes, [0.1, 0.2], rtol=0.02)
    for block in sara["blocks"]:
        assert 0.9 < block["noise_found"] < 1.15 and 0.9 < block["noise_measured"] < 1.1
    # outlier
    far, = sara["outliers"]
    best = far["islands"][0]
    assert far["model_flux_jy"] == pytest.approx(FLUX, rel=0.01)
    expected = np.array([24, 20]) + OFFSET / ARCSEC / 10 * [-1, 1]
    np.testing.assert_allclose([best["x"], best["y"]], expected, atol=0.1)
    assert result["summaryminor"][1][0][0]["modelFlux"] == [far["model_flux_jy"]]
    model, mask = (pixels(folder / f"far.{kind}") for kind in ("model", "mask"))
    assert model.sum() == pytest.approx(far["model_flux_jy"], rel=1e-5)
    assert 0 < mask.sum() < mask.size and not model[mask == 0].any()
    assert {name.split(".", 1)[1] for name in os.listdir(folder) if name.startswith("far.")} == {
        "psf", "residual", "model", "image", "sumwt", "pb", "mask"}
    # without the file it is ruined
    blind = tsara(vis=observed["both"], imagename="blind", **RUN)["sara"]
    assert min(block["noise_found"] for block in blind["blocks"]) > 5


def test_images_of_the_residual_and_psf_of_an_outlier(solved):
    """Against explicit sums over all samples."""
    folder, _ = solved
    data = read_visibilities(Selection((str(folder / "both.ms"),), datacolumn="data"), "", "I")
    os.chdir(folder)
    far, = read_outlier_file("outliers.txt", ImageGrid((SIZE, SIZE), (CELL * ARCSEC,) * 2), "main")
    grid = with_turns(ImageGrid((SIZE, SIZE), (CELL * ARCSEC,) * 2, outliers=(far,)), data)
    operator = sky_operator(data.uvw, grid, eps=1e-6)
    left = data.vis - operator.forward(stacked([pixels("main.model"), pixels("far.model")]).astype(np.float32))
    weights = data.imaging_weight
    turned = grid.outliers[0].turn @ data.uvw
    for x, y in ((24, 20), (3, 35), (40, 7)):
        l, m = -(x - 24) * 10 * ARCSEC, (y - 20) * 10 * ARCSEC
        fringe = np.exp(-2j * np.pi * (turned[0] * l + turned[1] * m))
        residual = (weights * left * rotation(data.uvw, grid.outliers[0]).conj() * fringe).real.sum() / weights.sum()
        assert pixels("far.residual")[x, y] == pytest.approx(residual, abs=2e-6)
        assert pixels("far.psf")[x, y] == pytest.approx((weights * fringe).real.sum() / weights.sum(), abs=1e-5)


def test_the_model_column_holds_the_outlier(solved):
    folder, _ = solved
    model, data = (column(str(folder / "both.ms"), name) for name in ("MODEL_DATA", "DATA"))
    left = data - model
    assert np.std([left.real, left.imag]) == pytest.approx(NOISE, rel=0.03)


@pytest.mark.slow
def test_restart_goes_on_from_the_models_of_all(solved):
    """Without an iteration the model column is that of the models there are; no main model without the others'."""
    folder, _ = solved
    os.chdir(folder)
    before, files = column("both.ms", "MODEL_DATA"), os.stat("far.model/table.f0").st_mtime_ns
    arguments = dict(vis="both.ms", imagename="main", outlierfile="outliers.txt", restart=True, niter=0, **RUN)
    tsara(savemodel="modelcolumn", **arguments)
    assert os.stat("far.model/table.f0").st_mtime_ns == files
    np.testing.assert_allclose(column("both.ms", "MODEL_DATA"), before, atol=1e-5)
    result = tsara(**arguments)
    assert result["sara"]["outliers"][0]["model_flux_jy"] == pytest.approx(FLUX, rel=0.01)
    with pytest.raises(FileExistsError, match="far.psf"):
        tsara(**arguments | dict(restart=False, imagename="other"))


@pytest.mark.slow
def test_a_run_that_was_stopped_goes_on(observed, monkeypatch):
    """To the same images, for the same outliers only."""
    from casa_sara.runtime import deadline

    arguments = dict(vis=observed["alone"], outlierfile=outlier_file(), **RUN)
    whole = tsara(imagename="whole", **arguments)
    assert whole["sara"]["outliers"][0]["model_flux_jy"] < 0.05
    expected = {name: pixels(name + ".model") for name in ("whole", "far")}
    calls = iter(range(10_000))
    with monkeypatch.context() as patched:
        patched.setattr(deadline.Deadline, "near", lambda self: next(calls) > 200)
        stopped = tsara(imagename="main", **arguments | dict(outlierfile=outlier_file(name="other")))
    assert stopped["stopcode"] == 107
    with pytest.raises(CheckpointError, match="outlierfile"):
        tsara(imagename="main", restart=True, **arguments | dict(outlierfile=outlier_file("pbmask=0.1\n", "other")))
    tsara(imagename="main", restart=True, **arguments | dict(outlierfile=outlier_file(name="other")))
    for name, old in (("main", "whole"), ("other", "far")):
        np.testing.assert_array_equal(pixels(name + ".model"), expected[old])


def test_dry_run_counts_outliers(observed):
    plain, more = (tsara(vis=observed["alone"], imagename="dry", outlierfile=name, dryrun=True, **RUN)["forecast"]
                   for name in ("", outlier_file()))
    assert more["outliers"] == [[48, 40]] and "outliers" not in plain
    planes = [one["memory_bytes"]["iterating"]["wavelet duals and weights"] for one in (plain, more)]
    assert planes[1] / planes[0] == pytest.approx(1 + 48 * 48 / SIZE**2, rel=1e-3)  # 40 pixels are padded to 48


@pytest.mark.parametrize("words, extra", [
    ("overlaps the main image", "imagename=b\nphasecenter=J2000 19h59m28s +40d44m02s\n"),
    ("overlaps that of imagename = 'far'", "imagename=b\nimsize=20\nphasecenter=J2000 20h03m43s +41d01m51s\n"),
    ("beyond the horizon", "imagename=b\nphasecenter=J2000 8h00m00s -40d44m02s\n"),
    ("imagename = 'b': cell=60arcsec is too large", "imagename=b\ncell=60arcsec\nphasecenter=J2000 19h40m28s +40d\n"),
    ("imagename = 'b': imsize = .2, 2.", "imagename=b\nimsize=2\nphasecenter=J2000 19h40m28s +40d\n"),
])
def test_images_that_cannot_be(observed, words, extra):
    with pytest.raises(ValueError, match=f"outlierfile.*{words}"):
        tsara(vis=observed["alone"], imagename="x", outlierfile=outlier_file(extra), **RUN)


@pytest.mark.parametrize("name, value", [
    ("specmode", "cube"), ("gridder", "mosaic"), ("stokes", "Q"), ("method", "dabbech2018"), ("nterms", 2),
    ("spectralindex", "-0.7"), ("sdimage", "tp.image"), ("ndraws", 10), ("jackknife", True), ("report", True),
    ("parallel", True)])
def test_what_outliers_do_not_go_with(observed, name, value):
    with pytest.raises(ValueError, match=f"{name} = .* with outlierfile = 'o.txt'"):
        tsara(vis=observed["alone"], imagename="x", outlierfile="o.txt", **RUN | {name: value})


def test_residuals_are_not_compared_from_the_data(solved):
    folder, _ = solved
    os.chdir(folder)
    with pytest.raises(ValueError, match="models: 'a' was imaged with an outlierfile"):
        saracompare(models=["main", "main"], names=["a", "b"], vis="both.ms", datacolumn="data")
