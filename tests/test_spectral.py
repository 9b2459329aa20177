"""Skies of a known spectral index: against the explicit sum over frequencies, and in whole runs."""

import os

import numpy as np
import pytest
from simulated_ms import column, edit, pixels, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.casa.images.spectral_index import spectral_band, with_spectrum
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.comparison.compare_images import compare_images
from casa_sara.operators.sky import further_bytes, sky_operator
from casa_sara.options import Comparing, ImageGrid, Selection, Spectrum

pytestmark = pytest.mark.usefixtures("every_thread")

SHAPE, CELL, SIZE = (30, 41), (2e-3, 1.7e-3), 400
# VLA D, 4 to 8 GHz in four windows; two sources, -0.8 both
WINDOWS = tuple((f"{freq}GHz", "2MHz", 2) for freq in (4.0, 5.2, 6.6, 8.0))
INDEX, REFERENCE = -0.8, 6e9
PIXEL = np.radians(3.0 / 3600)
SOURCES = {(32, 32): 1.0, (44, 22): 0.5}  # pixel → Jy at the reference
GRID = dict(imsize=64, cell="3arcsec", datacolumn="data", reffreq="6GHz", nthreads=1)


def visibilities(rng):
    """uvw (3, SIZE) and the frequencies of two windows."""
    uvw = rng.uniform(-0.4, 0.4, (3, SIZE)) / np.array([*CELL, 5e-3])[:, None]
    return uvw, np.where(np.arange(SIZE) % 2, 1.1e9, 1.9e9) * rng.uniform(1, 1.05, SIZE)


