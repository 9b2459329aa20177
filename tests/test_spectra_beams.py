"""Unknown spectra of mosaics: the primary beams of every frequency are in the model, so that the index is the sky's."""

from types import SimpleNamespace

import numpy as np
import pytest
from simulated_mosaic import ARCSEC, CENTRE, simulate_mosaic
from simulated_ms import column, edit, pixels

casatools = pytest.importorskip("casatools")

import casa_sara.imaging.spectra as spectra_module
from casa_sara import tsara
from casa_sara.comparison.compare_images import compare_images
from casa_sara.operators.beams import Beam, Mosaic
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.subbands import Subbands
from casa_sara.options import Comparing, ImageGrid, Selection

INDEX, REFERENCE = -0.7, 100e9
WINDOWS = (("84GHz", "10.6GHz", 4),)
POINTINGS = [(-12.0, 0.0), (12.0, 0.0)]
# pixels of 1 arcsec → Jy at the reference: between the pointings, and where the beams together are below 0.5
SOURCES = {(48, 48): 1.0, (6, 48): 1.0, (48, 82): 1.0}
GRID = dict(imsize=96, cell="1arcsec", datacolumn="data", gridder="mosaic", reffreq="100GHz", nthreads=1, pblimit=0.1,
            phasecenter=f"J2000 {CENTRE[0]}deg {CENTRE[1]}deg")


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    """Visibilities of dishes of 12 m, whose sources all have INDEX."""
    sky = [(flux, (48 - x) * ARCSEC, (y - 48) * ARCSEC) for (x, y), flux in SOURCES.items()]
    name = simulate_mosaic(tmp_path_factory.mktemp("ms") / "wide.ms", POINTINGS, sky, dishes=(12.0,) * 9, noise=0.02,
                           spws=WINDOWS, rounds=5, hours=5.0)
    freqs = column(name + "/SPECTRAL_WINDOW", "CHAN_FREQ")
    edit(name, "DATA", lambda data: data * (freqs / REFERENCE) ** INDEX)
    return name


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("run") / "sky")
    return tsara(vis=vis, imagename=name, nterms=2, savemodel="modelcolumn", **GRID), name


def opened(name, mask=False):
    ia = casatools.image()
    ia.open(name)
    try:
        return ia.getchunk(getmask=mask)[:, :, 0, 0]
    finally:
        ia.close()


def test_operator_is_that_of_every_plane():
    """Stacked images of flat noise: each plane through the beams, times its factors."""
    rng, shape, cell = np.random.default_rng(1), (40, 36), (1e-5, 1e-5)
    freq_hz = np.repeat([1e9, 1.5e9, 2e9], 50)
    beams = tuple(Beam((22.0, 15.0), 2.5e-4 / k, np.linspace(1, 0, 4097, dtype=np.float32)) for k in (1.0, 1.5, 2.0))
    mosaic, number = Mosaic(shape, cell, beams), np.repeat([0, 1, 2], 50)
    flat = mosaic.flat(mosaic.sensitivity(np.bincount(number)))
    subbands = Subbands.of(freq_hz, np.ones(150), 2, 1.5e9)
    uvw = np.vstack([rng.uniform(-0.3, 0.3, (2, 150)) / 1e-5, np.zeros(150)])
    grid = ImageGrid(shape, cell, gridder="mosaic", mosaic=flat, nterms=2, subbands=subbands)
    operator = sky_operator(uvw, grid, freq_hz, beam=number)
    planes = rng.standard_normal((2, *shape)).astype(np.float32)
    l = -(np.arange(shape[0]) - 20)[:, None] * cell[0]
    m = (np.arange(shape[1]) - 18)[None, :] * cell[1]
    x, y = np.indices(shape)
    expected = np.zeros(150, complex)
    for k, (u, v, _) in enumerate(uvw.T):
        beam = beams[number[k]]
        gain = np.maximum(1 - ((x - 22) ** 2 + (y - 15) ** 2) * cell[0] ** 2 / beam.radius_rad**2, 0)
        seen = np.tensordot(subbands.factors(freq_hz[k : k + 1])[:, 0], planes, 1) * flat.over * gain
        expected[k] = (seen * np.exp(2j * np.pi * (u * l + v * m))).sum()
    assert np.linalg.norm(operator.forward(planes.reshape(-1, 36)) - expected) < 1e-5 * np.linalg.norm(expected)


