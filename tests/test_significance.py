"""The support of what is significant: matched filters, points, islands, what is left; against explicit Fourier sums."""

import numpy as np
import pytest
from dense_problem import Problem
from scipy.optimize import nnls
from scipy.signal import convolve2d
from test_visibilities import observation

from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.problem import Samples
from casa_sara.reconstruction import Control, reconstruct
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.checkpoint import Checkpoint
from casa_sara.solver.convolution import convolve_valid
from casa_sara.solver.islands import islands_of, look_at
from casa_sara.solver.l1_weights import band_noise, first_weights, reweight
from casa_sara.solver.l2_bounds import GivenBounds
from casa_sara.solver.matched_filter import MatchedFilter
from casa_sara.solver.point_sources import PointSources
from casa_sara.solver.record import CONVERGED, NOISE_ONLY, STOPPED_BY_USER, STRUCTURED, SolverRecord
from casa_sara.solver.reweighting import Schedule, Stage, solve
from casa_sara.solver.significance import SignificantSupport, gradient_image, matched_filter
from casa_sara.solver.statefile import read, write
from casa_sara.solver.unresolved import unresolved
from casa_sara.visibilities import sort_into_blocks

CELL = 1e-6
BEAM = 3.5  # FWHM in pixels of what samples of this spread see
SPREAD = 2 * np.log(2) / (np.pi * np.sqrt(2 * np.log(2)) * BEAM)  # standard deviation of uv, cycles per pixel
NOISE = 0.003  # Jy/beam, of the whole


