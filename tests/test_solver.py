"""Algorithms 1 and 2 on dense matrices, against minimisers found in other ways."""

from types import SimpleNamespace

import numpy as np
import pytest
from dense_problem import Problem
from scipy.optimize import minimize, nnls as scipy_nnls

from casa_sara.operators._workers import Workers
from casa_sara.solver import _kernels as kernels
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import AdaptiveBounds, GivenBounds, chi_square_bounds
from casa_sara.solver.nnls import NNLSFit, nnls
from casa_sara.solver.record import CONVERGED, DIVERGED, ITERATION_LIMIT, STOPPED_BY_USER, UNFEASIBLE
from casa_sara.solver.reweighting import Schedule, _is_settled, run_algorithm_2


def _ppd(problem, precond=None, threshold=0.2, **options):
    precond = problem.precond if precond is None else precond
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, precond,
                      problem.data_norm_sq(precond), **options)
    ppd.rescale(threshold)
    return ppd


def _slsqp_minimiser(problem, bounds):
    """Minimise Σt over |Ψ†x| ≤ t, x ≥ 0 and the data balls with scipy's SLSQP."""
    size, matrix = problem.truth.size, problem.dictionary.matrix
    coefs = len(matrix)
    linear = np.block([[matrix, np.eye(coefs)], [-matrix, np.eye(coefs)]])
    blocks = list(zip(problem.offsets[:-1], problem.offsets[1:]))

    def slack(z):
        residual = problem.vis - problem.measurement.matrix @ z[:size]
        return [bounds[j] ** 2 - np.sum(np.abs(residual[a:b]) ** 2) for j, (a, b) in enumerate(blocks)]

    def slack_gradient(z):
        rows = []
        for a, b in blocks:
            part = problem.measurement.matrix[a:b]
            rows.append(np.concatenate([2 * (part.conj().T @ (problem.vis[a:b] - part @ z[:size])).real,
                                        np.zeros(coefs)]))
        return np.array(rows)

    start = np.concatenate([problem.truth.ravel(), np.abs(matrix @ problem.truth.ravel())])
    gradient = np.concatenate([np.zeros(size), np.ones(coefs)])
    result = minimize(
        lambda z: z[size:].sum(), start, jac=lambda z: gradient, method="SLSQP",
        bounds=[(0, None)] * size + [(None, None)] * coefs,
        constraints=[{"type": "ineq", "fun": lambda z: linear @ z, "jac": lambda z: linear},
                     {"type": "ineq", "fun": slack, "jac": slack_gradient}],
        options={"ftol": 1e-13, "maxiter": 1000})
    # at this tolerance its line search may end before its own test does
    assert result.status in (0, 8) and np.min(slack(result.x)) > -1e-7, result.message
    return result.x[:size].reshape(problem.shape)


def _given(problem, l2_bounds):
    """Bounds that are hard constraints from the start."""
    bounds = GivenBounds(l2_bounds, np.diff(problem.offsets), np.ones(2), 3)
    bounds.apply_to = bounds.finish
    return bounds


def _run(ppd, bounds, iterations):
    bounds.apply_to(ppd)
    for _ in range(iterations):
        ppd.step()
    return ppd.model


def test_algorithm_1_reaches_the_constrained_minimiser_that_slsqp_finds():
    problem = Problem(seed=3)
    bounds = 1.05 * problem.errors
    expected = _slsqp_minimiser(problem, bounds)
    found = _run(_ppd(problem), _given(problem, bounds), 20_000)
    np.testing.assert_allclose(found, expected, atol=2e-5 * expected.max())
    residual = problem.vis - problem.measurement.forward(found)
    assert np.linalg.norm(residual[:9]) <= bounds[0] * (1 + 1e-6)


def test_neither_preconditioner_nor_threshold_moves_the_constrained_minimiser():
    problem = Problem(seed=4)
    bounds = 1.05 * problem.errors
    with_precond = _run(_ppd(problem, threshold=0.05), _given(problem, bounds), 20_000)
    without = _run(_ppd(problem, np.ones_like(problem.precond)), _given(problem, bounds), 100_000)
    np.testing.assert_allclose(with_precond, without, atol=3e-4 * without.max())


