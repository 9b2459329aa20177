"""Mosaics: operator against explicit sums, beams and weights against Airy patterns and tclean, sources recovered."""

import json
import os
import signal

import numpy as np
import pytest
from simulated_mosaic import ARCSEC, CENTRE, direction, predict, simulate_mosaic, voltage
from simulated_ms import column, edit, pixels, simulate

from casa_sara.operators.beams import Beam, Mosaic, mosaic_density
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.mosaic import MosaicOperator, remaining_w_phase
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, Selection, Spectrum

pytestmark = pytest.mark.usefixtures("every_thread")

SHAPE, CELL = (90, 74), (1e-5, 1.3e-5)
SQUARES = np.linspace(0, 1, 4097)
HEXAGON = [(0, 0), (30, 0), (-15, 26), (-15, -26), (15, 26), (15, -26), (-30, 0)]  # arcsec, half a beam apart
NEAR_CENTRE = f"circle[[{CENTRE[0]}deg, {CENTRE[1]}deg], 8arcsec]"
AT_CENTRE = f"J2000 {CENTRE[0]}deg {CENTRE[1]}deg"


def profile(steepness):
    return (np.exp(-3 * steepness * SQUARES) * (1 - SQUARES)).astype(np.float64)


BEAMS = tuple(Beam(centre, radius, profile(steepness)) for centre, radius, steepness in (
    ((30.3, 20.1), 3e-4, 1.0), ((30.3, 20.1), 2.2e-4, 1.3), ((60.7, 50.2), 3e-4, 1.0), ((-5.0, 80.0), 4e-4, 0.7)))


@pytest.fixture(scope="module")
def samples():
    """uvw in wavelengths with w as large as u and v, and the beam of each sample."""
    rng = np.random.default_rng(1)
    return rng.uniform(-0.4, 0.4, (3, 300)) / max(CELL), rng.integers(0, len(BEAMS), 300)


def attenuation(beam):
    """The beam on the pixels, written anew."""
    x, y = np.indices(SHAPE)
    square = ((x - beam.centre[0]) * CELL[0]) ** 2 + ((y - beam.centre[1]) * CELL[1]) ** 2
    return np.interp(square / beam.radius_rad**2, SQUARES, beam.profile, right=0)