def test_error_of_the_index_follows_the_beams(monkeypatch):
    """What a fit to each pixel makes of the noise of all channels, each through its beam."""
    shape, cell, count = (48, 48), (1e-5, 1e-5), 60
    freqs = np.linspace(1e9, 2e9, count)
    profile = np.exp(-3 * np.linspace(0, 1, 4097)).astype(np.float32)
    beams = tuple(Beam((24.0, 24.0), 4e-4 / (freq / 1e9), profile) for freq in freqs)
    mosaic, subbands = Mosaic(shape, cell, beams), Subbands.of(freqs, np.ones(count), 3, 1.4e9)
    data = SimpleNamespace(freq_hz=freqs, weight=np.ones(count, np.float32), beam=np.arange(count))
    spectra = np.ones((3, *shape), np.float32) * np.float32((subbands.freqs_hz / 1.4e9) ** -0.7)[:, None, None]
    seen = mosaic.sensitivity(np.ones(count))
    beam = dict(major=dict(value=1e-9, unit="arcsec"), minor=dict(value=1e-9, unit="arcsec"),
                positionangle=dict(value=0.0, unit="deg"))
    grid = ImageGrid(shape, cell, gridder="mosaic", mosaic=mosaic, nterms=3, subbands=subbands)
    sigma = 0.02 / np.sqrt(count)  # of an image of all data where the beams are 1: each channel has 0.02
    found = SimpleNamespace(spectra=spectra, noise_jy_per_beam=sigma / seen.max())
    monkeypatch.setattr(spectra_module, "beam_pixels", lambda axes, cell: 1.0)
    monkeypatch.setattr(spectra_module, "smooth", lambda plane, *beam: plane)
    images = spectra_module.spectral_images(found, grid, data, beam)
    np.testing.assert_allclose(images["alpha"][images["known"]], -0.7, atol=1e-4)
    # Fisher information of (brightness, index) at a pixel, from all channels
    place = np.log(freqs / 1.4e9)
    for x in (24, 30, 36):
        gain = np.array([one.at(x, 24, cell) for one in beams]) * (freqs / 1.4e9) ** -0.7 / 0.02
        derivatives = np.array([gain, gain * place])
        expected = np.sqrt(np.linalg.inv(derivatives @ derivatives.T)[1, 1])
        assert images["alpha.error"][x, 24] == pytest.approx(expected, rel=0.15)
    assert images["alpha.error"][36, 24] > 1.5 * images["alpha.error"][24, 24]
    assert images["alpha.error"].max() <= spectra_module.LARGEST_ERROR


@pytest.mark.slow
def test_index_and_flux_are_those_of_the_sky(run):
    """Within 0.05 of the index and 2 % of the flux, where the beam would make the index −2.5."""
    result, name = run
    index, known = opened(name + ".alpha"), opened(name + ".alpha", True)
    model, pb = pixels(name + ".model"), pixels(name + ".pb")
    assert pb[6, 48] < 0.5
    for (x, y), flux in SOURCES.items():
        assert known[x, y] and index[x, y] == pytest.approx(INDEX, abs=0.05)
        assert model[x - 3 : x + 4, y - 3 : y + 4].sum() == pytest.approx(flux, rel=0.02)
    restored = pixels(name + ".image")  # of flat noise
    assert restored[6, 48] == pytest.approx(pb[6, 48], rel=0.06)
    assert not known[2, 2]
    islands = [one for one in result["sara"]["islands"] if one["snr"] > 5]
    assert len(islands) == 3 and all(one["flux_jy"] == pytest.approx(1, rel=0.02) for one in islands)


@pytest.mark.slow
def test_comparison_sees_the_spectra_through_the_beams(run, vis):
    request = Comparing((run[1],), ("spectra",))
    measures = compare_images(request, Selection((vis,), datacolumn="data"), single=True).measures["products"]
    assert max(measures["spectra"]["natural"]["chi_square"]) < 1.2


@pytest.mark.slow
def test_model_column_has_the_spectra_through_the_beams(run, vis):
    left = np.abs(column(vis, "DATA") - column(vis, "MODEL_DATA")) ** 2 / (2 * column(vis, "SIGMA")[:, None, :] ** 2)
    assert left.mean() < 1.15  # the noise was multiplied by the spectrum, too


@pytest.mark.slow
def test_errors_of_the_sky(run, vis, tmp_path):
    """Of stacked images of flat noise: larger where the beams have fallen off, by about as much."""
    name = str(tmp_path / "drawn")
    result = tsara(vis=vis, imagename=name, nterms=2, ndraws=6, **GRID)
    assert np.array_equal(pixels(name + ".model"), pixels(run[1] + ".model"))
    islands = {(one["x_peak"], one["y_peak"]): one["bootstrap_error_jy"] for one in result["sara"]["islands"]}
    assert all(islands[place] > 0 for place in SOURCES)
    noise = result["sara"]["chosen"]["noise_jy_per_beam"]
    assert 0.2 < islands[48, 48] / noise < 8 and 0.2 < islands[6, 48] / (noise / pixels(name + ".pb")[6, 48]) < 8