def test_relaxation_moves_no_fixed_point_and_saves_iterations():
    problem = Problem(seed=4)
    given = _given(problem, 1.05 * problem.errors)
    converged = _run(_ppd(problem), given, 20_000).copy()
    ppd = _ppd(problem, relaxation=1.0)
    np.testing.assert_allclose(_run(ppd, given, 40_000), converged, atol=1e-6 * converged.max())
    errors = [np.linalg.norm(_run(_ppd(problem, relaxation=rho), given, 2000) - converged) for rho in (1.0, 1.8)]
    assert errors[1] < 0.7 * errors[0]


def test_given_noise_levels_the_iteration_reaches_the_penalised_minimiser():
    problem = Problem(seed=5, noise=(1.0, 0.5))
    samples = np.diff(problem.offsets)
    weight_sums = np.array([20.0, 30.0])
    bounds = AdaptiveBounds(np.array([1.0, 0.5]) * np.sqrt(2.0 * samples), samples, weight_sums, 3, rel_change=0.0)
    found = _run(_ppd(problem), bounds, 20_000)
    # the same cost by coordinates: x ≥ 0, t ≥ |Ψ†x|
    matrix, size = problem.dictionary.matrix, problem.truth.size
    sigma_sq = np.repeat(bounds.noise**2, samples)

    def cost(z):
        residual = problem.vis - problem.measurement.matrix @ z[:size]
        value = bounds.gradient_noise * z[size:].sum() + 0.5 * np.sum(np.abs(residual) ** 2 / sigma_sq)
        gradient = -(problem.measurement.matrix.conj().T @ (residual / sigma_sq)).real
        return value, np.concatenate([gradient, np.full(len(matrix), bounds.gradient_noise)])

    linear = np.block([[matrix, np.eye(len(matrix))], [-matrix, np.eye(len(matrix))]])
    result = minimize(cost, np.concatenate([problem.truth.ravel(), np.abs(matrix @ problem.truth.ravel())]), jac=True,
                      method="SLSQP", bounds=[(0, None)] * size + [(None, None)] * len(matrix),
                      constraints=[{"type": "ineq", "fun": lambda z: linear @ z, "jac": lambda z: linear}],
                      options={"ftol": 1e-14, "maxiter": 1000})
    np.testing.assert_allclose(found, result.x[:size].reshape(problem.shape), atol=1e-4 * found.max())


def test_residual_norms_are_those_of_the_model_before_the_step():
    problem = Problem(seed=6)
    ppd = _ppd(problem)
    _given(problem, problem.errors).apply_to(ppd)
    for _ in range(5):
        before = ppd.model.copy()
        ppd.step()
    residual = problem.vis - problem.measurement.forward(before)
    expected = [np.linalg.norm(residual[a:b]) for a, b in ppd.blocks()]
    np.testing.assert_allclose(ppd.residual_norms, expected, rtol=1e-10)


@pytest.mark.parametrize("hard", [True, False])
def test_rescaling_the_threshold_leaves_the_fixed_point(hard):
    problem = Problem(seed=7)
    ppd = _ppd(problem)
    levels = AdaptiveBounds(problem.errors, np.diff(problem.offsets), np.ones(2), 3, rel_change=0.0)
    converged = _run(ppd, _given(problem, 1.05 * problem.errors) if hard else levels, 20_000).copy()
    ppd.rescale(0.01)
    for _ in range(20):
        ppd.step()
    np.testing.assert_allclose(ppd.model, converged, atol=1e-6 * converged.max())


def test_bounds_adapt_by_the_papers_rule():
    samples, sums = np.array([50, 50]), np.ones(2)
    bounds = AdaptiveBounds(np.array([10.0, 10.0]), samples, sums, 9, floor=np.array([0.0, 9.5]), rel_change=1e-3,
                            tol=1e-2, step=0.5, min_interval=10)
    problem = Problem(seed=8)
    ppd = _ppd(problem)
    ppd.residual_norms = np.array([20.0, 2.0])
    ppd.rel_change, ppd.iteration = 1e-2, 50
    assert not bounds.adapt(ppd)  # condition (i): the model still moves
    ppd.rel_change = 1e-4
    assert bounds.adapt(ppd)
    np.testing.assert_allclose(bounds.l2_bounds, [15.0, 9.75])  # half way; the second towards its floor
    ppd.iteration = 55
    assert not bounds.adapt(ppd)  # condition (ii): too soon
    ppd.iteration = 60
    assert bounds.adapt(ppd)
    np.testing.assert_allclose(bounds.l2_bounds, [17.5, 9.625])
    ppd.residual_norms, ppd.iteration = bounds.l2_bounds * 1.005, 80
    assert not bounds.adapt(ppd)  # condition (iii): within tolerance