def fourier_sum(uvw, w_term):
    """Matrix (SIZE, nx·ny)."""
    l = -(np.arange(SHAPE[0]) - SHAPE[0] // 2)[:, None] * CELL[0]
    m = (np.arange(SHAPE[1]) - SHAPE[1] // 2)[None, :] * CELL[1]
    lmn = [np.broadcast_to(axis, SHAPE).ravel() for axis in (l, m, w_term * (np.sqrt(1 - l**2 - m**2) - 1))]
    return np.exp(2j * np.pi * (uvw.T @ np.array(lmn)))


@pytest.mark.parametrize("dtype, eps", [(np.float32, 1e-4), (np.float32, 1e-6), (np.float64, 1e-10)])
@pytest.mark.parametrize("gridder", ["standard", "wproject"])
@pytest.mark.parametrize("spread", [None, 0.0, 0.4, 3.0])
def test_equals_the_sum_over_frequencies(spread, gridder, dtype, eps):
    """One index where `spread` is None, else an image of indices in −0.8 ± spread."""
    rng = np.random.default_rng(0)
    (uvw, freq_hz), scale = visibilities(rng), rng.uniform(0.5, 2, SIZE)
    index = -0.8 if spread is None else rng.uniform(-0.8 - spread, -0.8 + spread, SHAPE)
    grid = ImageGrid(SHAPE, CELL, gridder=gridder, spectrum=Spectrum(index, 1.5e9))
    matrix = fourier_sum(uvw, gridder == "wproject") * scale[:, None]
    matrix *= (freq_hz[:, None] / 1.5e9) ** np.ravel(index)
    operator = sky_operator(uvw, grid, freq_hz, scale, eps, dtype, nthreads=2)
    image, vis = rng.standard_normal(SHAPE).astype(dtype), rng.standard_normal(SIZE) + 1j * rng.standard_normal(SIZE)
    found, found_image = operator.forward(image), operator.adjoint(vis)
    gain = np.linalg.norm(np.abs(matrix).max(axis=1))
    assert np.linalg.norm(found - matrix @ image.ravel()) <= eps * np.linalg.norm(image) * gain
    error = found_image - (matrix.conj().T @ vis).real.reshape(SHAPE)
    assert np.linalg.norm(error) <= eps * np.linalg.norm(vis) * gain / np.sqrt(SIZE) * np.sqrt(image.size)
    products = np.vdot(found.astype(complex), vis).real, np.vdot(image, found_image.astype(float))
    bound = {np.float32: 2e-7, np.float64: 1e-14}[dtype]
    assert abs(products[0] - products[1]) < bound * np.linalg.norm(found) * np.linalg.norm(vis)


def test_memory_of_an_image_of_indices_is_forecast():
    rng = np.random.default_rng(1)
    uvw, freq_hz = visibilities(rng)
    index = rng.uniform(-5, 5, SHAPE).astype("f4")
    grid = ImageGrid(SHAPE, CELL, spectralindex="a.image", reffreq="1.5GHz", spectrum=Spectrum(index, 1.5e9))
    operator = sky_operator(uvw, grid, freq_hz)
    held = sum(array.nbytes for array in vars(operator).values() if isinstance(array, np.ndarray))
    band = spectral_band(grid, (freq_hz.min(), freq_hz.max()))
    assert band == np.abs(np.log(freq_hz / 1.5e9)).max()
    assert 0.8 * held < further_bytes(SIZE, grid, band=band) <= 1.3 * held
    assert spectral_band(ImageGrid(SHAPE, CELL, spectralindex="-0.7"), (1e9, 2e9)) == 0


# Runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    sky = [(flux, (32 - x) * PIXEL, (y - 32) * PIXEL) for (x, y), flux in SOURCES.items()]
    name = simulate(tmp_path_factory.mktemp("ms") / "wide.ms", antennas=12, spws=WINDOWS, sky=sky, scans=3,
                    integration=20.0, spacing_seconds=5400.0, hour_angle=-3.0)
    rng, windows = np.random.default_rng(2), []
    freqs = [column(name + "/SPECTRAL_WINDOW", "CHAN_FREQ", [k])[:, 0] for k in range(len(WINDOWS))]

    def coloured(data):
        spectrum = (freqs[len(windows)] / REFERENCE) ** INDEX
        windows.append(1)
        return data * spectrum[:,
                               None] + 0.01 * (rng.standard_normal(data.shape) + 1j * rng.standard_normal(data.shape))

    window = column(name, "DATA_DESC_ID")
    tb = casatools.table()
    tb.open(name, nomodify=False)
    for number in range(len(WINDOWS)):
        part = tb.selectrows(np.flatnonzero(window == number).tolist())
        part.putcol("DATA", coloured(part.getcol("DATA")))
        part.close()
    tb.close()
    edit(name, "WEIGHT", lambda weight: np.full_like(weight, 1e4))
    edit(name, "SIGMA", lambda sigma: np.full_like(sigma, 1e-2))
    return name


def fluxes(name):
    """Flux of the model within two pixels of each source."""
    model = pixels(name + ".model")
    return np.array([model[x - 2 : x + 3, y - 2 : y + 3].sum() for x, y in SOURCES])


def residual_noise(result):
    return np.mean([block["noise_found"] for block in result["sara"]["blocks"]])


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("run") / "known")
    return tsara(vis=vis, imagename=name, spectralindex=INDEX, **GRID), name


@pytest.fixture(scope="module")
def flat(vis, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("run") / "flat")
    return tsara(vis=vis, imagename=name, **GRID), name


def test_flux_at_the_reference_frequency(run, flat):
    """With the index known the model is the sky at reffreq and fits; taken as flat, it is neither."""
    np.testing.assert_allclose(fluxes(run[1]), list(SOURCES.values()), rtol=0.01)
    assert residual_noise(run[0]) < 1.1
    assert np.abs(fluxes(flat[1]) / list(SOURCES.values()) - 1).max() > 0.015
    assert residual_noise(flat[0]) > 3
    ia = casatools.image()
    ia.open(run[1] + ".model")
    assert ia.coordsys().referencevalue()["numeric"][3] == REFERENCE
    ia.close()
    noise = run[0]["sara"]["chosen"]["noise_jy_per_beam"]
    assert np.abs(pixels(run[1] + ".residual")).max() < 6 * noise < np.abs(pixels(flat[1] + ".residual")).max()


def alpha(name, values, mask, run):
    """An image of the spectral index on the grid of a run, masked where `mask` is False."""
    ia = casatools.image()
    ia.open(run[1] + ".model")
    csys = ia.coordsys().torecord()
    ia.close()
    ia.fromarray(name, np.asarray(values, float)[:, :, None, None], csys=csys)
    ia.calcmask("T", name="mask0")
    ia.putregion(pixelmask=np.asarray(mask)[:, :, None, None], usemask=False)
    ia.close()
    return name


def test_image_of_indices(run, vis, tmp_path):
    """Pixels without a known index are masked, and take the median of the others."""
    values, mask = np.zeros((64, 64)), np.zeros((64, 64), bool)
    for x, y in SOURCES:
        values[x - 3 : x + 4, y - 3 : y + 4], mask[x - 3 : x + 4, y - 3 : y + 4] = INDEX, True
    mask[0, 0], values[0, 0] = True, 0.5
    name = str(tmp_path / "image")
    tsara(vis=vis, imagename=name, spectralindex=alpha(str(tmp_path / "a.alpha"), values, mask, run), **GRID)
    np.testing.assert_allclose(fluxes(name), fluxes(run[1]), rtol=2e-3)
    plane = read_sky_image(run[1] + ".model", "models", None).plane
    spectrum = with_spectrum(ImageGrid((64, 64), (PIXEL, PIXEL), spectralindex=str(tmp_path / "a.alpha")),
                             plane).spectrum
    assert spectrum.reference_hz == REFERENCE and spectrum.index[0, 0] == pytest.approx(0.5)
    assert np.all(spectrum.index.reshape(-1)[1:] == np.float32(INDEX))
    said = tsara(vis=vis, imagename=name, spectralindex=str(tmp_path / "a.alpha"), dryrun=True, **GRID)["forecast"]
    plain = tsara(vis=vis, imagename=name, spectralindex=INDEX, dryrun=True, **GRID)["forecast"]
    assert said["memory_bytes"]["iterating"]["operator"] > plain["memory_bytes"]["iterating"]["operator"]
    assert "operator of flat spectra" in plain["memory_bytes"]["writing"]


def test_model_column_has_the_spectrum(run, vis, tmp_path):
    import shutil

    copy = shutil.copytree(vis, tmp_path / "copy.ms")
    tsara(vis=str(copy), imagename=run[1], spectralindex=INDEX, niter=0, restart=True, savemodel="modelcolumn", **GRID)
    selection, model = Selection((str(copy),), datacolumn="data"), pixels(run[1] + ".model")
    data = read_visibilities(selection, frequencies=True)
    grid = ImageGrid((64, 64), (PIXEL, PIXEL), spectrum=Spectrum(INDEX, REFERENCE))
    expected = sky_operator(data.uvw, grid, data.freq_hz).forward(model)
    tb = casatools.table()
    tb.open(str(copy))
    found = np.empty(data.size, complex)
    for number in range(len(WINDOWS)):
        here = data.rows.spw[data.row] == number
        rows, back = np.unique(data.rows.row[data.row[here]], return_inverse=True)
        part = tb.selectrows(rows.tolist())
        found[here] = part.getcol("MODEL_DATA")[0][data.chan[here], back]
        part.close()
    tb.close()
    np.testing.assert_allclose(found, expected, atol=1e-5)
    for number, (freq, _, _) in enumerate(WINDOWS):  # the two sources are in phase nowhere, and their sum goes with ν^α
        largest = np.abs(found[data.rows.spw[data.row] == number]).max()
        assert largest == pytest.approx(1.5 * (float(freq[:-3]) / 6) ** INDEX, rel=0.05)


def test_comparison_keeps_the_spectrum(run, flat, vis):
    comparison = compare_images(Comparing((run[1], flat[1]), ("known", "flat"), inject=("19h59m29.8s +40d43m20s",),
                                          injectflux=0.2), Selection((vis,), datacolumn="data"))
    measures = comparison.measures["products"]
    assert max(measures["known"]["natural"]["chi_square"]) < 1.2 < 5 < max(measures["flat"]["natural"]["chi_square"])
    found = measures["known"]["injected"]
    assert [source["flux_jy"] for source in found.values()] == [pytest.approx(0.2, rel=0.05)]


@pytest.mark.parametrize("value, message", [
    ("nosuch.alpha", "spectralindex = 'nosuch.alpha' is neither a number nor an image"),
    (7, "spectralindex = '7.*': should be from -5 to 5"), ("nan", "spectralindex = 'nan': should be from -5 to 5"),
    ([1, 2], "spectralindex = .* should be a string or a number")])
def test_what_cannot_be_is_refused(vis, tmp_path, value, message):
    with pytest.raises((ValueError, FileNotFoundError), match=message):
        tsara(vis=vis, imagename=str(tmp_path / "none"), spectralindex=value, **GRID)
    assert os.listdir(tmp_path) == []


def test_an_image_that_holds_no_indices_is_refused(vis, tmp_path, run):
    wild = alpha(str(tmp_path / "wild.alpha"), np.full((64, 64), 40.0), np.ones((64, 64), bool), run)
    with pytest.raises(ValueError, match="has values from 40 to 40: should be from -5 to 5; mask the pixels"):
        tsara(vis=vis, imagename=str(tmp_path / "none"), spectralindex=wild, **GRID)
    with pytest.raises(ValueError, match="spectralindex = '.*' is in 'Jy/pixel'"):
        tsara(vis=vis, imagename=str(tmp_path / "none"), spectralindex=run[1] + ".model", **GRID)
