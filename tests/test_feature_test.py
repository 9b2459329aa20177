"""The test whether emission in a region is real: T in closed form, a real source, p-values where nothing is."""

import numpy as np
import pytest
from dense_problem import Problem
from scipy.stats import chi2, norm
from test_visibilities import observation

from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction.bootstrap import SEED
from casa_sara.reconstruction.feature_test import FeatureResult, FeatureTest
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds


def chi_square_of_least_squares(matrix, noise_weights, vis, free):
    """The least Σ|y − Φx|²/σ² over real images that are 0 where not `free`."""
    matrix = matrix[:, free]
    stacked = np.sqrt(np.tile(noise_weights, 2))[:, None] * np.vstack([matrix.real, matrix.imag])
    data = np.sqrt(np.tile(noise_weights, 2)) * np.concatenate([vis.real, vis.imag])
    return float(np.linalg.lstsq(stacked, data, rcond=None)[1][0]), np.linalg.lstsq(stacked, data, rcond=None)[0]


def unconstrained():
    """A dense problem without positivity and prior, its iteration and bounds, and a region of four pixels."""
    problem = Problem(seed=3, samples=(60, 80), noise=(0.05, 0.15))
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis.copy(), problem.offsets, problem.precond,
                      problem.data_norm_sq(problem.precond), positivity=False)
    samples = np.diff(problem.offsets)
    weights = np.abs(problem.measurement.matrix[:, 0]) ** 2
    bounds = AdaptiveBounds(np.array(problem.noise) * np.sqrt(2.0 * samples), samples,
                            np.add.reduceat(weights, problem.offsets[:-1]), n_bases=3)
    ppd.l1_weights[...] = 0
    ppd.rescale(0.005)
    bounds.apply_to(ppd)
    region = np.zeros(problem.shape, bool)
    region[1:3, 1:3] = True
    return problem, ppd, bounds, region


def test_the_change_of_chi_square_is_that_of_least_squares():
    """Without positivity and prior: of the data, and of the draws, whose noise the seed gives."""
    problem, ppd, bounds, region = unconstrained()
    for _ in range(500):
        ppd.step()
    found = FeatureTest(ppd, bounds, 0.0, False).test(region, draws=4)
    samples = problem.samples
    noise_weights, matrix = np.repeat(np.array(problem.noise) ** -2.0, samples), problem.measurement.matrix

    def change(vis):
        (without, model), (with_, _) = (chi_square_of_least_squares(matrix, noise_weights, vis, free)
                                        for free in (~region.ravel(), np.ones(16, bool)))
        return without - with_, model

    expected, model = change(problem.vis)
    assert found.change == pytest.approx(expected, rel=1e-3)
    np.testing.assert_allclose(found.without[~region], model, atol=1e-3)
    assert not found.without[region].any()
    for number, drawn in enumerate(found.drawn):
        rng = np.random.default_rng([SEED, 1, number])
        noise = np.concatenate([sigma * (rng.standard_normal(size) + 1j * rng.standard_normal(size))
                                for sigma, size in zip(problem.noise, problem.samples)])
        assert drawn == pytest.approx(change(matrix[:, ~region.ravel()] @ model + noise)[0], rel=0.05, abs=0.05)


def test_a_chi_square_that_still_falls_is_no_emission(monkeypatch):
    """By 7 with every solution, and by 30 more with the region: the change is 30."""
    _, ppd, bounds, region = unconstrained()
    solutions = []

    def falling(test):
        solutions.append(test._ppd.lowest[region].max() < np.inf)
        return 1000.0 - 7 * len(solutions) - 30 * solutions[-1]

    monkeypatch.setattr(FeatureTest, "_solve", lambda test, stopped: None)
    monkeypatch.setattr(FeatureTest, "_chi_square", falling)
    found = FeatureTest(ppd, bounds, 0.0, False).test(region, draws=3)
    assert found.change == 30 and np.array_equal(found.drawn, [30, 30, 30])
    # the data, then what it takes to forget them, which does not settle here, then the draws
    assert solutions == [False, True, False] + 6 * [False] + 3 * [False, True, False]