def test_when_one_more_reweighting_would_change_nothing():
    """The model by less than the tolerance and bounds met, or by less than half of it and bounds nearly met."""
    schedule, ppd = Schedule(reweight_tol=1e-2), SimpleNamespace()
    bounds = AdaptiveBounds(np.ones(2), np.array([50, 50]), np.ones(2), 1, tol=0.01)
    for off, expected in ((0.0, [True, True, False]), (0.015, [True, False, False]), (0.025, [False] * 3)):
        ppd.residual_norms = np.array([1.0, 1 + off])
        assert [_is_settled(ppd, bounds, schedule, change) for change in (4.9e-3, 9.9e-3, 1.1e-2)] == expected


@pytest.mark.parametrize("start", [0.3, 1.0, 10.0])
def test_noise_levels_are_found_from_any_start(start):
    noise = np.array([0.4, 2.0])
    problem = Problem(seed=9, shape=(4, 4), samples=(300, 300), noise=tuple(noise))
    samples = np.diff(problem.offsets)
    power = np.abs(problem.measurement.matrix[:, 0]) ** 2
    sums = np.add.reduceat(power, problem.offsets[:-1])
    bounds = AdaptiveBounds(start * np.sqrt(2.0 * samples), samples, sums, 3)
    run_algorithm_2(_ppd(problem), bounds, Schedule(nreweights=8))
    np.testing.assert_allclose(bounds.noise, noise, rtol=0.1)


def test_chi_square_bounds_hold_the_noise_of_unit_weights():
    rng = np.random.default_rng(10)
    norms = np.linalg.norm(rng.normal(size=(2000, 200)), axis=1)  # 100 complex samples
    bound = chi_square_bounds([100])[0]
    assert 0.955 < np.mean(norms < bound) < 0.995  # two standard deviations of χ²
    assert chi_square_bounds([100], 2.0)[0] == pytest.approx(2 * bound)


@pytest.mark.parametrize("last_penalty", [0.0, 1e-2])
def test_nnls_reaches_scipys_solution(last_penalty):
    problem = Problem(seed=11)
    root, norm_sq = np.sqrt(problem.precond), problem.data_norm_sq(problem.precond)
    weighted = root[:, None] * problem.measurement.matrix
    stacked = np.vstack([weighted.real, weighted.imag])
    # t‖x‖₁ over x ≥ 0 is linear: with a square matrix R, R†R = A†A, it moves the data by −tR⁻†1
    factor = np.linalg.qr(stacked, mode="r")
    gradient = stacked.T @ np.concatenate([(root * problem.vis).real, (root * problem.vis).imag])
    penalty = 0.5 * last_penalty * np.abs(gradient).max()
    expected, _ = scipy_nnls(factor, np.linalg.solve(factor.T, gradient - penalty))
    found, residual = nnls(problem.measurement, problem.vis, problem.precond, norm_sq,
                           NNLSFit(20_000, last_penalty))
    np.testing.assert_allclose(found.ravel(), expected, atol=1e-8)
    np.testing.assert_allclose(residual, problem.vis - problem.measurement.forward(found))


def test_reweighting_sharpens_and_every_update_is_recorded():
    problem = Problem(seed=12, shape=(8, 8), samples=(12, 14))  # 52 equations for 64 pixels
    samples = np.diff(problem.offsets)
    sums = np.add.reduceat(np.abs(problem.measurement.matrix[:, 0]) ** 2, problem.offsets[:-1])

    def solution(nreweights):
        bounds = AdaptiveBounds(problem.errors, samples, sums, 3)
        ppd = _ppd(problem)
        record = run_algorithm_2(ppd, bounds, Schedule(nreweights=nreweights, reweight_tol=1e-4))
        return ppd.model, record

    plain, record = solution(0)
    assert record.stop_code == CONVERGED and record.reweightings == []
    sharp, record = solution(10)
    error = [np.linalg.norm(model - problem.truth) for model in (plain, sharp)]
    assert error[1] < 0.7 * error[0]
    assert len(record.reweightings) == max(record.reweighting) > 5
    scales = [update["scale"] for update in record.reweightings]
    assert scales[0] == 10.0 and min(scales) == 1.5 and all(a >= b for a, b in zip(scales, scales[1:]))


