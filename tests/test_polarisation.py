"""Stokes Q, U and V: against tclean's images, the Stokes parameters put into the data, and what the noise predicts."""

import numpy as np
import pytest
from simulated_ms import SPEED_OF_LIGHT, column, edit, pixels, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.options import Selection

CELL_RAD = np.radians(1.0 / 3600)
GRID = dict(imsize=[80, 72], cell="1arcsec", datacolumn="data", nthreads=1)
NOISE = (0.03, 0.05, 0.04, 0.06)
# Stokes parameters of two sources in pixels (48, 30) and (28, 50)
PLACES = [(-8 * CELL_RAD, -6 * CELL_RAD), (12 * CELL_RAD, 14 * CELL_RAD)]
SKY = {"I": (1.0, 0.8), "Q": (0.3, -0.25), "U": (-0.2, 0.3), "V": (0.1, -0.15)}
FEEDS = {"circular": "RR RL LR LL", "linear": "XX XY YX YY"}


def polarise(feed, name, noise=NOISE, seed=2):
    """Put the polarised sources, and noise, into DATA."""
    uvw, freq = column(name, "UVW"), column(name + "/SPECTRAL_WINDOW", "CHAN_FREQ", [0])[:, 0]
    i, q, u, v = (np.array(SKY[stokes]) for stokes in "IQUV")
    brightness = (i + v, q + 1j * u, q - 1j * u, i - v) if feed == "circular" else (i + q, u + 1j * v, u - 1j * v,
                                                                                    i - q)
    rng = np.random.default_rng(seed)

    def change(data):
        new = np.zeros_like(data)
        for (l, m), values in zip(PLACES, np.transpose(brightness)):
            turns = uvw[0] * l + uvw[1] * m + uvw[2] * (np.sqrt(1 - l**2 - m**2) - 1)
            new += np.asarray(values)[:, None, None] * np.exp(2j * np.pi * turns * freq[:, None] / SPEED_OF_LIGHT)
        scale = np.asarray(noise)[:, None, None]
        return new + scale * (rng.standard_normal(new.shape) + 1j * rng.standard_normal(new.shape))

    edit(name, "DATA", change)
    return name


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ms")
    return {feed: polarise(feed,
                           simulate(folder / f"{feed}.ms", configuration="c", antennas=14, correlations=correlations,
                                          noise=NOISE, scans=3, integration=20.0, spacing_seconds=5400.0,
                                    hour_angle=-2.0,
                                          spws=(("8.4GHz", "2MHz", 2),)))
            for feed, correlations in FEEDS.items()}


@pytest.mark.parametrize("feed", FEEDS)
@pytest.mark.parametrize("stokes", "IQUV")
def test_dirty_image_is_tcleans(observations, feed, stokes):
    import casatasks

    common = dict(vis=observations[feed], stokes=stokes, niter=0, imsize=[80, 72], cell="1arcsec", datacolumn="data",
                  weighting="briggs", robust=0.0)
    tsara(imagename="ours", positivity=stokes == "I", **common)
    casatasks.tclean(imagename="theirs", **common)
    inner = np.s_[20:60, 18:54]
    ours, theirs = pixels("ours.residual")[inner], pixels("theirs.residual")[inner]
    assert np.sqrt(np.mean((ours - theirs) ** 2) / np.mean(theirs**2)) < 2e-3
    assert pixels("ours.sumwt").item() == pytest.approx(pixels("theirs.sumwt").item(), rel=1e-5)
    ia = casatools.image()
    ia.open("ours.residual")
    assert ia.coordsys().stokes() == [stokes]
    ia.close()