def explicit(image, uvw, beam_of_sample):
    """V_m = Σ A I exp(2πi[ul + vm + w(n − 1)])."""
    l = -(np.arange(SHAPE[0]) - SHAPE[0] // 2)[:, None] * CELL[0]
    m = (np.arange(SHAPE[1]) - SHAPE[1] // 2)[None, :] * CELL[1]
    depth = np.sqrt(1 - l**2 - m**2) - 1
    seen = [attenuation(beam) * image for beam in BEAMS]
    return np.array([(seen[number] * np.exp(2j * np.pi * (u * l + v * m + w * depth))).sum()
                     for number, (u, v, w) in zip(beam_of_sample, uvw.T)])


# The operator -----------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype, eps", [(np.float64, 1e-10), (np.float32, 1e-6)])
@pytest.mark.parametrize("wide", [False, True])
def test_operator_is_the_explicit_sum(samples, dtype, eps, wide):
    """To its accuracy without w; with it, to what is left of second order around each pointing."""
    uvw, beam_of_sample = samples
    uvw = uvw if wide else uvw * [[1], [1], [0]]
    image = np.random.default_rng(2).standard_normal(SHAPE)
    scale = np.random.default_rng(3).uniform(0.5, 2, uvw.shape[1])
    operator = MosaicOperator(uvw, beam_of_sample, Mosaic(SHAPE, CELL, BEAMS), scale, eps, dtype, nthreads=2)
    found, expected = operator.forward(image.astype(dtype)), scale * explicit(image, uvw, beam_of_sample)
    phase = remaining_w_phase(np.abs(uvw[2]).max(), Mosaic(SHAPE, CELL, BEAMS))
    error = np.linalg.norm(found - expected) / np.linalg.norm(expected)
    assert error < (0.2 * phase if wide else 3 * eps) and (not wide or 1e-4 < phase < 0.1)


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_adjoint(samples, dtype, tolerance):
    uvw, beam_of_sample = samples
    mosaic = Mosaic(SHAPE, CELL, BEAMS)
    mosaic = mosaic.flat(mosaic.sensitivity(np.bincount(beam_of_sample)))
    operator = MosaicOperator(uvw, beam_of_sample, mosaic, None, 1e-6, dtype, nthreads=2)
    rng = np.random.default_rng(4)
    image = rng.standard_normal(SHAPE).astype(dtype)
    vis = (rng.standard_normal(uvw.shape[1]) + 1j * rng.standard_normal(uvw.shape[1])).astype(operator.complex_dtype)
    forward, adjoint = operator.forward(image), operator.adjoint(vis)
    one, other = np.vdot(forward, vis).real, float(np.vdot(image, adjoint))
    assert abs(one - other) < tolerance * np.linalg.norm(forward) * np.linalg.norm(vis)
    # a second call, in space that the first one has used
    np.testing.assert_array_equal(operator.forward(image, np.full_like(forward, 7)), forward)
    np.testing.assert_array_equal(operator.adjoint(vis, np.full_like(adjoint, 7)), adjoint)


def test_one_pointing_in_flat_noise_is_the_plain_operator(samples):
    """Of a beam whose end is beyond the image the sensitivity is the beam itself, and drops out."""
    uvw = samples[0] * [[1], [1], [0]]
    mosaic = Mosaic(SHAPE, CELL, (Beam((40.0, 30.0), 2e-3, profile(0.5)),))
    number = np.zeros(uvw.shape[1], int)
    flat = mosaic.flat(mosaic.sensitivity([5.0]))
    image = np.random.default_rng(5).standard_normal(SHAPE).astype(np.float32)
    plain = MeasurementOperator(uvw[:2], CELL, SHAPE)
    np.testing.assert_allclose(MosaicOperator(uvw, number, flat).forward(image), plain.forward(image), atol=2e-4)


def test_columns_of_flat_noise_are_alike(samples):
    """Every pixel that is seen has the norm √(Σ weight): what the solver takes for granted."""
    uvw, beam_of_sample = samples
    scale = np.random.default_rng(6).uniform(0.5, 2, uvw.shape[1])
    mosaic = Mosaic(SHAPE, CELL, BEAMS)
    sensitivity = mosaic.sensitivity(np.bincount(beam_of_sample, scale**2))
    operator = MosaicOperator(uvw, beam_of_sample, mosaic.flat(sensitivity), scale)
    for place in ((30, 20), (45, 37), (62, 49), (0, 73), (89, 0)):
        image = np.zeros(SHAPE, np.float32)
        image[place] = 1
        norm_sq = np.linalg.norm(operator.forward(image)) ** 2
        expected = (scale**2).sum() if sensitivity[place] > 0 else 0.0
        assert norm_sq == pytest.approx(expected, rel=1e-4)
    assert 0 < np.count_nonzero(sensitivity) < sensitivity.size
    expected = attenuation(BEAMS[0]) ** 2 + 2 * attenuation(BEAMS[2]) ** 2
    np.testing.assert_allclose(mosaic.power([1.0, 0.0, 2.0, 0.0]), expected, atol=1e-5)


def test_mosaic_of_a_sky_with_spectral_indices(samples):
    uvw, beam_of_sample = samples
    uvw, rng = uvw * [[1], [1], [0]], np.random.default_rng(7)
    freq_hz = rng.uniform(1e9, 1.3e9, uvw.shape[1])
    index, image = rng.uniform(-1, 1, SHAPE), rng.standard_normal(SHAPE).astype(np.float32)
    grid = ImageGrid(SHAPE, CELL, gridder="mosaic", spectrum=Spectrum(index, 1.1e9), mosaic=Mosaic(SHAPE, CELL, BEAMS))
    found = sky_operator(uvw, grid, freq_hz, beam=beam_of_sample).forward(image)
    for k in range(0, uvw.shape[1], 29):
        sky = image * (freq_hz[k] / 1.1e9) ** index
        expected = explicit(sky, uvw[:, k : k + 1], beam_of_sample[k : k + 1])[0]
        assert abs(found[k] - expected) < 1e-3


def test_density_counts_what_overlaps():
    """Of one beam it is the weight in the cell and its conjugate; pointings apart do not add to each other."""
    apart = Mosaic((128, 64), (1e-5, 1e-5), tuple(Beam((x, 32.0), 2.5e-4, profile(1.0)) for x in (30.0, 98.0)))
    u = np.array([100.0, 110.0, -100.0, 9000.0])
    uvw, weight = np.array([u, u / 2, 0 * u]), np.array([1.0, 2.0, 4.0, 8.0])
    one = mosaic_density(uvw, np.zeros(4, int), weight, Mosaic((128, 64), (1e-5, 1e-5), apart.beams[:1]))
    np.testing.assert_allclose(one, [7, 7, 7, 8], rtol=1e-6)
    both = mosaic_density(np.tile(uvw, 2), np.repeat([0, 1], 4), np.tile(weight, 2), apart)
    np.testing.assert_allclose(both, np.tile([7, 7, 7, 8], 2), rtol=0.05)
    same = Mosaic((128, 64), (1e-5, 1e-5), apart.beams[:1] * 2)
    together = mosaic_density(np.tile(uvw, 2), np.repeat([0, 1], 4), np.tile(weight, 2), same)
    np.testing.assert_allclose(together, np.tile([14, 14, 14, 16], 2), rtol=1e-5)
    # in part: as much as the rows of the flat operator have in common
    partly = Mosaic(SHAPE, CELL, BEAMS[:2])
    first, second = map(attenuation, BEAMS[:2])
    power = (first**2 + second**2) / 2
    inner, outer = (float((one * other)[power > 0] @ (1 / power[power > 0])) for one, other in (
        (first, first), (first, second)))
    mean = np.array([inner, outer]) / np.count_nonzero(power)
    uvw, weight = np.zeros((3, 4)), np.array([1.0, 2.0, 4.0, 8.0])
    found = mosaic_density(uvw, np.array([0, 0, 1, 1]), weight / [3, 3, 12, 12], partly)
    assert 0.2 < mean[1] < 0.9 * mean[0]
    np.testing.assert_allclose(found[0], mean.sum(), rtol=0.02)


def test_a_beam_outside_the_image_is_refused(samples):
    far = Mosaic(SHAPE, CELL, (Beam((500.0, 20.0), 3e-4, profile(1.0)),))
    with pytest.raises(ValueError, match="beam 0, around pixel .* is outside the image"):
        MosaicOperator(samples[0], np.zeros(300, int), far)


# Beams of data ----------------------------------------------------------------------------------

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.images.primary_beams import primary_beams
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.runtime import log
from casa_sara.reconstruction.draws import read_draws
from casa_sara.solver.record import STOPPED_BY_USER

GRID = dict(imsize=[240, 216], cell="0.9arcsec", gridder="mosaic", phasecenter=AT_CENTRE, datacolumn="data")
SKY = [(0.3, 0.0, 0.0), (0.25, 22 * ARCSEC, 13.5 * ARCSEC), (1.0, -52.5 * ARCSEC, -43.3 * ARCSEC),
       (0.25, 15 * ARCSEC, -26 * ARCSEC)]
DISHES = (12.0,) * 8 + (7.0,) * 4


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("mosaic")


@pytest.fixture(scope="module")
def mixed(folder):
    """Seven pointings, four rounds of them, dishes of 12 m and 7 m: four point sources."""
    return simulate_mosaic(folder / "mixed.ms", HEXAGON, SKY, dishes=DISHES, noise=0.15, rounds=4, spread=45.0,
                           hours=4.0)


def seen_by(pair, freq_hz, place, pointing):
    """A of a pair of dishes, written with the simulation's patterns; places in arcsec."""
    angle = np.hypot(place[0] - pointing[0], place[1] - pointing[1]) * ARCSEC
    return voltage(angle, pair[0], freq_hz) * voltage(angle, pair[1], freq_hz)


def test_beams_are_the_products_of_airy_patterns(folder):
    spws = (("100GHz", "10MHz", 2), ("101.5GHz", "10MHz", 1), ("110GHz", "10MHz", 1))
    name = simulate_mosaic(folder / "bands.ms", HEXAGON[:3], [(1.0, 0, 0)], dishes=(12.0, 12.0, 7.0, 7.0), spws=spws)
    grid = ImageGrid((200, 180), (ARCSEC, ARCSEC), AT_CENTRE, gridder="mosaic")
    data = read_visibilities(Selection((name,), datacolumn="data"), AT_CENTRE, frequencies=True)
    found = primary_beams(data, Selection((name,)), grid)
    profiles, beams, of_sample = found.profiles, found.beams, found.beam_of_sample
    assert len(profiles.kinds) == 6 and len(beams) == 18  # the first two windows are within 2 %
    assert all(words in found.words for words in ("3 pointings", "POINTING is not used", "7 m with 7 m"))
    np.testing.assert_allclose(found.centres, [[100 - x, 90 + y] for x, y in HEXAGON[:3]], atol=1e-4)
    diameters = np.array([12.0, 12.0, 7.0, 7.0])
    rows = data.rows
    for k in range(0, data.size, 7):
        row = data.row[k]
        pointing, number = beams[of_sample[k]]
        assert pointing == rows.field[row]
        radius, values = profiles.radii[number], profiles.values[number]
        pair = diameters[[rows.antenna1[row], rows.antenna2[row]]]
        freq = data.freq_hz[k] if data.freq_hz[k] > 105e9 else data.freq_hz[data.freq_hz < 105e9].astype(float).mean()
        distance = radius * np.sqrt(np.linspace(0, 1, values.size))
        expected = voltage(distance, pair[0], freq) * voltage(distance, pair[1], freq)
        np.testing.assert_allclose(values, expected, atol=3e-3)
        assert values[0] == 1 and values[-1] < 1e-4


def test_pb_and_weight_are_of_beams_and_near_tcleans(mixed, tmp_path, monkeypatch):
    """Exact sums of squared patterns; tclean's, of sampled convolution functions, are a per cent from them."""
    import casatasks

    monkeypatch.chdir(tmp_path)
    tsara(vis=mixed, imagename="ours", niter=0, pblimit=0.1, **GRID)
    casatasks.tclean(vis=mixed, imagename="theirs", niter=0, pblimit=0.1, restoration=False, **GRID)
    pb, weight = pixels("ours.pb"), pixels("ours.weight")
    good = pb > 0.1
    np.testing.assert_allclose(pb[good], np.sqrt(weight / weight.max())[good], rtol=1e-5)
    # by hand at some places
    field, sigma = column(mixed, "FIELD_ID"), column(mixed, "SIGMA")[0]
    ends = np.array(DISHES)[np.stack([column(mixed, "ANTENNA1"), column(mixed, "ANTENNA2")])]
    for place in ((120, 108), (150, 90), (70, 120), (120, 150)):
        sky = (120 - place[0]) * 0.9, (place[1] - 108) * 0.9
        total = 0.0
        for k, pointing in enumerate(HEXAGON):
            for one, other in ((12.0, 12.0), (12.0, 7.0), (7.0, 7.0)):
                here = (field == k) & (ends.max(axis=0) == one) & (ends.min(axis=0) == other)
                total += (sigma[here] ** -2).sum() * seen_by((one, other), 100.01e9, sky, pointing) ** 2
        assert weight[place] == pytest.approx(total / (sigma**-2).sum(), abs=3e-4)
    assert pixels("ours.sumwt")[0, 0] == pytest.approx(pixels("theirs.sumwt")[0, 0], rel=1e-6)
    both = good & (pixels("theirs.pb") > 0)
    assert np.abs(pb - pixels("theirs.pb"))[both].max() < 0.02
    assert np.abs(weight - pixels("theirs.weight"))[both].max() < 0.02 * weight.max()
    ours, theirs = pixels("ours.residual")[both], pixels("theirs.residual")[both]
    assert np.abs(ours - theirs).max() < 0.05 * theirs.max()
    assert np.vdot(ours, theirs) / np.vdot(theirs, theirs) == pytest.approx(1, abs=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("mosweight", [True, False])
def test_weights_by_field_are_tcleans(mixed, tmp_path, monkeypatch, mosweight):
    import casatasks

    monkeypatch.chdir(tmp_path)
    options = GRID | dict(vis=mixed, niter=0, weighting="briggs", robust=0.0, mosweight=mosweight)
    tsara(imagename="ours", **options)
    casatasks.tclean(imagename="theirs", restoration=False, **options)
    assert pixels("ours.sumwt")[0, 0] == pytest.approx(pixels("theirs.sumwt")[0, 0], rel=1e-4)


@pytest.mark.slow
def test_one_pointing_is_the_standard_image_over_its_beam(folder, tmp_path, monkeypatch):
    """Dishes of one kind, one field: flat noise is the standard image, the model its model over the beam."""
    monkeypatch.chdir(tmp_path)
    name = simulate_mosaic(folder / "one.ms", [(0, 0)], SKY[:2], dishes=(12.0,) * 10, noise=0.1, rounds=12, hours=4.0)
    options = GRID | dict(vis=name, phasecenter="", imsize=[320, 320], cell="0.45arcsec")
    tsara(imagename="mosaic", **options)
    tsara(imagename="plain", **options | dict(gridder="standard"))
    pb = pixels("mosaic.pb")
    good = pb > 0.25
    plain, mosaic = pixels("plain.model"), pixels("mosaic.model") * pb
    assert mosaic[good].sum() == pytest.approx(plain[good].sum(), rel=0.02)
    for product, tolerance in (("psf", 1e-5), ("image", 0.02)):
        one, other = pixels("plain." + product), pixels("mosaic." + product)
        assert np.abs(one - other)[good].max() < tolerance * one.max()


# The sky ----------------------------------------------------------------------------------------


@pytest.mark.slow
def test_sources_are_recovered_in_place_and_flux(mixed, tmp_path, monkeypatch):
    """At the centre of a pointing, between pointings, and where the beam of the mosaic is 0.2."""
    monkeypatch.chdir(tmp_path)
    result = tsara(vis=mixed, imagename="x", pbcor=True, **GRID | dict(cell="0.5arcsec", imsize=[360, 320]))
    assert result["stopcode"] == 101
    model, pb, seen = pixels("x.model"), pixels("x.pb"), []
    for flux, l, m in SKY:
        x, y = 180 - l / ARCSEC / 0.5, 160 + m / ARCSEC / 0.5
        corner = int(x) - 10, int(y) - 10
        part = model[corner[0] : corner[0] + 21, corner[1] : corner[1] + 21].astype(float)
        seen.append(pb[round(x), round(y)])
        assert part.sum() == pytest.approx(flux, rel=0.02)
        place = [np.vdot(np.indices(part.shape)[axis], part) / part.sum() + corner[axis] for axis in (0, 1)]
        assert np.hypot(place[0] - x, place[1] - y) < 0.3
    assert max(seen) > 0.95 and min(seen) < 0.22
    # .image is the sky times .pb with the noise the same everywhere, .image.pbcor the sky
    image, corrected, good = pixels("x.image"), pixels("x.image.pbcor"), pb > 0.2
    np.testing.assert_allclose(corrected[good], (image / np.where(good, pb, 1))[good], rtol=1e-5)
    np.testing.assert_allclose(pixels("x.model.pbcor")[good], model[good], rtol=1e-4, atol=1e-6)
    islands = [island for island in result["sara"]["islands"] if island["snr"] > 20]
    assert sum(island["flux_jy"] for island in islands) == pytest.approx(sum(flux for flux, *_ in SKY), rel=0.02)
    history = result["sara"]
    assert result["summaryminor"][0][0][0]["modelFlux"][0] == pytest.approx(model.sum(), rel=1e-4)
    assert history["residual_snr"]


@pytest.mark.slow
def test_errors_are_those_of_the_sky(mixed, tmp_path, monkeypatch):
    """.model.error and flux errors by the noise where a source is; .image.error of flat noise."""
    monkeypatch.chdir(tmp_path)
    options = GRID | dict(vis=mixed, wavelets=["dirac"], pbcor=True, nthreads=1)
    result = tsara(imagename="x", ndraws=6, jackknife=True, blocks=4, **options)["sara"]
    pb, error, model = pixels("x.pb"), pixels("x.model.error"), pixels("x.model")
    draws = read_draws("x.draws.npz")
    np.testing.assert_allclose(error, draws.error(), rtol=1e-5)
    noise = pixels("x.residual")[pb > 0.3].std()
    for flux, l, m in SKY:
        x, y = round(120 - l / ARCSEC / 0.9), round(108 + m / ARCSEC / 0.9)
        island = min(result["islands"], key=lambda one: np.hypot(one["x_peak"] - x, one["y_peak"] - y))
        assert island["flux_jy"] == pytest.approx(flux, abs=4 * island["bootstrap_error_jy"])
        # a point's flux is known to the noise over the primary beam
        assert 0.5 < island["bootstrap_error_jy"] / (noise / pb[x, y]) < 4
        assert 0.3 * noise < pixels("x.image.error")[x, y] < 3 * noise
        assert np.isfinite(pixels("x.image.jackknife")[x, y]) and island["jackknife_error_jy"] > 0
    weight = pixels("x.weight")
    unseen = weight < 0.0095 * weight.max()
    assert unseen.any() and not error[unseen].any() and not model[unseen].any()


@pytest.mark.slow
def test_fields_of_several_measurement_sets_are_one_mosaic(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = [simulate_mosaic(folder / f"part{k}.ms", HEXAGON[k : k + 2], SKY[:2], dishes=(12.0,) * 8, noise=0.1, seed=5)
             for k in (0, 1)]
    tsara(vis=names, imagename="both", niter=0, **GRID)
    images = []
    for name, field in zip(names, ("", "")):
        tsara(vis=name, imagename="single", niter=0, overwrite=True, field=field, **GRID)
        weight, sumwt = pixels("single.weight"), pixels("single.sumwt")[0, 0]
        images.append((pixels("single.residual") * np.sqrt(weight * weight.max()) * sumwt, weight * sumwt))
    dirty, weight = (sum(parts) for parts in zip(*images))
    total = pixels("both.sumwt")[0, 0]
    np.testing.assert_allclose(pixels("both.weight"), weight / total, atol=1e-5)
    seen = weight > 0.05 * weight.max()
    expected = np.divide(dirty, np.sqrt(weight * weight.max()), out=np.zeros_like(dirty), where=seen)
    found = np.where(seen, pixels("both.residual"), 0)
    np.testing.assert_allclose(found, expected, atol=2e-4 * np.abs(expected).max())


@pytest.mark.slow
def test_startmodel_is_the_sky(mixed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    options = GRID | dict(vis=mixed, wavelets=["dirac"], niter=40)
    tsara(imagename="once", **options)
    tsara(imagename="twice", **options | dict(startmodel="once.model", niter=1))
    one, other = pixels("once.model"), pixels("twice.model")
    assert np.linalg.norm(one - other) < 0.35 * np.linalg.norm(one)  # it began there


@pytest.mark.slow
def test_restart_goes_on_to_the_same_sky(mixed, tmp_path, monkeypatch):
    """Stopped in the middle, to the last bit."""
    monkeypatch.chdir(tmp_path)
    options = GRID | dict(vis=mixed, wavelets=["dirac", "db2"], nthreads=1, niter=100)
    tsara(imagename="once", **options)

    class Progress(log.Progress):
        def __call__(self, iteration, *others):
            if iteration == 50:
                os.kill(os.getpid(), signal.SIGINT)

    with monkeypatch.context() as patched:
        patched.setattr(log, "Progress", Progress)
        assert tsara(imagename="twice", **options)["stopcode"] == STOPPED_BY_USER
    assert tsara(imagename="twice", restart=True, **options)["sara"]["resumed"] == [50]
    for product in ("model", "residual", "weight"):
        np.testing.assert_array_equal(pixels("twice." + product), pixels("once." + product))


def test_model_column_is_the_sky_through_the_beams(folder, tmp_path, monkeypatch):
    """Against the explicit sum, by field and pair of dishes; flagged rows too."""
    monkeypatch.chdir(tmp_path)
    name = simulate_mosaic(folder / "column.ms", HEXAGON[:3], SKY[:1], dishes=DISHES, noise=0.1)
    edit(name, "FLAG_ROW", lambda old: np.arange(old.size) % 5 == 0)
    tsara(vis=name, imagename="x", niter=0, **GRID)
    pixel = np.zeros((240, 216, 1, 1))
    pixel[100, 120], pixel[140, 90] = 2.0, 1.0
    ia = casatools.image()
    ia.open("x.model")
    ia.putchunk(pixel)
    ia.close()
    os.rename("x.model", "start.model")
    tsara(vis=name, imagename="y", niter=0, startmodel="start.model", savemodel="modelcolumn", **GRID)
    sky = [(2.0, 20 * 0.9 * ARCSEC, 12 * 0.9 * ARCSEC), (1.0, -20 * 0.9 * ARCSEC, -18 * 0.9 * ARCSEC)]
    expected, = predict(name, [direction(*pointing) for pointing in HEXAGON[:3]], sky, DISHES)
    written = column(name, "MODEL_DATA")
    assert np.abs(expected).max() > 2
    for hand in written:
        np.testing.assert_allclose(hand, expected, atol=1e-3)  # what is left of w


# Cubes ------------------------------------------------------------------------------------------


def planes(name):
    """Return the channels of a cube, (nchan, nx, ny)."""
    ia = casatools.image()
    ia.open(name)
    cube = ia.getchunk()[:, :, 0, :]
    ia.close()
    return np.moveaxis(cube, 2, 0)


@pytest.fixture(scope="module")
def line(folder):
    """Three pointings of four channels, of which the third has a half of all, noise included: two point sources."""
    sky = [(1.0, 0.0, 0.0), (1.0, 25 * ARCSEC, 8 * ARCSEC)]
    name = simulate_mosaic(folder / "line.ms", HEXAGON[:3], sky, dishes=(12.0,) * 7 + (7.0,) * 3, noise=0.2, rounds=3,
                           hours=3.0, spws=(("100GHz", "30MHz", 4),))
    edit(name, "DATA", lambda old: old * np.array([1, 1, 0.5, 1])[:, None])
    return name


CUBE = GRID | dict(imsize=[160, 150], specmode="cube", outframe="LSRK", interpolation="nearest")


@pytest.mark.slow
def test_dirty_cube_of_a_mosaic_is_near_tcleans(line, tmp_path, monkeypatch):
    """Channel by channel; of the first channel also the image of that channel alone. Flagged in one: weaker there."""
    import casatasks

    monkeypatch.chdir(tmp_path)
    os.system(f"cp -r {line} part.ms")
    field = column("part.ms", "FIELD_ID")
    edit("part.ms", "FLAG", lambda old: old | ((np.arange(4)[None, :, None] == 2) & (field == 1)))
    tsara(vis="part.ms", imagename="ours", niter=0, pblimit=0.1, **CUBE)
    casatasks.tclean(vis="part.ms", imagename="theirs", niter=0, pblimit=0.1, restoration=False, **CUBE)
    weights, pbs = planes("ours.weight"), planes("ours.pb")
    assert planes("ours.model").shape == (4, 160, 150)
    assert not np.allclose(weights[2], weights[1], atol=0.02 * weights.max())  # a pointing is missing
    np.testing.assert_allclose(planes("ours.sumwt").ravel(), planes("theirs.sumwt").ravel(), rtol=1e-4)
    for k in range(4):
        pb, theirs = pbs[k], planes("theirs.pb")[k]
        good = (pb > 0.2) & (theirs > 0)
        assert pb.max() == 1 and np.abs(pb - theirs)[good].max() < 0.02
        assert np.abs(weights[k] - planes("theirs.weight")[k])[good].max() < 0.03 * weights[k].max()
        one, other = planes("ours.residual")[k][good], planes("theirs.residual")[k][good]
        assert np.abs(one - other).max() < 0.08 * other.max()
        assert np.vdot(one, other) / np.vdot(other, other) == pytest.approx(1, abs=0.02)
    # the image of one channel alone
    tsara(vis="part.ms", imagename="alone", niter=0, pblimit=0.1, spw="0:2", **CUBE | dict(specmode="mfs"))
    np.testing.assert_allclose(pixels("alone.weight"), weights[2], atol=5e-4)
    np.testing.assert_allclose(pixels("alone.residual"), planes("ours.residual")[2], atol=5e-4)


@pytest.mark.slow
def test_channels_of_a_mosaic_are_the_sky(line, tmp_path, monkeypatch):
    """Fluxes of every channel, its errors, .image of flat noise, and the model column through the beams."""
    monkeypatch.chdir(tmp_path)
    os.system(f"cp -r {line} line.ms")
    result = tsara(vis="line.ms", imagename="x", pbcor=True, nthreads=1, wavelets=["dirac"], savemodel="modelcolumn",
                   ndraws=2, **CUBE | dict(nchan=2, start=1))
    model, image, corrected, pb = (planes("x." + name) for name in ("model", "image", "image.pbcor", "pb"))
    assert model.shape == (2, 160, 150) and planes("x.model.error").any()
    for k in range(2):
        for x, y in ((80, 75), (52, 84)):
            assert model[k, x - 8 : x + 9, y - 8 : y + 9].sum() == pytest.approx((1, 0.5)[k], rel=0.05)
        good = pb[k] > 0.2
        np.testing.assert_allclose(corrected[k][good], (image[k] / np.where(good, pb[k], 1))[good], rtol=1e-4)
    residual = planes("x.residual")
    assert len(result["sara"]["channels"]) == 2 and np.abs(residual).max() < 0.1
    written, observed = column("line.ms", "MODEL_DATA"), column("line.ms", "DATA")
    assert not written[:, 0].any() and not written[:, 3].any()  # of no channel of the image
    ends = np.array([12.0] * 7 + [7.0] * 3)[[column("line.ms", f"ANTENNA{n}") for n in (1, 2)]]
    sigma = 0.2 * (12 / ends).prod(axis=0)
    left = np.abs(observed - written)[:, 1:3] / sigma / np.array([1, 0.5])[:, None]
    assert np.sqrt(np.mean(left**2) / 2) == pytest.approx(1, abs=0.05)


# Refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("parameters, message", [
    (dict(specmode="cube", report=True), "report = True with gridder = 'mosaic' and specmode = 'cube'"),
    (dict(usepointing=True), "usepointing = True: should be True or False out of False|usepointing = True"),
    (dict(gridder="standard"), "gridder = 'standard': 7 fields, up to 3[0-9.]* arcsec apart, would be imaged as one "
     "pointing: should be gridder = 'mosaic'"),
    (dict(phasecenter="J2000 150.2deg -30deg"), "phasecenter = .*: no pointing sees the centre of the image")])
def test_what_mosaics_cannot_do_is_refused(mixed, tmp_path, parameters, message):
    with pytest.raises(ValueError, match=message):
        tsara(vis=mixed, imagename=str(tmp_path / "no"), niter=0, **GRID | parameters)
    assert not os.listdir(tmp_path)


def test_pointings_are_imaged_as_one_only_when_asked(mixed, tmp_path):
    options = GRID | dict(gridder="standard", onepointing=True)
    result = tsara(vis=mixed, imagename=str(tmp_path / "one"), niter=0, **options)
    assert any("7 fields" in note and "imaged as one pointing" in note for note in result["sara"]["notes"])


def test_dishes_without_a_beam_are_refused(folder, tmp_path):
    name = simulate_mosaic(folder / "odd.ms", HEXAGON[:2], SKY[:1], dishes=(12.0,) * 5)
    edit(name + "/ANTENNA", "DISH_DIAMETER", lambda old: np.where(np.arange(old.size) == 2, 9.0, old))
    with pytest.raises(ValueError, match="ALMA's dishes have 12 or 7 m in ANTENNA/DISH_DIAMETER, not 9 m"):
        tsara(vis=name, imagename=str(tmp_path / "no"), niter=0, **GRID)


@pytest.fixture(scope="module")
def reported(mixed, folder):
    """A short run with its report, as products and measures."""
    name = str(folder / "reported")
    tsara(vis=mixed, imagename=name, niter=15, wavelets=["dirac"], report=True, **GRID)
    with open(name + ".report/measures.json") as file:
        return name, json.load(file)["products"]["reported"]


@pytest.mark.slow
def test_report_measures_where_the_mosaic_sees(reported):
    """σ, peak and flux are those of .residual, .image and .model where .pb is above pblimit."""
    from casa_sara import saracompare

    name, measures = reported
    pb, model = pixels(name + ".pb"), pixels(name + ".model")
    residual, image, area = pixels(name + ".residual"), pixels(name + ".image"), pb >= 0.2
    assert os.path.isfile(name + ".report/report.html") and 0.2 < area.mean() < 0.8
    assert measures["natural"]["sigma"] == pytest.approx(residual[area].std(), rel=1e-4)
    assert measures["natural"]["peak"] == pytest.approx(image[area].max(), rel=1e-3)
    assert measures["flux_jy"] == pytest.approx(model[area].sum(dtype=float), rel=1e-5)
    assert np.mean(measures["natural"]["chi_square"]) == pytest.approx(1, abs=0.1)
    with pytest.raises(ValueError, match="regions: .* primary beam of the mosaic is too low"):
        saracompare(models=[name, name], regions=["circle[[150.03deg, -30.025deg], 3arcsec]"])


@pytest.mark.parametrize("gridder, parameters, message", [
    ("mosaic", dict(inject=["150deg, -30deg"]), "inject = .* with images of gridder = 'mosaic'.*; should be \\[\\]"),
    ("mosaic", dict(features=[NEAR_CENTRE]), "features = .* with images of gridder = 'mosaic'.*; should be \\[\\]"),
    ("standard", {}, "'.*other' was imaged with gridder = 'standard', .* should be images of gridder = 'mosaic'")])
def test_comparisons_that_mosaics_do_not_have(mixed, folder, tmp_path, gridder, parameters, message):
    from casa_sara import saracompare

    names = [str(tmp_path / name) for name in ("one", "other")]
    for name, given in zip(names, ("mosaic", gridder)):
        tsara(vis=mixed, imagename=name, niter=0, **GRID | dict(gridder=given, onepointing=given != "mosaic"))
    with pytest.raises(ValueError, match=message):
        saracompare(models=names, vis=mixed, datacolumn="data", **parameters)


@pytest.mark.slow
def test_comparison_beside_tclean(mixed, reported, tmp_path, monkeypatch):
    """tclean's model is the sky × .pb and becomes the sky; its residual by our beams is nearly its own."""
    import casatasks

    from casa_sara import saracompare

    monkeypatch.chdir(tmp_path)
    casatasks.tclean(vis=mixed, imagename="theirs", niter=300, pblimit=0.2, weighting="natural", **GRID)
    truth = np.zeros((240, 216, 1, 1), np.float32)
    for flux, l, m in SKY:
        truth[round(120 - l / ARCSEC / 0.9), round(108 + m / ARCSEC / 0.9)] += flux
    os.system("cp -r theirs.model truth.model")
    ia = casatools.image()
    ia.open("truth.model")
    ia.putchunk(truth)
    ia.close()
    options = dict(models=[reported[0], "theirs"], names=["ours", "theirs"], truth="truth.model")
    found = saracompare(vis=mixed, datacolumn="data", regions=[NEAR_CENTRE], **options)["products"]
    sigma = pixels("theirs.residual")[pixels("theirs.pb") >= 0.2].std()
    assert found["theirs"]["natural"]["sigma"] == pytest.approx(sigma, rel=0.1)
    region = found["theirs"]["regions"][NEAR_CENTRE]
    assert region["flux_jy"] == pytest.approx(SKY[0][0], abs=3 * region["error_jy"] + 0.02)
    sky = pixels("theirs.model") / np.maximum(pixels("theirs.pb"), 0.1)
    assert found["theirs"]["flux_jy"] == pytest.approx(sky[pixels(reported[0] + ".pb") >= 0.2].sum(), rel=1e-3)
    assert found["theirs"]["truth"]["snr_at_scale"] and found["ours"]["truth"]["snr_at_scale"]
    # without visibilities the residuals are those beside the models
    beside = saracompare(**options)["products"]
    assert beside["theirs"]["natural"]["sigma"] == pytest.approx(sigma, rel=0.1)
    assert beside["ours"]["natural"]["sigma"] == pytest.approx(found["ours"]["natural"]["sigma"], rel=1e-3)


def test_dryrun_of_a_mosaic(mixed, tmp_path):
    forecast = tsara(vis=mixed, imagename=str(tmp_path / "none"), dryrun=True, **GRID)["forecast"]
    assert forecast["fits"] and forecast["seconds"]["total"] > 0


def test_vla_mosaic_has_casas_beam(folder, tmp_path, monkeypatch):
    """One pointing of the VLA: .pb is that of the standard gridder, which is tclean's."""
    monkeypatch.chdir(tmp_path)
    name = simulate(folder / "vla.ms", antennas=8, noise=0.02, scans=1, spws=(("8.4GHz", "2MHz", 1),))
    options = dict(vis=name, niter=0, datacolumn="data", imsize=[160, 150], cell="3.6arcsec", pblimit=0.1)
    tsara(imagename="mosaic", gridder="mosaic", **options)
    tsara(imagename="plain", **options)
    assert np.abs(pixels("mosaic.pb") - pixels("plain.pb")).max() < 0.11  # 0 below the limit in one of them only
    good = pixels("plain.pb") > 0.12
    assert np.abs(pixels("mosaic.pb") - pixels("plain.pb"))[good].max() < 3e-3


def test_fields_of_the_vla_do_not_widen_its_beam(folder):
    """Two fields in one MeasurementSet and one in another: the beam of a pointing is that of the pointing alone."""
    options = dict(antennas=4, spws=(("8.4GHz", "2MHz", 1),))
    fields = [f"J2000 10h00m00s 20d0{minutes}m00s" for minutes in (0, 2, 4)]
    names = (simulate(folder / "pair.ms", fields=fields[:2], **options),
             simulate(folder / "third.ms", fields=fields[2:], **options))
    found, grid = [], ImageGrid((160, 160), (np.radians(0.001),) * 2, fields[0], gridder="mosaic")
    for selection in (Selection(names[:1], field="1", datacolumn="data"), Selection(names, datacolumn="data")):
        data = read_visibilities(selection, grid.phasecenter, frequencies=True)
        found.append(primary_beams(data, selection, grid))
    alone, all_of_them = (one.profiles for one in found)
    assert [len(one.centres) for one in found] == [1, 3]
    np.testing.assert_allclose(all_of_them.radii, alone.radii, rtol=2e-3)
    np.testing.assert_allclose(all_of_them.values, alone.values, atol=2e-3)
