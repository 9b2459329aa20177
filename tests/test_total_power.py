"""Total power: operator against explicit sums, limits of the block, flux that only a dish measures, what is refused."""

import os
import signal
import tracemalloc

import numpy as np
import pytest
from simulated_ms import SPEED_OF_LIGHT, column, edit, pixels, simulate

from casa_sara import tsara
from casa_sara.casa.images.single_dish import read_dish_image
from casa_sara.casa.runtime import log
from casa_sara.data.visibilities import Visibilities
from casa_sara.demo.single_dish import ARCSEC, dish_image, observe_with_dish
from casa_sara.imaging.run_solver import at_odds
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.single_dish import GaussianBeam, ImagedBeam, Points, SingleDishOperator, Stacked
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction.problem import Problem, Samples
from casa_sara.reconstruction.state_file import CheckpointError
from casa_sara.reconstruction.total_power import MOST, TotalPower
from casa_sara.solver.l2_bounds import AdaptiveBounds
from casa_sara.solver.record import STOPPED_BY_USER

SHAPE, CELL = (60, 50), (1e-5, 1.2e-5)
BEAM = GaussianBeam(1.6e-4, 1.3e-4, 0.5)
CENTRE, FREQ = (299.86875, 40 + 44 / 60 + 2 / 3600), 8.4e9


@pytest.fixture
def points():
    """Two thirds of the points, an odd number."""
    every = Points.within(SHAPE, CELL, BEAM.width)
    kept = np.random.default_rng(0).random(every.size) > 1 / 3
    kept[np.flatnonzero(kept)[0]] ^= np.count_nonzero(kept) % 2 == 0
    return every.only(kept)


def profile(beam, east, north):
    along = east * np.sin(beam.angle) + north * np.cos(beam.angle)
    across = east * np.cos(beam.angle) - north * np.sin(beam.angle)
    return np.exp(-4 * np.log(2) * ((along / beam.major) ** 2 + (across / beam.minor) ** 2))


