"""Sampling density and imaging weights against independent counts; the MeasurementSets stay untouched."""

import hashlib
import math
import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from simulated_ms import CYGNUS_A, SPEED_OF_LIGHT, edit, simulate

from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights, sampling_density, sum_of_weights
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.options import ImageGrid, Selection, Weighting

ARCSEC = np.pi / 180 / 3600
OFF_CENTRE = "J2000 19h59m31.5s +40d45m02s"


def scatter(name, rng, flagged=0.1):
    """Flag at random, and give every channel and hand its own weight."""
    edit(name, "FLAG", lambda flag: rng.random(flag.shape) < flagged)
    edit(name, "WEIGHT_SPECTRUM", lambda weight: rng.uniform(0.5, 2.0, weight.shape))


@pytest.fixture(scope="module")
def names(tmp_path_factory):
    """One MS with autocorrelations, two fields and WEIGHT; one TOPO with flagged rows and WEIGHT_SPECTRUM."""
    folder = tmp_path_factory.mktemp("ms")
    plain = simulate(folder / "plain.ms", fields=(CYGNUS_A, OFF_CENTRE), autocorrelations=True, noise=(0.02, 0.03))
    ragged = simulate(
        folder / "ragged.ms", configuration="c", antennas=9, frame="TOPO", weight_spectrum=True, date="2015/09/01"
    )
    scatter(ragged, np.random.default_rng(1))
    edit(ragged, "FLAG_ROW", lambda flag: np.arange(flag.size) % 7 == 0)
    return plain, ragged


def raw_samples(name, channels=slice(None)):
    """Return u, v in wavelengths at the data's frequencies, what is usable, and weights, all (C, R)."""
    import casatools

    tb = casatools.table()
    tb.open(f"{name}/SPECTRAL_WINDOW")
    wave_numbers = np.float32(tb.getcell("CHAN_FREQ", 0)[channels] / SPEED_OF_LIGHT).astype(float)
    tb.open(name)
    uvw, flag, row_flag = tb.getcol("UVW"), tb.getcol("FLAG"), tb.getcol("FLAG_ROW")
    one, other = tb.getcol("ANTENNA1"), tb.getcol("ANTENNA2")
    if "WEIGHT_SPECTRUM" in tb.colnames():
        weight = tb.getcol("WEIGHT_SPECTRUM")
    else:
        weight = np.repeat(tb.getcol("WEIGHT")[:, None], flag.shape[1], axis=1)
    tb.close()
    u, v = (np.float32(wave_numbers[:, None] * uvw[axis]) for axis in (0, 1))
    ok = ~flag.any(axis=0) & ~row_flag & (one != other)
    return u, v, ok[channels], weight.mean(axis=0)[channels]