def test_probabilities_are_those_of_the_scaled_chi_square_of_the_draws():
    drawn = np.array([1.0, 3.0, 2.0, 5.0])
    empty = np.zeros((2, 2), np.float32)
    mean, variance = drawn.mean(), drawn.var(ddof=1)
    for change in (-1.0, 2.5, 9.0):
        found = FeatureResult(change, drawn, 0.0, empty, empty)
        expected = chi2.sf(max(change, 0) * 2 * mean / variance, 2 * mean**2 / variance)
        expected = max(expected, norm.sf(np.sqrt(max(change, 0))))
        assert found.p_value == pytest.approx(expected, rel=1e-9)
        if change > 0:
            assert found.sigma == pytest.approx(norm.isf(expected), rel=1e-9)
    shifted = FeatureResult(2.5 - 2, drawn - 2, 0.0, empty, empty)  # begins at −1
    least = -1.0
    expected = chi2.sf((0.5 - least) * 2 * (mean - 1) / variance, 2 * (mean - 1) ** 2 / variance)
    assert shifted.p_value == pytest.approx(expected)
    assert FeatureResult(2.5, drawn, 0.0, empty, empty).rank_p_value == 3 / 5
    assert FeatureResult(1.0, np.zeros(4), 0.0, empty, empty).p_value == 1 / 5
    for change in (4.0, 100.0):  # draws of nearly nothing make no detection of what is 2 or 10 standard deviations
        assert FeatureResult(change, drawn / 100, 0.0, empty, empty).sigma == pytest.approx(np.sqrt(change))
    assert 30 < FeatureResult(1e5, drawn, 0.0, empty, empty).sigma < 40


GRID = ImageGrid((40, 48), (1e-6, 1e-6))
OPTIONS = SolverOptions(wavelets=("dirac", "db1", "db3"), wavelevels=2, nreweights=12)
NOISE_JY = 1.0


def data_with(sources, seed):
    """Visibilities of points (Jy, x, y) with noise."""
    data = observation([(0, 0, 0, 0, 120), (0, 0, 1, 1e4, 120)], channels=2, seed=5)
    rng = np.random.default_rng(seed)
    data.uvw *= 8e4
    data.vis[:] = NOISE_JY * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    for flux, x, y in sources:
        data.vis += flux * np.exp(2j * np.pi * (-(x - 20) * data.uvw[0] + (y - 24) * data.uvw[1]) * 1e-6)
    data.weight[:] = NOISE_JY**-2
    return sort_into_blocks(data, data.rows.scan[data.row])


def image_and_test(sources, seed, places, draws=10):
    """Image, and test circles of three pixels."""
    data, offsets = data_with(sources, seed)
    x, y = np.indices(GRID.shape)
    found = []

    def then(ppd, bounds, record):
        test = FeatureTest(ppd, bounds, record.reweightings[-1]["scale"], True)
        found.extend(test.test(np.hypot(x - px, y - py) <= 3, draws) for px, py in places)

    samples = Samples(data, offsets, np.ones(data.size), np.ones(2))
    result = reconstruct(samples, GRID, OPTIONS, control=Control(then=then))
    return result, found


@pytest.mark.slow
def test_a_source_is_real_where_it_is_and_not_beside():
    """S/N 8 at (30.3, 30); the bright source beside is 500 times as strong."""
    noise = NOISE_JY / np.sqrt(4800)
    sources = [(4000 * noise, 12, 20), (8 * noise, 30.3, 30)]
    result, (real, nothing, bright, again) = image_and_test(sources, 1, [(30, 30), (12, 38), (12, 20), (30, 30)])
    assert 30 < real.change < 110 and real.sigma > 4 and real.rank_p_value == 1 / 11
    assert real.flux_jy == pytest.approx(8 * noise, abs=4 * noise)
    assert nothing.change < 25 and nothing.p_value > 0.02
    assert bright.sigma > 20
    x, y = np.indices(GRID.shape)
    assert not real.without[np.hypot(x - 30, y - 30) <= 3].any() and real.with_[30, 30] + real.with_[31, 30] > 0
    # each test begins from the solution
    assert again.change == pytest.approx(real.change, abs=8)
    point = [one.with_[np.hypot(x - 30, y - 30) <= 4] for one in (real, nothing)]
    assert point[0].min() == 0 > point[1].min()  # a point between pixels, where its region is not the one tested
    plain = reconstruct(Samples(*data_with(sources, 1), np.ones(4800), np.ones(2)), GRID, OPTIONS)
    np.testing.assert_array_equal(result.model, plain.model)


@pytest.mark.slow
def test_where_nothing_is_p_values_are_anything():
    """Twelve places in three noise realisations: about as many p-values below one half as above, and none tiny."""
    noise = NOISE_JY / np.sqrt(4800)
    p_values = [one.p_value for seed in (2, 3, 4)
                for one in image_and_test([(400 * noise, 20, 24)], seed, [(8, 10), (8, 38), (32, 10), (32, 38)])[1]]
    assert 2 <= np.count_nonzero(np.array(p_values) < 0.5) <= 10
    assert min(p_values) > 1e-3