def explicit(image, places):
    """Σ B(θ_k − θ_p) I_p."""
    l = -(np.arange(SHAPE[0]) - SHAPE[0] // 2)[:, None] * CELL[0]
    m = (np.arange(SHAPE[1]) - SHAPE[1] // 2)[None, :] * CELL[1]
    return np.array([(profile(BEAM, east - l, north - m) * image).sum() for east, north in places.T])


# The operator -----------------------------------------------------------------------------------


def test_a_call_allocates_nothing():
    """Neither of the image nor of the grid of many points, beside the buffers of NumPy."""
    shape, beam = (600, 500), GaussianBeam(5e-5, 5e-5, 0.0)
    operator = SingleDishOperator(Points.within(shape, CELL, beam.width), beam, shape, CELL, np.ones(shape))
    image, vis = np.ones(shape, np.float32), np.empty(operator.size, np.complex64)
    assert vis.nbytes > 200_000

    def both():
        operator.adjoint(operator.forward(image, vis), image)

    both()
    tracemalloc.start()
    both()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < vis.nbytes / 2  # NumPy's buffers take 65 kB of it


@pytest.mark.parametrize("dtype, accuracy", [(np.float64, 1e-6), (np.float32, 2e-6)])
def test_operator_is_the_explicit_sum(points, dtype, accuracy):
    rng = np.random.default_rng(1)
    image, over = rng.random(SHAPE), rng.random(SHAPE) + 0.5
    operator = SingleDishOperator(points, BEAM, SHAPE, CELL, over, 3.0, dtype)
    found = operator.forward(image.astype(dtype)).view(dtype)
    expected = 3 * explicit(over * image, points.places)
    assert points.size % 2 and found.size == points.size + 1 and found[-1] == 0
    assert np.abs(found[:-1] - expected).max() < accuracy * expected.max()


TURN = 0.2


def lopsided(east, north):
    """A beam in its own frame, heavier on one side."""
    return profile(BEAM, east, north) * (1 + 2e3 * east - 1e3 * north)


def imaged(cell=1.5e-5):
    along = (np.arange(101) - 50) * cell
    return ImagedBeam(lopsided(-along[:, None], along[None, :]), (cell, cell), TURN)


def test_an_image_of_the_beam_is_as_good(points):
    """Of one that is not symmetric, in a frame that is turned."""
    image = np.random.default_rng(2).random(SHAPE)
    found = SingleDishOperator(points, imaged(), SHAPE, CELL, dtype=np.float64).forward(image).view(float)[:-1]
    l = -(np.arange(SHAPE[0]) - SHAPE[0] // 2)[:, None] * CELL[0]
    m = (np.arange(SHAPE[1]) - SHAPE[1] // 2)[None, :] * CELL[1]
    expected = []
    for east, north in points.places.T:
        there = east - l, north - m
        own = (there[0] * np.cos(TURN) - there[1] * np.sin(TURN), there[0] * np.sin(TURN) + there[1] * np.cos(TURN))
        expected.append((lopsided(*own) * image).sum())
    assert np.abs(found - expected).max() < 1e-6 * max(expected)
    assert imaged().width == pytest.approx(BEAM.width, rel=0.05)


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_adjoint(points, dtype, tolerance):
    """Of the dish alone, and after visibilities."""
    rng = np.random.default_rng(3)
    image, over = rng.standard_normal(SHAPE).astype(dtype), rng.random(SHAPE) + 0.5
    dish = SingleDishOperator(points, imaged(), SHAPE, CELL, over, 1.0, dtype)
    uv = rng.uniform(-0.4, 0.4, (2, 40)) / max(CELL)
    for operator in (dish, Stacked(MeasurementOperator(uv, CELL, SHAPE, eps=1e-6, dtype=dtype), dish)):
        vis = (rng.standard_normal(operator.size) + 1j * rng.standard_normal(operator.size)).astype(
            operator.complex_dtype)
        there, back = operator.forward(image), operator.adjoint(vis)
        size = np.linalg.norm(there) * np.linalg.norm(vis)
        assert abs(np.vdot(there, vis).real - float(np.vdot(image, back))) < tolerance * size


# The block --------------------------------------------------------------------------------------


def samples_with(points):
    rng = np.random.default_rng(4)
    uv = rng.uniform(-0.4, 0.4, (2, 900)) / max(CELL)
    data = Visibilities(vis=np.ones(900, np.complex64), weight=np.full(900, 2.0, np.float32),
                        imaging_weight=np.full(900, 2.0, np.float32), uvw=np.vstack([uv, np.zeros(900)]),
                        row=np.zeros(900, np.int32), chan=np.zeros(900, np.int16), rows=None)
    dish = TotalPower(explicit(np.ones(SHAPE), points.places), points, BEAM, CELL)
    return Samples(data, np.array([0, 900]), np.full(900, 4.0, np.float32), total_power=dish)


def test_the_block_counts_as_agreed_and_steps_stay(points):
    """Its response to a pixel is MOST of that of the visibilities, and it does not raise ‖U^½Φ‖² beyond twice."""
    grid, options = ImageGrid(SHAPE, CELL), SolverOptions(averaging=False)
    samples = samples_with(points)
    problem = Problem.of(samples, grid, options, 1.0, 1e-6)
    image = np.zeros(SHAPE, np.float32)
    x, y = np.rint(points.pixels(SHAPE, CELL)[:, points.size // 2]).astype(int)
    image[x, y] = 1
    seen = problem.measurement.forward(image)
    assert np.linalg.norm(seen[:900]) ** 2 == pytest.approx(1800, rel=1e-3)
    assert np.linalg.norm(seen[900:]) ** 2 == pytest.approx(MOST * 1800, rel=0.3)
    samples.total_power = None
    alone = Problem.of(samples, grid, options, 1.0, 1e-6)
    assert alone.data_norm_sq < problem.data_norm_sq < 2.1 * alone.data_norm_sq
    # units of the image make no difference
    other = Problem.of(samples_with(points), grid, options, 0.01, 1e-6)
    assert other.data_norm_sq == pytest.approx(1e-4 * problem.data_norm_sq, rel=0.02)


def test_noise_of_the_dish_alone():
    """What the best image leaves of it tells how large it is, with signal and without."""
    beam = GaussianBeam(6e-5, 6e-5)
    points = Points.within(SHAPE, CELL, beam.width)
    points = points.only(np.all(np.abs(points.places) < 0.5 * np.multiply(SHAPE, CELL)[:, None] - 4.5e-5, axis=0))
    noise = 0.7 * np.random.default_rng(5).standard_normal(points.size)
    seen = SingleDishOperator(points, beam, SHAPE, CELL).forward(np.ones(SHAPE)).view(np.float32)[:points.size]
    for brightness in (0.0, 300.0):
        power = TotalPower(brightness * seen / seen.max() + noise, points, beam, CELL)
        block = power.whitened(SHAPE, 1.0, 1.0, 1)
        rms = block.noise_norm(True, None) / np.sqrt(2 * block.vis.size) / block.scale
        assert 0.2 < rms < 1.4


def test_a_limited_block_never_counts_more():
    """Whatever its noise, and as the noise of the others rises."""
    bounds = AdaptiveBounds(np.array([1e3, 1e-3]), np.array([500, 50]), np.array([100.0, 3.0]), 9,
                            most=np.array([np.inf, 0.03]))
    weights = bounds.noise_weights * bounds.weight_sums
    assert weights[1] == pytest.approx(0.03 * weights[0])
    free = AdaptiveBounds(np.array([1e3, 1e-3]), np.array([500, 50]), np.array([100.0, 3.0]), 9)
    assert free.l2_bounds[1] == 1e-3


# Images of dishes -------------------------------------------------------------------------------


def gaussian(fwhm, size=256, cell=1.5):
    along = (np.arange(size) - size // 2) * cell
    sky = np.exp(-4 * np.log(2) * (along[:, None] ** 2 + along[None, :] ** 2) / fwhm**2)
    return sky / sky.sum()


def test_images_in_kelvin_and_masked_ones_are_read(tmp_path):
    rng, beam = np.random.default_rng(6), 60.0
    brightness = rng.random((20, 24))
    name = dish_image(tmp_path / "k.im", brightness, 10.0, CENTRE, beam, FREQ, "K")
    factor = 2 * 1.380649e-23 * FREQ**2 / SPEED_OF_LIGHT**2 * 1e26 * np.pi / (4 * np.log(2)) * (beam * ARCSEC) ** 2
    np.testing.assert_allclose(read_dish_image(name).pixels, factor * brightness, rtol=1e-5)
    from casa_sara.casa.runtime.tools import opened

    with opened("image", name) as ia:
        ia.calcmask(f"'{name}' > 0.5", name="mask0")
    found = read_dish_image(name).pixels
    np.testing.assert_array_equal(np.isfinite(found), brightness > 0.5)


def test_a_fits_file_in_galactic_coordinates_is_at_its_place(tmp_path):
    """Brightness, and the angle of its north, against astropy."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.io import fits
    from astropy.wcs import WCS

    middle = SkyCoord(*CENTRE, unit="deg", frame="fk5").galactic
    header = fits.Header(dict(
        CTYPE1="GLON-SIN", CTYPE2="GLAT-SIN", CTYPE3="FREQ", CRVAL1=middle.l.deg, CRVAL2=middle.b.deg, CRVAL3=FREQ,
        CRPIX1=31.0, CRPIX2=29.0, CRPIX3=1.0, CDELT1=-15 / 3600, CDELT2=15 / 3600, CDELT3=1e6, CUNIT1="deg",
        CUNIT2="deg", CUNIT3="Hz", BUNIT="Jy/beam", BMAJ=0.03, BMIN=0.025, BPA=20.0))
    source = SkyCoord(CENTRE[0] + 0.03, CENTRE[1] - 0.02, unit="deg", frame="fk5")

    def brightness(directions):
        return np.exp(-4 * np.log(2) * (directions.separation(source).deg / 0.03) ** 2)

    y, x = np.indices((60, 64))
    there = SkyCoord(*WCS(header).celestial.pixel_to_world_values(x, y), unit="deg", frame="galactic").fk5
    fits.writeto(tmp_path / "gal.fits", brightness(there)[None].astype(np.float32), header)
    image = read_dish_image(str(tmp_path / "gal.fits"))
    assert image.freq_hz == pytest.approx(FREQ)
    plane = read_dish_image(dish_image(tmp_path / "j2000.im", np.zeros((80, 70)), 6.0, CENTRE, 90.0, FREQ)).plane
    px, py = (axis.ravel().astype(float) for axis in np.indices((80, 70)))
    found = image.at(plane, px, py)
    sky = WCS(naxis=2)
    sky.wcs.ctype, sky.wcs.crval, sky.wcs.crpix = ["RA---SIN", "DEC--SIN"], list(CENTRE), [41, 36]
    sky.wcs.cdelt = [-6 / 3600, 6 / 3600]
    expected = brightness(SkyCoord(*sky.pixel_to_world_values(px, py), unit="deg", frame="fk5"))
    assert np.isfinite(found).all() and np.abs(found - expected).max() < 1e-2
    beyond = SkyCoord(middle.l, middle.b + 0.01 * u.deg, frame="galactic").fk5
    angle = SkyCoord(*CENTRE, unit="deg", frame="fk5").position_angle(beyond).rad
    assert np.angle(np.exp(1j * (image.turn(plane) - angle))) == pytest.approx(0, abs=2e-3)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("dishes")


@pytest.fixture(scope="module")
def extended(folder):
    """The MeasurementSet of a Gaussian of 1 Jy and 40 arcsec, of which the baselines see little."""
    name = simulate(folder / "a.ms", configuration="d", antennas=12, spws=(("8.4GHz", "2MHz", 1),), scans=3,
                    integration=20.0, noise=0.02)
    uv_sq = np.square(column(name, "UVW")[:2] * FREQ / SPEED_OF_LIGHT).sum(axis=0)
    vis = np.exp(-((np.pi * 40 * ARCSEC) ** 2) / (4 * np.log(2)) * uv_sq)
    rng = np.random.default_rng(7)
    edit(name, "DATA", lambda old: vis + 0.02 * (rng.standard_normal(old.shape) + 1j * rng.standard_normal(old.shape)))
    return name


@pytest.fixture(scope="module")
def dish(folder):
    return observe_with_dish(folder / "dish.im", gaussian(40.0), 1.5, CENTRE, 90.0, FREQ, 0.003, width=600.0)


OPTIONS = dict(imsize=[180, 160], cell="2.4arcsec", datacolumn="data", uvrange=">4klambda", nthreads=1)


def sky_of(name):
    return np.divide(pixels(name + ".model"), pixels(name + ".pb"), out=np.zeros(OPTIONS["imsize"]),
                     where=pixels(name + ".pb") > 0)


def test_flux_that_only_the_dish_measures(extended, dish, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = tsara(vis=extended, imagename="with", sdimage=dish, **OPTIONS)
    sky = sky_of("with")
    assert sky.sum() == pytest.approx(1.0, abs=0.03)
    x = (np.arange(180) - 90) * 2.4
    assert np.sqrt(8 * np.log(2) * (sky.sum(axis=1) @ x**2) / sky.sum()) == pytest.approx(40.0, abs=4)
    power = result["sara"]["total_power"]
    assert power["residual_jy_per_beam"] < 0.005 and power["points"] > 30
    assert len(result["sara"]["blocks"]) == len(result["sara"]["bounds"][-1]["l2_bounds"])


@pytest.mark.slow
def test_gain_and_beam_image(extended, dish, folder, tmp_path, monkeypatch):
    """sdgain = 2 of half the brightness, with an image of the beam, is the same sky; without it much is missing."""
    monkeypatch.chdir(tmp_path)
    tsara(vis=extended, imagename="without", **OPTIONS)
    assert sky_of("without").sum() < 0.7
    tsara(vis=extended, imagename="plain", sdimage=dish, **OPTIONS)
    image = read_dish_image(dish)
    step = image.plane.cell_rad[0] / ARCSEC
    half = dish_image("half.im", 0.5 * image.pixels, step, CENTRE, 0, FREQ)
    along = (np.arange(61) - 30) * step
    beam = np.exp(-4 * np.log(2) * (along[:, None] ** 2 + along[None, :] ** 2) / 90.0**2)
    psf = dish_image("psf.im", beam, step, CENTRE, 0, FREQ)
    tsara(vis=extended, imagename="gain", sdimage=half, sdpsf=psf, sdgain=2.0, **OPTIONS)
    one, other = sky_of("plain"), sky_of("gain")
    assert np.linalg.norm(one - other) < 0.05 * np.linalg.norm(one)
    assert other.sum() == pytest.approx(one.sum(), abs=0.01)
    # a wrong gain is told where the baselines overlap with the dish
    for gain, told in ((1.0, False), (1.5, True)):
        power = tsara(vis=extended, imagename="odd", sdimage=dish, sdgain=gain, overwrite=True,
                      **OPTIONS | dict(uvrange=""))["sara"]["total_power"]
        assert told == at_odds(power)


@pytest.mark.slow
def test_restart_goes_on_to_the_same_sky(extended, dish, folder, tmp_path, monkeypatch):
    """Stopped in the middle, to the last bit; with another image of the dish it is refused."""
    monkeypatch.chdir(tmp_path)
    options = OPTIONS | dict(vis=extended, sdimage=dish, niter=120)
    tsara(imagename="once", **options)

    class Progress(log.Progress):
        def __call__(self, iteration, *others):
            if iteration == 70:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(log, "Progress", Progress)
        assert tsara(imagename="twice", **options)["stopcode"] == STOPPED_BY_USER
    with pytest.raises(CheckpointError, match="sdimage differ"):
        tsara(imagename="twice", restart=True, **options | dict(sdgain=1.1))
    assert tsara(imagename="twice", restart=True, **options)["sara"]["resumed"] == [70]
    np.testing.assert_array_equal(pixels("twice.model"), pixels("once.model"))


@pytest.mark.slow
def test_points_are_where_image_and_dish_overlap(extended, folder, tmp_path):
    """Half of the sky is masked in the image of the dish: half of the points are left."""
    whole = observe_with_dish(folder / "whole.im", gaussian(40.0), 1.5, CENTRE, 90.0, FREQ, width=600.0)
    image = read_dish_image(whole)
    values = image.pixels.copy()
    values[:values.shape[0] // 2] = np.nan
    part = dish_image(folder / "part.im", values, image.plane.cell_rad[0] / ARCSEC, CENTRE, 90.0, FREQ)
    counts = [tsara(vis=extended, imagename=str(tmp_path / "x"), sdimage=name, niter=1, overwrite=True, **OPTIONS)
              ["sara"]["total_power"]["points"] for name in (whole, part)]
    assert 0.3 * counts[0] < counts[1] < 0.6 * counts[0]


@pytest.mark.parametrize("change, message", [
    (dict(unit="K", beam=0), "sdimage = .* is in 'K': should be in 'Jy/beam', or in 'K'; K needs a beam"),
    (dict(unit="Jy/pixel"), "sdimage = .* is in 'Jy/pixel': should be in 'Jy/beam'"),
    (dict(beam=0), "sdimage = .* has no beam in its header: should have one .* or sdpsf"),
    (dict(freq_hz=8.9e9), "sdimage = .* is of 8.9 GHz, the image of 8.4[0-9]* GHz: should be within 2 %"),
    (dict(beam=4.0, cell=1.0), "sdimage = .* has a beam of 4 arcsec, the finest fringe of vis is .* should be wider"),
    (dict(cell=60.0), "sdimage = .* has pixels of 60 arcsec and a beam of 90 arcsec: should have two pixels"),
    (dict(centre=(290.0, 40.0)), "sdimage = .* and sdimage holds 0 of these: should be at least 4")])
def test_images_that_cannot_serve_are_refused(extended, tmp_path, change, message):
    arguments = dict(cell=12.0, centre=CENTRE, beam=90.0, freq_hz=FREQ, unit="Jy/beam") | change
    name = dish_image(tmp_path / "wrong.im", np.ones((40, 40)), **arguments)
    with pytest.raises(ValueError, match=message):
        tsara(vis=extended, imagename=str(tmp_path / "no"), sdimage=name, niter=0, **OPTIONS)
    assert os.listdir(tmp_path) == ["wrong.im"]


@pytest.mark.parametrize("parameters, message", [
    (dict(specmode="cube"), "specmode = 'cube' with sdimage"), (dict(parallel=True), "parallel = True with sdimage"),
    (dict(ndraws=20), "ndraws = 20 with sdimage"), (dict(jackknife=True), "jackknife = True with sdimage"),
    (dict(databound="weights"), "databound = 'weights' with sdimage"),
    (dict(method="dabbech2018"), "method = 'dabbech2018' with sdimage"),
    (dict(stokes="V", positivity=False), "stokes = 'V' with sdimage"),
    (dict(nterms=2), "nterms = 2 with sdimage"),
    (dict(spectralindex="-0.7"), "spectralindex = '-0.7' with sdimage"), (dict(sdgain=-1.0), "sdgain = -1.0: should"),
    (dict(sdimage="", sdgain=2.0), "sdgain = 2.0 has no effect with sdimage = ''"),
    (dict(sdimage="absent.im"), "sdimage = 'absent.im' does not exist")])
def test_what_total_power_cannot_do_is_refused(extended, dish, tmp_path, parameters, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        tsara(vis=extended, imagename=str(tmp_path / "no"), niter=0, **OPTIONS | dict(sdimage=dish) | parameters)
    assert not os.listdir(tmp_path)


def test_a_gap_between_dish_and_baselines_is_noted(extended, dish, tmp_path):
    for uvrange, noted in ((">4klambda", True), ("", False)):
        result = tsara(vis=extended, imagename=str(tmp_path / "gap"), sdimage=dish, niter=0, overwrite=True,
                       **OPTIONS | dict(uvrange=uvrange))
        assert noted == any("nothing measures the scales between" in note for note in result["sara"]["notes"])
