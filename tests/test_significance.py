"""The support of what is significant, in whole solutions, with masks, in checkpoints, and the weights within it."""

import numpy as np
import pytest
from dense_problem import Problem
from fourier_sums import BEAM, NOISE, POINT, distance, gaussian, image, pixel, problem

from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.state_file import read, write
from casa_sara.solver import l1_weights
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l1_weights import band_noise, first_weights, reweight
from casa_sara.solver.l2_bounds import GivenBounds
from casa_sara.solver.matched_filter import MatchedFilter
from casa_sara.solver.record import CONVERGED, NOISE_ONLY, STOPPED_BY_USER, STRUCTURED, SolverRecord
from casa_sara.solver.reweighting import Schedule, Stage, run_algorithm_2
from casa_sara.solver.significance import SignificantSupport

# ---- whole solutions


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


# ---- checkpoints


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


def test_the_noise_of_bands_hardly_depends_on_the_numbers_drawn(monkeypatch):
    """√(mean diagonal of Ψ†Φ†Σ⁻¹ΦΨ) by dense matrices, in 21 samples, which are drawn 16 times."""
    problem = Problem(noise=(0.5, 2.0))
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond, 1.0)
    samples = np.diff(problem.offsets)
    bounds = GivenBounds(np.array(problem.noise) * np.sqrt(2.0 * samples), samples, np.ones(2), 3)
    whitened = problem.measurement.matrix / np.repeat(problem.noise, samples)[:, None]
    covariance = (whitened.conj().T @ whitened).real / bounds.total_weight**2
    matrix = problem.dictionary.matrix
    variances = np.einsum("ci,ij,cj->c", matrix, covariance, matrix)
    expected = np.sqrt([variances[band.slice].mean() for band in problem.dictionary.bands()])

    def errors():
        found = [band_noise(ppd, bounds, seed) for seed in range(20)]
        np.testing.assert_allclose([pixel for _, pixel in found], [bands[0] for bands, _ in found], rtol=1e-12)
        return np.sqrt(np.mean([(bands / expected - 1) ** 2 for bands, _ in found], axis=0))

    several = errors()
    monkeypatch.setattr(l1_weights, "MOST_DRAWS", 1)
    assert several.max() < 0.08 and np.all(2.5 * several < errors())


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
    run_algorithm_2(ppd, bounds, Schedule(niter=1, significance=significance))
    np.testing.assert_array_equal(ppd.l1_weights, first)
    sums, again, bounds = problem()
    again.vis[:], again.l2_step = ppd.vis, ppd.l2_step
    # one iteration after the first of them
    run_algorithm_2(again, bounds, Schedule(niter=61, significance=significance))
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