@pytest.mark.parametrize("feed", FEEDS)
@pytest.mark.parametrize("stokes", "IQUV")
def test_weights_are_the_inverse_variance(observations, feed, stokes):
    """Of noise alone, whitened samples have unit variance in their real and in their imaginary part."""
    name = observations[feed]
    before = column(name, "DATA")
    try:
        edit(name, "DATA", lambda data: np.asarray(NOISE)[:, None, None] * _unit_noise(data.shape))
        data = read_visibilities(Selection((name,), datacolumn="data"), stokes=stokes)
    finally:
        edit(name, "DATA", lambda data: before)
    whitened = np.sqrt(data.weight) * data.vis
    tolerance = 4 / np.sqrt(2 * data.size)
    assert whitened.real.std() == pytest.approx(1, abs=tolerance) and whitened.imag.std() == pytest.approx(1,
                                                                                                           abs=tolerance)
    hands = [1 / np.array(NOISE)[k] ** 2 for k in (0, 3)]
    np.testing.assert_allclose(data.imaging_weight, np.mean(hands), rtol=1e-5)


def _unit_noise(shape):
    rng = np.random.default_rng(5)
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


@pytest.mark.parametrize("feed, stokes", [("circular", "Q"), ("linear", "U"), ("circular", "V")])
def test_sources_of_either_sign_are_found_and_the_noise_too(observations, feed, stokes):
    result = tsara(vis=observations[feed], imagename="x", stokes=stokes, positivity=False, niter=300, **GRID)
    model = pixels("x.model")
    for (x, y), flux in zip(((48, 30), (28, 50)), SKY[stokes]):
        assert model[x - 4 : x + 5, y - 4 : y + 5].sum() == pytest.approx(flux, rel=0.1)
    assert model.min() < 0 < model.max()
    for block in result["sara"]["blocks"]:  # no noise is found below that measured between integrations, 1.09 here
        assert block["noise_found"] == pytest.approx(max(1, block["noise_measured"]), rel=0.05)


@pytest.mark.parametrize("given, message", [
    (dict(stokes="Q"),
     "positivity = True with stokes = 'Q': the image may be negative; should be False"),
    (dict(stokes="U", positivity=False, savemodel="modelcolumn"),
     "savemodel = 'modelcolumn' with stokes = 'U': .*; should be 'none'"),
    (dict(stokes="V", positivity=False, report=True), "report = True with stokes = 'V': .*; should be False"),
    (dict(stokes="Q", positivity=False, startmodel="i.model"), "startmodel = 'i.model' is of Stokes I: should be of Q"),
])
def test_what_does_not_go_together_is_refused(observations, given, message):
    if "startmodel" in given:
        tsara(vis=observations["circular"], imagename="i", niter=0, **GRID)
    with pytest.raises(ValueError, match=message):
        tsara(vis=observations["circular"], imagename="x", **given, **GRID)


@pytest.mark.parametrize("correlations, stokes, right", [
    ("RR LL", "Q", "RL and LR, or XX and YY"), ("XX YY", "V", "RR and LL, or XY and YX"), ("RR", "V", "RR and LL"),
    ("RL LR", "I", "RR and LL, or XX and YY, or one of them alone")])
def test_missing_correlations_are_refused(tmp_path, correlations, stokes, right):
    name = simulate(tmp_path / "x.ms", correlations=correlations, antennas=4, scans=1)
    with pytest.raises(ValueError,
                       match=f"stokes = '{stokes}' cannot be formed from the correlations .*: it needs {right}"):
        read_visibilities(Selection((name,), datacolumn="data"), stokes=stokes)


@pytest.mark.parametrize("stokes", ["Q", "V"])
def test_a_comparison_refuses_images_of_another_stokes(tmp_path, stokes):
    """Its visibilities are those of Stokes I."""
    csys = casatools.coordsys().newcoordsys(direction=True, stokes=[stokes], spectral=True)
    ia = casatools.image()
    ia.fromshape(str(tmp_path / "a.model"), [16, 16, 1, 1], csys=csys.torecord())
    ia.setbrightnessunit("Jy/pixel")
    ia.close()
    with pytest.raises(ValueError, match=f"models = '.*a.model' is of Stokes {stokes}: should be of Stokes I"):
        read_sky_image(str(tmp_path / "a.model"), "models", ("Jy/pixel",))