def counted(u, v, weight, side, cell_rad):
    """Summed weight in each cell, sample after sample; the rule is that of the imager tool."""
    scale, middle, grid = np.float32(side * cell_rad), np.float32(side // 2), {}
    for a, b, w in zip(u, v, weight):
        for sign in (1, -1):
            cell = int(np.float32(sign) * scale * a + middle), int(np.float32(sign) * scale * b + middle)
            if 0 < min(cell) and max(cell) < side:
                grid[cell] = grid.get(cell, 0.0) + float(w)
    return lambda a, b: grid[int(scale * a + middle), int(scale * b + middle)]


def expected_density(name, side, cell, channels=slice(None), others=()):
    """Density at the usable samples of `name`, counted over it and the other MeasurementSets."""
    parts = [raw_samples(n, channels) for n in (name, *others)]
    u, v, weight = (np.concatenate([part[k].T[part[2].T] for part in parts]) for k in (0, 1, 3))
    at = counted(u, v, weight, side, cell * ARCSEC)
    u, v, ok, _ = parts[0]
    return np.array([at(a, b) for a, b in zip(u.T[ok.T], v.T[ok.T])])


@pytest.mark.parametrize("which, cell", [(0, 0.3), (1, 1.0)], ids=["autocorrelations", "flags and spectra"])
@pytest.mark.parametrize("phasecenter", ["", "J2000 20h00m10s +40d50m00s"], ids=["field", "elsewhere"])
def test_density_is_a_plain_count(names, which, cell, phasecenter):
    """The first has short baselines in the central cell, where the autocorrelations would count."""
    selection = Selection(vis=(names[which],), datacolumn="data")
    density = sampling_density(read_visibilities(selection, phasecenter), selection, grid_of((90, 120), cell))
    expected = expected_density(names[which], 120, cell)
    assert density.dtype == np.float32
    assert np.unique(expected).size > 2
    np.testing.assert_allclose(density, expected, rtol=3e-6)


def test_density_of_several_measurement_sets_and_selections(names):
    """One has WEIGHT_SPECTRUM and one has not: imager crashes when it is given both together."""
    selection = Selection(vis=names, datacolumn="data", spw=("0:1~2", "0:1~2"), scan=("1,2", ""))
    density = sampling_density(read_visibilities(selection), selection, grid_of((128, 128), 1.0))
    channels = slice(1, 3)
    parts = [expected_density(names[k], 128, 1.0, channels, [names[1 - k]]) for k in (0, 1)]
    np.testing.assert_allclose(density, np.concatenate(parts), rtol=3e-6)


def test_density_of_pixels_that_are_not_square(names):
    """The uv cells are square, 1/(field of view of the larger side)."""
    selection = Selection(vis=names[1:], datacolumn="data")
    grid = ImageGrid((100, 60), (0.8 * ARCSEC, 2.0 * ARCSEC))
    density = sampling_density(read_visibilities(selection), selection, grid)
    np.testing.assert_allclose(density, expected_density(names[1], 150, 0.8), rtol=3e-6)


def test_density_where_one_measurement_set_has_nothing(names):
    selection, alone = (Selection(vis=vis, datacolumn="data", uvrange=">1500m") for vis in (names, names[1:]))
    grid = grid_of((100, 100), 1.0)
    density = sampling_density(read_visibilities(selection), selection, grid)
    np.testing.assert_array_equal(density, sampling_density(read_visibilities(alone), alone, grid))


def test_density_beside_a_measurement_set_flagged_whole(names, tmp_path):
    flagged = simulate(tmp_path / "flagged.ms")
    edit(flagged, "FLAG_ROW", np.ones_like)
    selection, alone = (Selection(vis=vis, datacolumn="data") for vis in ((flagged, names[1]), names[1:]))
    grid = grid_of((100, 100), 1.0)
    density = sampling_density(read_visibilities(selection), selection, grid)
    np.testing.assert_array_equal(density, sampling_density(read_visibilities(alone), alone, grid))


def test_density_is_positive_and_finite_whatever_the_weights(tmp_path):
    name = simulate(tmp_path / "bad.ms", weight_spectrum=True)
    clean = Selection(vis=(name,), datacolumn="data")
    grid = grid_of((64, 64), 4.0)
    good = sampling_density(read_visibilities(clean), clean, grid)

    def spoil(weight):
        weight[:, 0, ::11], weight[:, 1, 3::13], weight[:, 2, 5::17] = np.nan, -1e3, np.inf
        return weight

    edit(name, "WEIGHT_SPECTRUM", spoil)
    vis = read_visibilities(clean)
    density = sampling_density(vis, clean, grid)
    assert vis.size < good.size
    assert np.isfinite(density).all()
    assert (density >= vis.imaging_weight).all()
    assert density.max() <= good.max()


def test_nothing_is_written(names, tmp_path):
    before = {name: digest(name) for name in names}
    selection = Selection(vis=names, datacolumn="data")
    vis, grid = read_visibilities(selection), grid_of((64, 64), 1.0)
    sampling_density(vis, selection, grid)
    imaging_weights(vis, grid, Weighting("briggs", 0.0, uvtaper=("2arcsec",)))
    sum_of_weights(vis, vis.imaging_weight)
    assert {name: digest(name) for name in names} == before
    assert os.listdir(tmp_path) == []


def digest(name):
    files = (path for path in sorted(Path(name).rglob("*")) if path.is_file())
    return {str(path): hashlib.md5(path.read_bytes()).hexdigest() for path in files}


def grid_of(shape, cell, phasecenter=""):
    return ImageGrid(shape=shape, cell_rad=(cell * ARCSEC, cell * ARCSEC), phasecenter=phasecenter)


@pytest.fixture(scope="module")
def ragged(names):
    return read_visibilities(Selection(vis=names[1:], datacolumn="data"))


@pytest.mark.parametrize("npixels", [0, 24, 25])
def test_weights_follow_from_the_grid_of_synthesisimager(names, tmp_path, npixels):
    """w/G and w/(G·f² + 1) with the G that tclean writes of the cross-correlations, looked up sample by sample.

    (tclean counts the autocorrelations too when they are selected, though it images none of them.)
    """
    shape, cell = (80, 91), 7.0
    grid = tclean_density(names[0], str(tmp_path / "x"), shape, cell, npixels)
    u, v, ok, weight = raw_samples(names[0])
    density = []
    for a, b in zip(u.T[ok.T], v.T[ok.T]):
        i, j = (int(np.float32(n * cell * ARCSEC) * x + np.float32(n // 2)) for n, x in zip(grid.shape, (-a, b)))
        density.append(grid[i, j] if 0 < i < grid.shape[0] and 0 < j < grid.shape[1] else np.inf)
    density, weight = np.array(density), weight.T[ok.T]
    vis = read_visibilities(Selection(vis=names[:1], datacolumn="data"))
    scale = (5 * 10**0.7) ** 2 * grid.sum() / (grid**2).sum()
    for weighting, expected in (("uniform", weight / density), ("briggs", weight / (density * scale + 1))):
        weights = imaging_weights(vis, grid_of(shape, cell), Weighting(weighting, robust=-0.7, npixels=npixels))
        np.testing.assert_allclose(weights, expected, rtol=1e-5)


def tclean_density(name, root, shape, cell, npixels):
    import casatools

    utils, imager, ia = casatools.synthesisutils(), casatools.synthesisimager(), casatools.image()
    selection = dict.fromkeys(("field", "spw", "timestr", "uvdist", "antenna", "scan", "obs", "state"), "")
    selection |= {"msname": name, "antenna": "*&*", "datacolumn": "data", "savemodel": "none"}
    imager.selectdata(utils.checkselectionparams(selection))
    image = {"imagename": root, "imsize": list(shape), "cell": [f"{cell}arcsec"], "stokes": "I", "specmode": "mfs"}
    image |= {"projection": "SIN", "nchan": 1, "phasecenter": ""}
    imager.defineimage(image, {"gridder": "standard", "imagename": root})
    imager.setweighting(type="uniform", rmode="norm", npixels=npixels)
    ia.open(imager.getweightdensity())
    density = ia.getchunk()[:, :, 0, 0]
    ia.close()
    imager.done()
    return density


def test_briggs_lies_between_natural_and_uniform(ragged):
    grid = grid_of((100, 100), 1.0)
    natural, uniform = (imaging_weights(ragged, grid, Weighting(kind)) for kind in ("natural", "uniform"))
    np.testing.assert_array_equal(natural, ragged.imaging_weight)
    assert natural is not ragged.imaging_weight
    for robust, limit in ((4.0, natural), (-4.0, uniform)):
        weights = imaging_weights(ragged, grid, Weighting("briggs", robust))
        np.testing.assert_allclose(weights / weights.sum(), limit / limit.sum(), rtol=1e-4)


@settings(max_examples=30, deadline=None)
@given(hwhm=st.floats(0.5, 50.0), axis=st.sampled_from([0, 1]))
def test_taper_halves_at_its_half_width(ragged, hwhm, axis):
    """A sample at one half width along the taper's axis has half its weight; 0deg is north."""
    taper = [f"{hwhm}klambda", "1e6klambda", "0deg"] if axis else ["1e6klambda", f"{hwhm}klambda", "0deg"]
    ratio = imaging_weights(ragged, grid_of((64, 64), 1.0), Weighting(uvtaper=tuple(taper))) / ragged.imaging_weight
    expected = 2.0 ** -((ragged.uvw[axis] / (hwhm * 1e3)) ** 2)
    np.testing.assert_allclose(ratio, expected, atol=1e-5)


def test_taper_words(ragged):
    def weights(*uvtaper):
        return imaging_weights(ragged, grid_of((64, 64), 1.0), Weighting(uvtaper=uvtaper))

    half_width = 2 * math.log(2) / (math.pi * 3 * ARCSEC)  # of a Gaussian of FWHM 3 arcsec on the sky
    np.testing.assert_allclose(weights("3arcsec"), weights(f"{half_width}lambda"), rtol=1e-5)
    np.testing.assert_allclose(weights("3arcsec"), weights("3arcsec", "3arcsec", "20deg"), rtol=1e-5)
    np.testing.assert_array_equal(weights("20klambda"), weights("20000"))
    np.testing.assert_array_equal(weights("0.02Mlambda"), weights("20klambda"))
    np.testing.assert_array_equal(weights(""), ragged.imaging_weight)
    east, north = weights("20klambda", "5klambda", "90deg"), weights("5klambda", "20klambda", "0deg")
    np.testing.assert_allclose(east, north, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(
    "weighting, words",
    [
        (Weighting("radial"), "weighting = 'radial'"),
        (Weighting(uvtaper=("5kparsec",)), "uvtaper = '5kparsec'"),
        (Weighting(uvtaper=("0arcsec",)), "uvtaper = '0arcsec'"),
        (Weighting(uvtaper=("1arcsec", "1arcsec", "20klambda")), "uvtaper = '20klambda'"),
        (Weighting(uvtaper=("1arcsec",) * 4), "uvtaper = .* has 4 entries"),
        (Weighting("uniform", npixels=1), "npixels = 1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_wrong_words_are_refused(ragged, weighting, words):
    with pytest.raises(ValueError, match=words):
        imaging_weights(ragged, grid_of((64, 64), 1.0), weighting)


def test_sum_of_weights_counts_the_hands(names, tmp_path):
    one_hand = simulate(tmp_path / "one.ms", correlations="XX", noise=0.1)
    for name, hands in ((names[0], 2), (one_hand, 1)):
        selection = Selection(vis=(name,), datacolumn="data")
        vis = read_visibilities(selection)
        expected = hands * vis.imaging_weight.sum(dtype=float)
        assert sum_of_weights(vis, vis.imaging_weight) == pytest.approx(expected, rel=1e-6)


def test_dirty_image_is_the_plain_sum():
    rng = np.random.default_rng(3)
    uv, vis = rng.uniform(-2e3, 2e3, (2, 40)), rng.normal(size=40) + 1j * rng.normal(size=40)
    weights, cell = rng.uniform(0.1, 1, 40).astype(np.float32), 20 * ARCSEC
    operator = MeasurementOperator(uv, (cell, cell), (16, 13), dtype=np.float64, eps=1e-10)
    l, m = -(np.arange(16) - 8) * cell, (np.arange(13) - 6) * cell
    kernel = np.exp(-2j * np.pi * (uv[0] * l[:, None, None] + uv[1] * m[:, None]))
    expected = (kernel @ (weights * vis)).real / weights.sum(dtype=float)
    np.testing.assert_allclose(dirty_image(operator, vis, weights), expected, atol=1e-7)
    assert dirty_image(operator, 1, weights)[8, 6] == pytest.approx(1, abs=1e-7)
    with pytest.raises(ValueError, match="weights of all samples are zero"):
        dirty_image(operator, vis, np.zeros(40, np.float32))
