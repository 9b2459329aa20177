"""The matched filters that detect emission, and the convolution that they use; against explicit Fourier sums."""

import numpy as np
import pytest
from fourier_sums import BEAM, NOISE, SPREAD, Sums, gaussian, pixel
from scipy.signal import convolve2d

from casa_sara.solver.convolution import convolve_valid
from casa_sara.solver.matched_filter import MatchedFilter


@pytest.fixture(scope="module")
def sums():
    return Sums((72, 64))


@pytest.fixture(scope="module")
def filter_(sums):
    return MatchedFilter(sums.psf)


def test_widths_of_the_filters(filter_):
    """In beams, up to a quarter of the image; the beam is that of a Gaussian spread of samples."""
    assert filter_.beam == pytest.approx(BEAM, rel=0.07)
    np.testing.assert_allclose(filter_.widths, filter_.beam * np.array([0, 1, 2, 4]))


@pytest.mark.parametrize("scale", range(4))
def test_snr_of_a_residual_is_the_product_with_a_source(sums, filter_, scale):
    residual = sums.noise(1) + sums.of((60 * NOISE, 33.3, 27.6, 5), (-15 * NOISE, 44, 36, 0))
    gradient = sums.gradient(residual)
    snr = filter_.snr(filter_.spectrum(gradient), scale)
    assert snr.shape == sums.shape
    found, expected = [], []
    for x, y in [(36, 32), (33, 28), (44, 36), (40, 25), (30, 38)]:
        source = gaussian(sums.shape, x, y, filter_.widths[scale])
        found.append(snr[x, y])
        expected.append(np.vdot(source, gradient) / sums.strength(source))
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    assert np.abs(expected).max() > 8
    middle = gaussian(sums.shape, 36, 32, filter_.widths[scale])
    assert filter_.norm(scale) == pytest.approx(sums.strength(middle), rel=1e-3)


@pytest.mark.parametrize("scale", range(4))
def test_what_the_model_holds_nearby_is_given_back(sums, filter_, scale):
    """⟨q, Φ†Σ⁻¹Φx_near⟩/‖Σ^{−½}Φq‖, of a source within the response of the template and of none beyond it."""
    width = np.hypot(filter_.beam, filter_.widths[scale])  # FWHM of the response
    x, y = 36, 32
    source = gaussian(sums.shape, x, y, filter_.widths[scale])
    near = pixel(sums.shape, x + int(0.45 * width), y, 20 * NOISE) + pixel(sums.shape, x, y - 1, 10 * NOISE)
    far = pixel(sums.shape, x - int(1.4 * width) - 2, y - 3, 90 * NOISE)
    far[x, min(y + int(1.5 * width) + 2, 63)] = -70 * NOISE
    added = filter_.nearby(near + far, scale)
    expected = np.vdot(source, sums.hessian(near)) / sums.strength(source)
    assert expected > 3
    assert added[x, y] == pytest.approx(expected, rel=3e-3)


def test_a_source_has_the_same_snr_whatever_the_model_holds_of_it(sums, filter_):
    """Nothing, a half, all of it, or twice as much: T is that of the data without the other source, 12."""
    x, y = 30, 36
    truth = pixel(sums.shape, x, y, 12 / sums.strength(pixel(sums.shape, x, y)))
    other = pixel(sums.shape, 47, 20, 1.0)
    vis = sums.forward(truth + other)
    for held in (0, 0.5, 1, 2):
        model = held * truth + other
        gradient = filter_.spectrum(sums.gradient(vis - sums.forward(model)))
        assert (filter_.snr(gradient, 0) + filter_.nearby(model, 0))[x, y] == pytest.approx(12, rel=2e-3)


@pytest.mark.parametrize("scale", range(4))
def test_the_edges_of_the_image_are_not_neighbours(sums, filter_, scale):
    """What is at one edge adds nothing at the other."""
    for x, y, far in [(0, 32, np.s_[-5:]), (36, 63, np.s_[:, :5])]:
        source = pixel(sums.shape, x, y)
        for found in (filter_.snr(filter_.spectrum(source), scale), filter_.nearby(source, scale)):
            assert np.abs(found[far]).max() < 1e-4 * found[x, y]