class Sums:
    """Φ as explicit Fourier sums, with the inverse variances of samples.

    A source is (flux, x, y, FWHM), anywhere between pixels.
    """

    def __init__(self, shape, size=1200, seed=41, shortest=0.0, within_a_site=0):
        rng = np.random.default_rng(seed)
        self.shape, self.size = shape, size
        u, v = np.clip(rng.normal(0, SPREAD, (2, 4 * size if shortest else size)), -0.45, 0.45)  # cycles per pixel
        long = np.flatnonzero(np.hypot(u, v) >= shortest)[:size]
        self.u, self.v = u[long], v[long]
        self.u[:within_a_site], self.v[:within_a_site] = 0, 1e-6
        self.weight = rng.uniform(0.5, 1.5, size) / NOISE**2 / size
        self._rows = np.exp(-2j * np.pi * np.outer(self.u, np.arange(shape[0]) - shape[0] // 2))
        self._columns = np.exp(2j * np.pi * np.outer(self.v, np.arange(shape[1]) - shape[1] // 2))

    def forward(self, image):
        return ((self._rows @ image) * self._columns).sum(axis=1)

    def gradient(self, vis):
        """Φ†Σ⁻¹ of visibilities."""
        return (self._rows.conj().T @ ((self.weight * vis)[:, None] * self._columns.conj())).real

    def hessian(self, image):
        return self.gradient(self.forward(image))

    @property
    def psf(self):
        return self.hessian(pixel(self.shape, *(n // 2 for n in self.shape)))

    def strength(self, image):
        """‖Σ^{−½}Φx‖."""
        return np.sqrt(self.weight @ np.abs(self.forward(image)) ** 2)

    def of(self, *sources):
        """Visibilities of sources."""
        vis = np.zeros(self.size, complex)
        for flux, x, y, fwhm in sources:
            phase = -self.u * (x - self.shape[0] // 2) + self.v * (y - self.shape[1] // 2)
            decay = np.exp(-((np.pi * fwhm) ** 2) * (self.u**2 + self.v**2) / (4 * np.log(2)))
            vis += flux * decay * np.exp(2j * np.pi * phase)
        return vis

    def noise(self, seed):
        rng = np.random.default_rng(1000 + seed)
        return (rng.standard_normal(self.size) + 1j * rng.standard_normal(self.size)) / np.sqrt(self.weight)


def pixel(shape, x, y, value=1.0):
    image = np.zeros(shape)
    image[x, y] = value
    return image


def gaussian(shape, x, y, fwhm):
    """A sampled Gaussian, whose sum over an infinite grid is 1; a pixel where the width is 0."""
    if not fwhm:
        return pixel(shape, x, y)
    i, j = np.ogrid[:shape[0], :shape[1]]
    return np.exp(-4 * np.log(2) * ((i - x) ** 2 + (j - y) ** 2) / fwhm**2) * 4 * np.log(2) / (np.pi * fwhm**2)


def distance(shape, x, y):
    return np.hypot(*np.ogrid[-x:shape[0] - x, -y:shape[1] - y])


# ---- the matched filters


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


@pytest.mark.parametrize("image, kernel", [((21, 18), (8, 5)), ((9, 9), (9, 9)), ((12, 7), (1, 4)), ((1, 6), (1, 1)), ((5, 5), (1, 1))])
def test_convolution_is_that_of_scipy(image, kernel):
    rng = np.random.default_rng(8)
    a, b = rng.standard_normal(image), rng.standard_normal(kernel)
    np.testing.assert_allclose(convolve_valid(a, b), convolve2d(a, b, mode="valid"), atol=1e-12)


# ---- the support, in whole solutions


OPTIONS = dict(wavelets=("dirac", "db1", "db2", "db4"), wavelevels=3)


def image(sources=(), shape=(48, 48), seed=2, support=None, stop_at=None, checkpoint=None, louder=1.0, **changes):
    """Solve for the image of sources, whose positions count from the middle, and noise."""
    sums = Sums(shape)
    data = observation([(0, 0, 0, 0, 60), (0, 0, 1, 1e4, 60)])
    data, offsets = sort_into_blocks(data, data.rows.scan[data.row])
    data.uvw[:] = sums.u / CELL, sums.v / CELL, 0 * sums.u
    data.weight[:] = sums.weight
    data.vis[:] = sums.of(*((flux, shape[0] // 2 + x, shape[1] // 2 + y, fwhm) for flux, x, y, fwhm in sources))
    data.vis += louder * sums.noise(seed)
    reached, grid = [0], ImageGrid(shape, (CELL, CELL))
    samples = Samples(data, offsets, np.ones(data.size), np.ones(2))
    return reconstruct(samples, grid, SolverOptions(**OPTIONS | changes), support=support, control=Control(
        lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))


POINT = (20 * NOISE, 6.0, -4.0, 0)


@pytest.mark.parametrize("seed", range(4))
def test_of_noise_nothing_remains(seed):
    found = image(seed=seed)
    assert not found.model.any() and found.record.islands == []
    assert found.record.stop_code in (NOISE_ONLY, CONVERGED) and found.record.iteration[-1] <= 150
    assert [entry["beams"] for entry in found.record.residual_snr] == [0, 1, 2]


@pytest.mark.parametrize("x, y", [(6.0, -4.0), (6.3, -3.6)])
@pytest.mark.parametrize("seed", [3, 5, 7])
def test_a_source_is_found_alone_and_its_flux_is_right(seed, x, y):
    found = image([(20 * NOISE, x, y, 0)], seed=seed)
    (island,) = found.record.islands
    assert found.record.stop_code == CONVERGED
    assert abs(island["flux_jy"] - 20 * NOISE) < 3 * island["flux_error_jy"]
    assert 0.6 * NOISE < island["flux_error_jy"] < 1.5 * NOISE and 14 < island["snr"] < 23
    assert abs(island["x"] - 24 - x) < 0.4 and abs(island["y"] - 24 - y) < 0.4
    assert not found.model[distance((48, 48), 30, 20) > 2 * BEAM].any()
    assert found.model.sum() == pytest.approx(island["flux_jy"], rel=1e-5)
    # a support from the first re-weighting on, which ends up a point's
    pixels = [update["support"] for update in found.record.reweightings]
    assert 0 < min(pixels) and max(pixels) < 150 and pixels[-1] == 36


def test_the_size_of_the_image_does_not_matter():
    (narrow,), (wide,) = (image([POINT], shape).record.islands for shape in [(48, 48), (96, 96)])
    assert abs(wide["flux_jy"] - narrow["flux_jy"]) < narrow["flux_error_jy"]
    assert wide["x"] - narrow["x"] == pytest.approx(24, abs=0.2) == wide["y"] - narrow["y"]


def test_an_extended_source_keeps_its_flux_and_its_width():
    """Of 3 beams, with a peak of 30 σ; little of the image beside it is in the model."""
    flux = 30 * NOISE * 10
    found = image([(flux, 1.0, 2.0, 3 * BEAM)], (64, 64), seed=3)
    island = found.record.islands[0]
    assert found.record.stop_code == CONVERGED
    assert found.model.sum() == pytest.approx(flux, rel=0.1)
    assert island["fwhm_pixels"] == pytest.approx(3 * BEAM, rel=0.15) and island["snr"] > 50
    assert not found.model[distance((64, 64), 33, 34) > 7 * BEAM].any()


def test_without_significance_the_noise_is_fitted():
    found = image([POINT], significance=0.0)
    far = distance((48, 48), 30, 20) > 3 * BEAM
    assert np.count_nonzero(found.model[far]) > 200
    assert found.record.islands == [] == found.record.residual_snr
    assert {update["support"] for update in found.record.reweightings} == {48 * 48}
    # there is no support without a re-weighting
    never, none = (image([POINT], significance=value, nreweights=0) for value in (5.0, 0.0))
    np.testing.assert_array_equal(never.model, none.model)
    assert never.record.residual_snr == []


def test_a_fainter_source_needs_less_significance():
    """Of 7 σ: in the model at 5, not at 9."""
    sources = [(7 * NOISE, 6, -4, 0)]
    assert image(sources, significance=5.0).model[28:33, 18:23].sum() > 4 * NOISE
    assert not image(sources, significance=9.0).model.any()


def test_a_negative_source_is_found_where_the_model_may_be_negative():
    sources = [(-20 * NOISE, 6.0, -4.0, 0), (25 * NOISE, -12, 10, 0)]
    found = image(sources, positivity=False)
    assert found.model[distance((48, 48), 30, 20) < BEAM].sum() == pytest.approx(-20 * NOISE, rel=0.25)
    assert found.model[distance((48, 48), 12, 34) < BEAM].sum() == pytest.approx(25 * NOISE, rel=0.25)
    far = np.minimum(distance((48, 48), 30, 20), distance((48, 48), 12, 34)) > 3 * BEAM
    assert not found.model[far].any()
    positive = image(sources, positivity=True).model
    assert not positive[distance((48, 48), 30, 20) < BEAM].any() and positive.min() > -0.03 * positive.sum()


def test_noise_that_the_weights_do_not_tell_is_measured():
    """Twice as loud: its peaks are above 5 times what the weights say, and of no source."""
    found = image(seed=4, louder=2.0, databound="fixed", l2bound=(1.0,), niter=400)
    assert found.record.residual_snr[0]["snr"] > 5
    assert not found.model.any()


# ---- masks


MASK = np.zeros((48, 48), bool)
MASK[24:36, 16:30] = True
HIDDEN = (100 * NOISE, -12.0, 8.0, 2 * BEAM)  # outside


@pytest.fixture(scope="module")
def masked():
    return {name: image([POINT, *sources], support=MASK) for name, sources in [("alone", []), ("hidden", [HIDDEN])]}


def test_mask_and_support_are_both_kept(masked):
    for found in masked.values():
        assert not found.model[~MASK].any()
        assert np.count_nonzero(found.model) <= 36  # of 168 in the mask
        assert found.model[MASK].sum() == pytest.approx(POINT[0], rel=0.2)


def test_what_is_left_of_an_extended_source_is_told(masked):
    assert masked["alone"].record.stop_code == CONVERGED
    assert masked["hidden"].record.stop_code == STRUCTURED
    assert masked["hidden"].record.stop_description == "converged, but the residual is not noise"
    assert max(entry["snr"] for entry in masked["hidden"].record.residual_snr[1:]) > 5


@pytest.mark.parametrize("positivity, free", [(True, 0), (False, -np.inf)])
def test_supports_follow_each_other_within_the_mask(positivity, free):
    """What comes back is free again; bounds that have been lowered stay; the mask stays; the model obeys."""
    problem = Problem(seed=5)
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                      problem.data_norm_sq(problem.precond), positivity)
    mask = np.ones((4, 4), bool)
    mask[:, 3] = False
    ppd.confine(mask)
    ppd.start_from(np.ones((4, 4)))
    ppd.threshold = 0.1
    ppd.lowest[1, 1] = -0.5
    first, second = np.zeros((4, 4), bool), np.zeros((4, 4), bool)
    first[0:2], second[1:3] = True, True
    for support in (first, second, first):
        given = support.copy()
        ppd.support_only(support)
        np.testing.assert_array_equal(support, given)
        for _ in range(3):
            ppd.step()
        np.testing.assert_array_equal(ppd.lowest == np.inf, ~(support & mask))
        assert not ppd.model[~(support & mask)].any() and ppd.model[support & mask].any()
        expected = np.where(support & mask, free, np.inf)
        expected[1, 1] = -0.5
        np.testing.assert_array_equal(ppd.lowest, expected)


# ---- sources that one point explains


def narrowed(sums, filter_, vis, model=None, places=((40, 27),), more=False):
    """Return the pixels above 2.5 within 3 beams of the places, with `more`, and the support and points they become."""
    model = np.zeros(sums.shape) if model is None else model
    gradient = sums.gradient(vis - sums.forward(model))
    support = filter_.snr(filter_.spectrum(gradient), 0) + filter_.nearby(model, 0) >= 2.5
    support &= np.any([distance(sums.shape, *place) < 3 * BEAM for place in places], axis=0)
    support |= more
    after, points = unresolved(filter_, gradient, model, support, np.ones(sums.shape, bool), 5.0)
    assert after[points.x, points.y].all()
    return support, after, points


def of_snr(sums, peak, *sources):
    """Noise-free visibilities whose largest S/N, of a point, is `peak`."""
    vis = sums.of(*sources)
    return vis * peak / (sums.gradient(vis).max() / sums.strength(pixel(sums.shape, 36, 32)))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("held", [0, 1])
def test_a_lone_point_between_pixels_is_narrowed(sums, filter_, seed, held):
    """Whether the model holds nothing of it, or all of it as wide as a beam."""
    vis = of_snr(sums, 30, (1, 40.3, 26.8, 0))
    spread = gaussian(sums.shape, 40.3, 26.8, BEAM)
    model = held * spread * 30 * NOISE
    before, support, points = narrowed(sums, filter_, vis + sums.noise(seed), model)
    near = distance(sums.shape, 40, 27)
    assert before[near < 1.5 * BEAM].sum() > 20  # there was something to narrow
    np.testing.assert_allclose(points.places, [(40.3, 26.8)], atol=0.2)  # 0.05 pixels of noise at S/N 30
    pixels = points.pixels(sums.shape)
    assert pixels.sum() == 36
    np.testing.assert_array_equal(support[near <= 1.75 * BEAM - 1], pixels[near <= 1.75 * BEAM - 1])
    far = near > 1.75 * filter_.beam + 2
    np.testing.assert_array_equal(support[far], before[far])


@pytest.mark.parametrize("sources", [
    [(1, 40.3, 26.8, 1.5 * BEAM)],
    [(1, 40 - BEAM / 2, 27, 0), (1, 40 + BEAM / 2, 27, 0)],
    [(1, 40, 27 - BEAM / 2, 0), (0.6, 40, 27 + BEAM / 2, 0)],
], ids=["gaussian", "two", "unequal"])
def test_what_is_not_one_point_stays_as_it_is(sums, filter_, sources):
    for seed in range(3):
        before, support, points = narrowed(sums, filter_, of_snr(sums, 30, *sources) + sums.noise(seed))
        assert before.sum() > 20
        np.testing.assert_array_equal(support, before)
        assert not len(points)


def test_a_faint_halo_keeps_a_point_from_being_one(sums, filter_):
    """What a point leaves may be below 3.5 σ by pixels, and above it over a beam."""
    vis = sums.of((20 * NOISE, 40, 27, 0), (5 * NOISE * 5, 40, 27, 2 * BEAM))
    assert not len(narrowed(sums, filter_, vis)[2])
    assert len(narrowed(sums, filter_, sums.of((25 * NOISE, 40, 27, 0)))[2])


def test_a_neighbour_does_not_hide_a_point(sums, filter_):
    """Two points, 5 beams from each other, known to the model or not: both are narrowed."""
    vis = of_snr(sums, 30, (1, 30, 26, 0), (0.7, 30, 44, 0)) + sums.noise(0)
    for model in (None, pixel(sums.shape, 30, 44, 20 * NOISE)):
        _, _, points = narrowed(sums, filter_, vis, model, [(30, 26), (30, 44)])
        np.testing.assert_allclose(points.places, [(30, 26), (30, 44)], atol=0.25)


def test_a_point_that_holds_too_much_flux_is_none(sums, filter_):
    """The model has twice the flux of the point there: more is around than the point."""
    vis = of_snr(sums, 30, (1, 40, 27, 0))
    flux = 30 * NOISE
    assert len(narrowed(sums, filter_, vis, pixel(sums.shape, 40, 27, flux))[2])
    assert not len(narrowed(sums, filter_, vis, pixel(sums.shape, 40, 27, flux) + pixel(sums.shape, 41, 27, flux))[2])


@pytest.mark.parametrize("x, y", [(0, 0), (71, 63), (1, 30), (36, 61), (0, 63)])
def test_at_the_edge_nothing_is_lost(sums, filter_, x, y):
    """Where the pixels of a point would reach over the edge the support stays; 4 pixels from it there is enough to tell."""
    vis = of_snr(sums, 30, (1, x, y, 0))
    before, support, points = narrowed(sums, filter_, vis, places=[(x, y)])
    assert support[x, y] and not len(points)
    np.testing.assert_array_equal(support, before)
    x, y = np.clip([x, y], 4, np.array(sums.shape) - 5)
    _, _, points = narrowed(sums, filter_, of_snr(sums, 30, (1, x, y, 0)), places=[(x, y)])
    np.testing.assert_allclose(points.places, [(x, y)], atol=0.1)


def test_a_point_whose_pixels_a_mask_cuts_is_none(sums, filter_):
    vis, everywhere = of_snr(sums, 30, (1, 40.2, 27.1, 0)), np.ones(sums.shape, bool)
    support, nothing = distance(sums.shape, 40, 27) < 2 * BEAM, np.zeros(sums.shape)
    for cut, number in [((40, 31), 1), ((40, 30), 0), ((37, 27), 1), ((38, 27), 0)]:
        allowed = everywhere.copy()
        allowed[cut] = False
        assert len(unresolved(filter_, sums.gradient(vis), nothing, support, allowed, 5.0)[1]) == number


def test_what_belonged_to_a_point_alone_goes_with_it(sums, filter_):
    """A tongue of the region around a point, as noise above half of the significance makes them."""
    tongue = np.zeros(sums.shape, bool)
    tongue[40, 27:27 + int(3 * BEAM)] = True
    _, support, points = narrowed(sums, filter_, of_snr(sums, 30, (1, 40, 27, 0)), more=tongue)
    np.testing.assert_array_equal(support, points.pixels(sums.shape))
    assert support.sum() == 36


@pytest.mark.parametrize("place", [(40.5, 26.5), (39.8, 27.3), (33.999, 28.001), (36.0, 30.0)])
def test_a_point_between_pixels_is_one_in_the_data(sums, place):
    """3 % off at worst, root mean square, where the beam has 3.5 pixels, and less than 1e-3 where it has 7."""
    point = PointSources([place])
    on_pixel = place == (36.0, 30.0)
    for finer, tolerance in [(1, 0.035), (2, 1e-3)]:
        u, v = sums.u / finer, sums.v / finer
        found = np.exp(-2j * np.pi * (np.outer(u, point.x[0]) - np.outer(v, point.y[0]))) @ point.shapes[0]
        expected = np.exp(-2j * np.pi * (u * place[0] - v * place[1]))
        error = np.sqrt(sums.weight @ np.abs(found - expected) ** 2 / sums.weight.sum())
        assert error < (1e-12 if on_pixel else tolerance)
    assert point.shapes.sum() == pytest.approx(1) and point.shapes.min() > -0.1


def test_only_the_flux_of_points_is_free():
    """The projection is the nearest of the multiples of the shape; the sums change as those of the images do."""
    rng = np.random.default_rng(4)
    points = PointSources([(5.3, 6.6), (14.0, 12.9), (6.2, 16.5)])
    x, free, anchor = rng.standard_normal((3, 22, 24)).astype(np.float32)
    free[points.x[0], points.y[0]] += 3 * points.shapes[0].astype(np.float32)
    free[points.x[2], points.y[2]] -= 3 * points.shapes[2].astype(np.float32)
    model, bar = free.copy(), 2 * free - anchor
    change = points.project(model, anchor, bar, points.values(x))
    at = points.pixels(x.shape)
    np.testing.assert_array_equal(model[~at], free[~at])
    np.testing.assert_allclose(bar, 2 * model - anchor, rtol=1e-6, atol=1e-6)
    fluxes = []
    for px, py, shape in zip(points.x, points.y, points.shapes):
        flux = nnls(shape[:, None], free[px, py].astype(float))[0][0]
        np.testing.assert_allclose(model[px, py], flux * shape, atol=1e-6)
        fluxes.append(flux)
    assert fluxes[0] > 2 and fluxes[2] == 0
    sums = [np.array([np.square(new - x, dtype=float).sum(), np.square(new, dtype=float).sum(), new.sum(dtype=float)])
            for new in (free, model)]
    np.testing.assert_allclose(change, sums[1] - sums[0], rtol=1e-4, atol=1e-4)


def test_points_come_and_go_with_the_support():
    """A pixel of a point is free of the bound of the others, and under it again when it is a point's no more."""
    _, ppd, _ = problem()
    ppd.l2_step, ppd.threshold, whole = 1e-6, 0.1, np.ones(ppd.model.shape, bool)
    first, second = PointSources([(20.4, 15.2)]), PointSources([(23.0, 17.7), (9.1, 30.2)])
    for points in (first, second, PointSources()):
        ppd.support_only(whole, points)
        np.testing.assert_array_equal(ppd.lowest, np.where(points.pixels(whole.shape), -np.inf, 0))
        ppd.start_from(np.random.default_rng(1).uniform(0, 1, whole.shape))
        for _ in range(3):
            before = ppd.model.copy()
            ppd.step()
            held = ppd.model[points.x, points.y]
            np.testing.assert_allclose(held, held.sum(axis=1, keepdims=True) * points.shapes, atol=1e-6 * ppd.model.max())
            change = np.linalg.norm(ppd.model - before) / np.linalg.norm(ppd.model)
            assert ppd.rel_change == pytest.approx(change, rel=1e-4)
            assert (ppd.model_flux, ppd.model_max) == pytest.approx((ppd.model.sum(dtype=float), ppd.model.max()))
    state = ppd.state()
    assert state["points"].shape == (0, 2)


@pytest.mark.parametrize("x, y", [(6.5, -3.5), (6.3, -3.6), (6.0, -4.2)])
def test_the_flux_of_a_point_between_pixels_is_unbiased(x, y):
    """40 σ: positive pixels alone give 3 σ too much, as they are wider than a point."""
    found = [image([(40 * NOISE, x, y, 0)], seed=seed).model.sum() / NOISE for seed in range(3, 9)]
    assert np.mean(found) == pytest.approx(40, abs=1.2) and np.std(found) < 2


# ---- islands


def test_islands_of_nothing():
    assert islands_of(np.zeros((20, 30)), np.ones((20, 30))) == []


def test_islands_are_measured():
    """A wide Gaussian, two pixels that touch at a corner, a negative pixel in the box of the first, one at the edge."""
    sums = Sums((40, 50), 400)
    parts = [
        gaussian(sums.shape, 14.3, 20.7, 5.0) * 2.0,
        pixel(sums.shape, 30, 40, 0.02) + pixel(sums.shape, 31, 41, 0.06),
        pixel(sums.shape, 6, 13, -0.05),
        pixel(sums.shape, 0, 49, 0.01),
    ]
    parts[0][distance(sums.shape, 14, 21) > 9] = 0
    expected = sorted(parts, key=lambda part: -sums.strength(part))
    found = islands_of(sum(parts), sums.psf, unit_jy=0.5)
    assert len(found) == 4 and [island["snr"] for island in found] == sorted((i["snr"] for i in found), reverse=True)
    for island, part in zip(found, expected):
        snr = np.sqrt(np.vdot(part, sums.hessian(part)))
        assert island["snr"] == pytest.approx(snr, rel=1e-6) and snr == pytest.approx(sums.strength(part))
        assert island["flux_jy"] == pytest.approx(0.5 * part.sum())
        assert island["flux_error_jy"] == pytest.approx(0.5 * abs(part.sum()) / snr)
        assert island["pixels"] == np.count_nonzero(part)
    wide, pair, negative, corner = found
    assert (wide["x"], wide["y"]) == pytest.approx((14.3, 20.7), abs=0.02)
    assert wide["fwhm_pixels"] == pytest.approx(5.0, rel=0.01)
    assert (pair["x"], pair["y"]) == pytest.approx((30.75, 40.75))
    assert pair["fwhm_pixels"] == pytest.approx(2.35482 * np.sqrt(0.75 * 0.25))
    assert (negative["x"], negative["y"], negative["fwhm_pixels"]) == pytest.approx((6, 13, 0))
    assert negative["flux_jy"] < 0
    assert (corner["x"], corner["y"]) == (0, 49)


@pytest.mark.parametrize("place", [(14.3, 20.7), (10.5, 30.0), (22.0, 9.0)])
def test_the_island_of_a_point_between_pixels_is_a_point(sums, place):
    """At its place and without extent, though 36 pixels of both signs hold it; where both signs cancel, the modulus tells."""
    point = PointSources([place])
    model = np.zeros(sums.shape)
    model[point.x, point.y] = 0.3 * point.shapes
    (island,) = islands_of(model, sums.psf)
    assert (island["x"], island["y"]) == pytest.approx(place, abs=1e-6)
    assert island["flux_jy"] == pytest.approx(0.3) and island["fwhm_pixels"] < 1e-3
    (pair,) = islands_of(pixel(sums.shape, 10, 12) - pixel(sums.shape, 10, 13), sums.psf)
    assert (pair["x"], pair["y"]) == (10, 12.5) and pair["fwhm_pixels"] == pytest.approx(2.35482 * np.sqrt(0.125))


def test_flux_error_of_an_island_is_that_of_its_strength():
    """The strength of a known shape, fitted to many realisations of the noise, scatters by it."""
    sums = Sums((32, 32), 400)
    part = gaussian(sums.shape, 15, 17, 4.0) * 40 * NOISE
    part[part < 1e-3 * part.max()] = 0
    (island,) = islands_of(part, sums.psf)
    response = sums.weight * sums.forward(part)
    strength = [1 + np.vdot(response, sums.noise(seed)).real / sums.strength(part) ** 2 for seed in range(400)]
    assert part.sum() * np.std(strength) == pytest.approx(island["flux_error_jy"], rel=0.15)


# ---- what is left in the residual


def problem(shape=(48, 40), wavelets=("dirac", "db1", "db4"), levels=2, noise=(1.0, 1.0)):
    """The iteration in double precision, its bounds, and the sums that it stands for, noise levels included."""
    sums, offsets = Sums(shape), np.array([0, 500, 1200])
    whiten = np.sqrt(sums.weight)
    measurement = MeasurementOperator(np.array([sums.u, sums.v]) / CELL, CELL, shape, whiten, 1e-10, np.float64)
    dictionary = SaraDictionary(shape, wavelets, levels, np.float64)
    ppd = AdaptivePPD(measurement, dictionary, np.zeros(1200, complex), offsets, np.ones(1200), 1.0)
    ppd.threshold = 1.0
    samples = np.diff(offsets)
    sums.whiten = whiten
    weight_sums = np.add.reduceat(sums.weight, offsets[:-1])
    bounds = GivenBounds(np.array(noise) * np.sqrt(2.0 * samples), samples, weight_sums, len(wavelets))
    sums.weight = sums.weight / np.repeat(noise, samples) ** 2
    return sums, ppd, bounds


@pytest.mark.parametrize("noise", [(1.0, 1.0), (0.7, 1.6)])
def test_what_is_left_is_on_record(noise):
    """The largest |T| at every width, with the noise levels found, and the islands; all in explicit sums."""
    sums, ppd, bounds = problem(noise=noise)
    sums_of_residual = sums.of((-9 * NOISE, 20.2, 22.7, 0)) + sums.noise(3)
    ppd.model[...] = gaussian(sums.shape, 30, 15, 3.0) * (distance(sums.shape, 30, 15) < 6)
    ppd.vis[:] = sums.whiten * (sums.forward(ppd.model) + sums_of_residual)
    ppd.unit_jy = 2.0
    gradient = sums.gradient(sums_of_residual)
    np.testing.assert_allclose(gradient_image(ppd, bounds, ppd.model), gradient, atol=1e-6 * np.abs(gradient).max())
    filter_ = matched_filter(ppd, bounds)
    np.testing.assert_allclose(filter_.psf, sums.psf, atol=1e-6 * sums.psf.max())
    record = SolverRecord()
    look_at(ppd, bounds, record)
    assert [entry["beams"] for entry in record.residual_snr] == [0, 1, 2]  # 4 beams are wider than a quarter of 40
    for entry in record.residual_snr:
        width = entry["beams"] * filter_.beam
        rows, columns = ([gaussian((n, 1), k, 0, width)[:, 0] for k in range(n)] for n in sums.shape)
        scale = sum(rows[20]) * sum(columns[20])
        norm = sums.strength(gaussian(sums.shape, 24, 20, width))
        expected = np.abs(np.array(rows) @ gradient @ np.array(columns).T).max() / scale / norm
        assert entry["snr"] == pytest.approx(expected, rel=3e-3)
    (island,) = record.islands
    assert island["snr"] == pytest.approx(sums.strength(ppd.model), rel=1e-5)
    assert island["flux_jy"] == pytest.approx(2 * ppd.model.sum())


@pytest.mark.parametrize("fwhm, width, snr, structured", [
    (BEAM, 1, 5.5, True), (BEAM, 1, -5.5, True), (BEAM, 1, 4.5, False), (2 * BEAM, 2, 5.5, True), (0, 0, 5.6, False)])
def test_structure_is_more_than_five_sigma_over_a_beam(fwhm, width, snr, structured):
    """A residual without noise, scaled to the S/N wanted at its own width; a point of more than 5 σ is none."""
    sums, ppd, bounds = problem()
    residual = sums.of((1.0, 24.0, 20.0, fwhm))
    source = gaussian(sums.shape, 24, 20, width * matched_filter(ppd, bounds).beam)
    residual *= snr / (np.vdot(source, sums.gradient(residual)) / sums.strength(source))
    ppd.vis[:] = sums.whiten * residual
    record = SolverRecord()
    assert look_at(ppd, bounds, record) == structured
    assert record.residual_snr[width]["snr"] == pytest.approx(abs(snr), rel=2e-3) and record.islands == []


def test_noise_is_no_structure():
    sums, ppd, bounds = problem()
    for seed in range(5):
        ppd.vis[:] = sums.whiten * sums.noise(seed)
        assert not look_at(ppd, bounds, SolverRecord())


# ---- the support in a checkpoint


@pytest.mark.parametrize("support", [None, SignificantSupport(4.5), SignificantSupport(6.5, begun=True)])
def test_a_stage_comes_back_with_its_support(tmp_path, support):
    update = dict(iteration=60, scale=10.0, model_change=1.0, released=0, support=7)
    record = SolverRecord(iteration=[60], reweightings=[update], residual_snr=[dict(beams=0.0, snr=3.0)])
    stage = Stage(np.arange(6.0).reshape(2, 3), start=60, support=support, record=record)
    write(str(tmp_path / "s"), dict(version="1"), dict(stage=stage.state()))
    again = Stage.of(read(str(tmp_path / "s"))[1]["stage"])
    assert again.k == 1 and again.start == 60 and again.record.residual_snr == record.residual_snr
    if support is None:
        assert again.support is None
    else:
        assert (again.support.significance, again.support.begun) == (support.significance, support.begun)


def test_a_stopped_solution_goes_on_with_its_support(tmp_path):
    sources = [POINT, (60 * NOISE, -9.0, 10.0, 2 * BEAM)]
    wanted = image(sources)
    updates = [update["iteration"] for update in wanted.record.reweightings]
    for at in (updates[0] - 1, updates[1] + 4):  # before the first support, and between two
        path = str(tmp_path / str(at))
        stopped = image(sources, stop_at=at, checkpoint=Checkpoint(path, "1", {}))
        assert stopped.record.stop_code == STOPPED_BY_USER
        checkpoint = Checkpoint(path, "1", {})
        checkpoint.open()
        found = image(sources, checkpoint=checkpoint)
        np.testing.assert_array_equal(found.model, wanted.model)
        assert found.record.reweightings == wanted.record.reweightings and found.record.islands == wanted.record.islands


def test_the_first_support_holds_what_is_sure_and_the_next_what_is_significant():
    """Sources of 200, 20 and 9 σ: the first support leaves out what may be a sidelobe of the brightest."""
    sums, ppd, bounds = problem()
    places = {200: (12, 12), 20: (34, 26), 9: (14, 30)}
    ppd.vis[:] = sums.whiten * (sums.of(*((snr * NOISE, *place, 0) for snr, place in places.items())) + sums.noise(1))
    support = SignificantSupport(5.0)
    inside = []
    for _ in range(3):
        assert support.update(ppd, bounds) == np.count_nonzero(ppd.lowest < np.inf)
        inside.append([bool(ppd.lowest[place] < np.inf) for place in places.values()])
        ppd.model[...] = sum(pixel(sums.shape, *place, snr * NOISE * (ppd.lowest[place] < np.inf))
                             for snr, place in places.items())
        assert support.begun
    assert inside == [[True, False, False], [True, True, True], [True, True, True]]


def test_a_support_is_found_with_the_filter_of_the_present_noise(monkeypatch):
    """The filter is kept while the noise levels are the same, and made anew when they are not."""
    sums, ppd, bounds = problem()
    ppd.vis[:] = sums.whiten * (sums.of((20 * NOISE, 12, 12, 0), (7 * NOISE, 34, 26, 0)) + sums.noise(1))
    made, support = [], SignificantSupport(5.0)
    monkeypatch.setattr("casa_sara.solver.significance.MatchedFilter", lambda *of: made.append(1) or MatchedFilter(*of))
    support.update(ppd, bounds)
    found = []
    for noise, filters in (((1.0, 1.0), 1), ((1.0, 1.0), 1), ((2.0, 2.5), 2)):
        bounds.l2_bounds = np.array(noise) * np.sqrt(2.0 * bounds.samples)
        support.update(ppd, bounds)
        assert len(made) == filters
        found.append(ppd.lowest.copy())
        SignificantSupport(5.0, begun=True).update(ppd, bounds)
        np.testing.assert_array_equal(ppd.lowest, found[-1])
        made.pop()
    assert not np.array_equal(found[0], found[2])  # 7 σ are not significant any more


# ---- the weights within a support


def mean_square_around(coefs):
    return sum(np.roll(coefs**2, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)) / 9


@pytest.mark.parametrize("confined", [False, True])
@pytest.mark.parametrize("noise", [(1.0, 1.0), (0.7, 1.6)])
def test_weights_within_a_support(confined, noise):
    """W = ν α/(α + d̄), α = scale × min(noise, pixel), over ν if confined; approximations then have 0.12 of it."""
    sums, ppd, bounds = problem(noise=noise)
    first_weights(ppd, bounds, confined)
    first = ppd.l1_weights.copy()
    ppd.model[...] = gaussian(sums.shape, 22, 17, 6.0) * 30_000 * NOISE
    reweight(ppd, bounds, 3.0, confined)
    found, coefs = ppd.l1_weights.copy(), ppd.dictionary.analysis(ppd.model)
    level, pixel_level = band_noise(ppd, bounds)
    levels = set()
    for band, sigma in zip(ppd.dictionary.bands(), level):
        nu = max(sigma / pixel_level, 1)
        alpha = 3.0 * min(sigma, pixel_level) / (nu if confined else 1)
        share = 0.12 if confined and band.basis and band.orientation == "aa" else 1.0
        expected = share * nu * alpha / (alpha + np.sqrt(mean_square_around(coefs[band.slice])))
        np.testing.assert_allclose(found[band.slice], expected, rtol=1e-9, atol=0)
        np.testing.assert_allclose(first[band.slice], share * nu, rtol=1e-12)
        levels.add(round(nu, 6))
    assert len(levels) > 2 and found.min() < 0.01  # there are bands that differ, and a source
    assert ppd.threshold == pytest.approx(0.95)


@pytest.mark.parametrize("significance", [0.0, 5.0])
def test_a_solution_has_the_weights_of_its_support(significance):
    """From the start, and after a re-weighting: less prior on approximations, and around its point, with a support."""
    sums, ppd, bounds = problem()
    ppd.vis[:] = sums.whiten * (sums.of((25 * NOISE, 24.0, 20.0, 0)) + sums.noise(1))
    ppd.l2_step = 1 / np.abs(sums.psf).sum()
    first_weights(ppd, bounds, significance > 0)
    first = ppd.l1_weights.copy()
    solve(ppd, bounds, Schedule(niter=1, significance=significance))
    np.testing.assert_array_equal(ppd.l1_weights, first)
    sums, again, bounds = problem()
    again.vis[:], again.l2_step = ppd.vis, ppd.l2_step
    solve(again, bounds, Schedule(niter=61, significance=significance))  # one iteration after the first of them
    ratio = again.l1_weights[0, 24, 20] / again.l1_weights[0, 40, 5]
    assert (again.l1_weights[1:].min() < 0.13) == (significance > 0)
    assert (ratio < 0.26) == (significance > 0)


class Pixels(list):
    """Places, as sources of one pixel each."""

    def pixels(self, shape):
        return sum((pixel(shape, *place) for place in self), np.zeros(shape)) > 0


def weakened(wavelets, places, levels=3, shape=(50, 44)):
    """Where a reweighting gives a quarter of the prior for points at these pixels."""
    sums, ppd, bounds = problem(shape, wavelets, levels)
    ppd.model[...] = gaussian(shape, 22, 17, 6.0) * 300 * NOISE
    first_weights(ppd, bounds, True)
    reweight(ppd, bounds, 3.0, True)
    without = ppd.l1_weights.copy()
    ppd.points = Pixels(places)
    reweight(ppd, bounds, 3.0, True)
    inside = np.zeros(without.shape, bool)
    for band in ppd.dictionary.bands():
        inside[band.slice] = True
    ratio = ppd.l1_weights[inside] / without[inside]
    assert np.all(np.isclose(ratio, 1) | np.isclose(ratio, 0.25))
    where = np.zeros(without.shape, bool)
    where[inside] = np.isclose(ratio, 0.25)
    return ppd.dictionary, where


def test_weights_around_points_are_a_quarter():
    """Every Haar coefficient whose square holds the point, and those of the squares around; of pixels it alone."""
    place = 21, 30
    dictionary, where = weakened(("dirac", "db1"), [place])
    touched = dictionary.analysis(pixel(dictionary.shape, *place)) != 0
    assert where[touched].all()
    for band in dictionary.bands():
        square = [k >> band.level for k in place]
        i, j = np.indices(where[band.slice].shape)
        beside = 1 if band.level else 0
        np.testing.assert_array_equal(where[band.slice], np.maximum(abs(i - square[0]), abs(j - square[1])) <= beside)
    assert not weakened(("dirac", "db1"), [])[1].any()
    both = weakened(("dirac", "db1"), [place, (2, 43)])[1]
    np.testing.assert_array_equal(both, where | weakened(("dirac", "db1"), [(2, 43)])[1])


@pytest.mark.parametrize("wavelet", ["db2", "db4", "db6", "db8"])
def test_weights_around_points_are_a_quarter_where_their_coefficients_are(wavelet):
    """Of a point's power in the finest bands, most is in coefficients that have a quarter of the prior."""
    place = 21, 30
    dictionary, where = weakened(("dirac", wavelet), [place])
    coefs = dictionary.analysis(pixel(dictionary.shape, *place)) ** 2
    for band in dictionary.bands():
        if band.level in (1, 2):
            assert coefs[band.slice][where[band.slice]].sum() > 0.5 * coefs[band.slice].sum()


def test_a_point_in_a_beam_of_one_pixel_is_found():
    """Pixels as large as the beam: what is shifted of the response is then all of the patch."""
    psf = np.zeros((32, 32), np.float32)
    psf[15:18, 15:18], psf[16, 16] = 10, 110
    gradient = np.zeros_like(psf)
    gradient[10:13, 12:15], gradient[11, 13] = 15, 165
    support = np.zeros(psf.shape, bool)
    support[9:15, 10:17] = True
    _, points = unresolved(MatchedFilter(psf), gradient, np.zeros_like(psf), support, np.ones(psf.shape, bool), 5.0)
    np.testing.assert_allclose(points.places, [(11, 13)], atol=1e-6)