def test_bounds_that_no_image_meets_are_recognised():
    problem = Problem(seed=14, samples=(20, 30), noise=(1.0, 1.0))
    ppd = _ppd(problem)
    bounds = GivenBounds(0.01 * problem.errors, np.diff(problem.offsets), np.ones(2), 3)
    assert run_algorithm_2(ppd, bounds, Schedule(nreweights=2)).stop_code == UNFEASIBLE


def test_divergence_is_recognised_and_the_last_good_image_kept():
    problem = Problem(seed=14, samples=(20, 30), noise=(0.5, 0.5))
    ppd = _ppd(problem)
    ppd.start_from(problem.truth)
    bounds = AdaptiveBounds(problem.errors, np.diff(problem.offsets), np.ones(2), 3)
    ppd.l2_step *= 1e6  # far beyond what converges
    assert run_algorithm_2(ppd, bounds, Schedule(nreweights=5, interval=5000)).stop_code == DIVERGED
    np.testing.assert_array_equal(ppd.model, problem.truth)


def test_given_bounds_are_met_at_the_end():
    problem = Problem(seed=15, samples=(20, 30), noise=(0.5, 0.5))
    ppd = _ppd(problem)
    bounds = GivenBounds(1.02 * problem.errors, np.diff(problem.offsets), np.ones(2), 3)
    assert run_algorithm_2(ppd, bounds, Schedule(nreweights=2)).stop_code == CONVERGED
    residual = problem.vis - problem.measurement.forward(ppd.model)
    norms = np.array([np.linalg.norm(residual[a:b]) for a, b in ppd.blocks()])
    assert np.all(norms <= 1.01 * bounds.l2_bounds)


def test_iteration_limit_and_stop_request():
    problem = Problem(seed=13)
    record = run_algorithm_2(_ppd(problem), _given(problem, problem.errors), Schedule(niter=7))
    assert (record.stop_code, record.iteration[-1]) == (ITERATION_LIMIT, 7)
    ppd = _ppd(problem)
    record = run_algorithm_2(ppd, _given(problem, problem.errors), stopped=lambda: ppd.iteration == 4)
    assert (record.stop_code, record.iteration[-1]) == (STOPPED_BY_USER, 4)


@pytest.mark.parametrize("positivity", [True, False])
@pytest.mark.parametrize("threads", [1, 3])
def test_passes_of_nnls_are_what_they_say(positivity, threads):
    rng = np.random.default_rng(12)
    model, momentum, gradient = rng.normal(size=(3, 7, 5))
    free, uphill = momentum + 0.7 * gradient, np.zeros(7)
    new = np.maximum(free - 0.3, 0) + (0 if positivity else np.minimum(free + 0.3, 0))
    expected = ((momentum - new) * (new - model)).sum(axis=1), new + 0.4 * (new - model)
    run = Workers(threads).run
    run(kernels.nnls_step, model, momentum, gradient, 0.7, 0.3, positivity, uphill)
    np.testing.assert_allclose(gradient, new)
    np.testing.assert_allclose(uphill, expected[0])
    run(kernels.extrapolate, model, momentum, gradient, 0.4)
    np.testing.assert_allclose(momentum, expected[1])
    np.testing.assert_array_equal(model, gradient)


@pytest.mark.parametrize("threads", [1, 3])
def test_the_image_step_is_what_it_says(threads):
    rng = np.random.default_rng(13)
    model, anchor, bar, data, prior = rng.normal(size=(5, 7, 5))
    lowest, sums = np.full((7, 5), -0.2), np.zeros((7, 4))
    start = anchor + 1.8 * (model - anchor)
    new = np.maximum(start - 0.4 * (2.0 * data + prior), lowest)
    expected = ((new - model) ** 2).sum(axis=1), (new**2).sum(axis=1), new.sum(axis=1), new.max(axis=1)
    Workers(threads).run(kernels.primal_step, model, anchor, bar, data, prior, (0.4, 2.0, 1.8), lowest, sums)
    np.testing.assert_allclose(model, new)
    np.testing.assert_allclose(anchor, start)
    np.testing.assert_allclose(bar, 2 * new - start)
    np.testing.assert_allclose(sums.T, expected)