@pytest.fixture(scope="module")
def hollow():
    """Nothing from the middle of the uv plane, as compact arrays see it: wide templates lie between their baselines."""
    return Sums((72, 64), shortest=1.3 * SPREAD)


def test_a_template_that_the_edge_cuts_has_the_noise_of_what_is_left(hollow):
    """Against explicit sums, where what is cut off raises it and where it does not."""
    filter_ = MatchedFilter(hollow.psf)
    gradient = hollow.gradient(hollow.noise(3))
    spectrum, raised = filter_.spectrum(gradient), 0
    for scale in (1, 2, 3):
        snr = filter_.snr(spectrum, scale)
        whole = hollow.strength(gaussian(hollow.shape, 36, 32, filter_.widths[scale]))
        for x, y in [(0, 30), (1, 35), (4, 28), (71, 33), (68, 30), (40, 0), (33, 2), (30, 63), (36, 60), (36, 32)]:
            source = gaussian(hollow.shape, x, y, filter_.widths[scale])
            left = hollow.strength(source)
            raised += left > 1.3 * whole
            assert snr[x, y] * max(left, whole) == pytest.approx(np.vdot(source, gradient), rel=0.1), (scale, x, y)
    assert raised >= 5


def test_noise_is_no_source_at_the_edges(hollow):
    filter_ = MatchedFilter(hollow.psf)
    for scale in range(len(filter_.widths)):
        snr = [filter_.snr(filter_.spectrum(hollow.gradient(hollow.noise(seed))), scale) for seed in range(60)]
        assert np.square(snr).mean(axis=0)[:4].mean() < 1.15
        assert np.square(snr).mean(axis=0)[:, -4:].mean() < 1.15


def test_baselines_within_a_site_do_not_widen_the_beam(sums):
    """They hold most of the weight, as in VLBI, and see the whole image as a point: a plateau under the beam."""
    of_site = Sums(sums.shape, within_a_site=700)
    of_site.weight[:700] *= 2
    assert of_site.psf.min() > 0.5 * of_site.psf.max()
    filter_ = MatchedFilter(of_site.psf)
    assert filter_.beam == pytest.approx(BEAM, rel=0.1)
    far = filter_.nearby(pixel(sums.shape, 36, 32), 0)
    assert far[36, 32] > 0 and np.abs(far[36 + 8]).max() < 1e-4 * far[36, 32]


def test_snr_of_noise_has_unit_variance(sums, filter_):
    values = [[] for _ in filter_.widths]
    for seed in range(150):
        gradient = filter_.spectrum(sums.gradient(sums.noise(seed)))
        for scale in range(len(values)):
            values[scale].append(filter_.snr(gradient, scale)[18:-18, 18:-18])
    for scale, snr in enumerate(values):
        snr = np.array(snr)
        assert snr.mean() == pytest.approx(0, abs=0.2), scale
        assert snr.var() == pytest.approx(1, abs=0.2 if scale == 3 else 0.1), scale


@pytest.mark.parametrize("level, expected", [(0.1, 0.25), (0.5, 0.6), (0.7, 0.84), (0.95, 0.9)])
def test_the_largest_sidelobe_of_a_point_spread_function_is_found(level, expected):
    """1.2 times as large as it is, but at least a quarter and at most 0.9; the main lobe is none."""
    lobes = [(1, 0, 0), (level, 17, 5), (level, -17, -5)]
    psf = sum(factor * gaussian((72, 64), 36 + i, 32 + j, 4.0) for factor, i, j in lobes)
    assert MatchedFilter(50 * psf).sidelobe == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("image, kernel",
                         [((21, 18), (8, 5)), ((9, 9), (9, 9)), ((12, 7), (1, 4)), ((1, 6), (1, 1)), ((5, 5), (1, 1))])
def test_convolution_is_that_of_scipy(image, kernel):
    rng = np.random.default_rng(8)
    a, b = rng.standard_normal(image), rng.standard_normal(kernel)
    np.testing.assert_allclose(convolve_valid(a, b), convolve2d(a, b, mode="valid"), atol=1e-12)
