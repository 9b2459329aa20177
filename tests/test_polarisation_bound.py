"""The bound |(Q, U, V)| ≤ I: its projection, and iterations under it, against general minimisers."""

import numpy as np
import pytest
from dense_problem import Problem
from scipy.optimize import minimize

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l2_bounds import GivenBounds
from casa_sara.solver.polarisation import PolarisationBound

UNITS = np.array([1.0, 0.5, 1.5])
METRIC = np.array([1.0, 0.2, 0.6])


def projected(free, bound, metric=METRIC):
    """Return images (3, nx, ny), in the units of each, after the projection on |p| ≤ bound, and their x̄ with z = 0."""
    models = tuple(image.astype(np.float64) for image in free)
    bars, anchors = (tuple(np.zeros_like(image) for image in models) for _ in range(2))
    kernels.polarised_step(models, bars, anchors, bound, UNITS, metric, 0, 1)
    return np.array(models), np.array(bars)


@pytest.mark.parametrize("metric", [METRIC, np.ones(3), np.array([1.0, 1e-3, 2e-3])])
def test_projection_is_the_nearest_point_within_the_bound(metric):
    rng = np.random.default_rng(1)
    free, bound = rng.standard_normal((3, 5, 6)), np.abs(rng.standard_normal((5, 6)))
    models, bars = projected(free, bound, metric)
    jy, outside = models * UNITS[:, None, None], np.linalg.norm(free * UNITS[:, None, None], axis=0) > bound
    assert 10 < outside.sum() < 30
    np.testing.assert_array_equal(models[:, ~outside], free[:, ~outside])
    np.testing.assert_array_equal(bars[:, outside], 2 * models[:, outside])
    np.testing.assert_allclose(np.linalg.norm(jy, axis=0)[outside], bound[outside], rtol=1e-6)
    for i, k in np.argwhere(outside):
        point = free[:, i, k] * UNITS
        found = minimize(lambda p, point=point: np.sum((p - point) ** 2 / metric), 0.1 * point, method="SLSQP",
                         constraints=[dict(type="ineq", fun=lambda p, most=bound[i, k]: most**2 - p @ p)],
                         options=dict(ftol=1e-15, maxiter=500))
        np.testing.assert_allclose(jy[:, i, k], found.x, atol=2e-4 * np.abs(point).max())


def test_nothing_is_polarised_where_there_is_no_brightness_and_all_may_be_where_there_is_no_bound():
    free = np.random.default_rng(2).standard_normal((3, 3, 3))
    assert not projected(free, np.zeros((3, 3)))[0].any()
    np.testing.assert_array_equal(projected(free, np.full((3, 3), np.inf))[0], free)


def _together(thresholds, iterations=6000):
    """Iterate Q and U of dense problems, in units of their own, under a bound."""
    problems = [Problem(seed=seed, noise=(noise, 2 * noise)) for seed, noise in ((4, 0.3), (5, 0.5))]
    bright, ppds, bounds = Problem(seed=3).truth + 0.05, [], []
    for problem, threshold in zip(problems, thresholds):
        sky = 0.8 * np.where(problem.truth > 0.2, -1, 1) * bright  # together brighter than the bound
        problem.vis = problem.measurement.matrix @ sky.ravel()
        ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                          problem.data_norm_sq(problem.precond), positivity=False)
        ppd.rescale(threshold)
        sizes = np.diff(problem.offsets)
        bounds.append(GivenBounds(np.array(problem.noise) * np.sqrt(2.0 * sizes), sizes, np.ones(2), 3))
        bounds[-1].apply_to(ppd)
        ppds.append(ppd)
    steps = PolarisationBound(ppds, bright)
    for _ in range(iterations):
        steps.step(bounds)
    return problems, bounds, bright.ravel(), np.array([ppd.model.ravel() for ppd in ppds])


@pytest.mark.slow
def test_iterations_side_by_side_minimise_their_sum_within_the_bound():
    """SLSQP minimises Σ_s κ_g,s ‖Ψ†x_s‖₁ + ½ Σ_j ‖y_j − Φ_j x_s‖²/σ_j² with |Ψ†x_s| ≤ t_s, whatever the κ_s are."""
    problems, bounds, bright, wanted = _together((0.05, 0.01))
    size, matrix = bright.size, problems[0].dictionary.matrix
    coefs, count = len(matrix), len(problems)
    noise = [np.repeat(one.noise, np.diff(problem.offsets)) for one, problem in zip(bounds, problems)]

    def value(images, sizes):
        return sum(one.gradient_noise * t.sum()
                   + 0.5 * np.sum(np.abs((problem.vis - problem.measurement.matrix @ x) / sigma) ** 2)
                   for problem, one, sigma, x, t in zip(problems, bounds, noise, images, sizes))

    def parts(z):
        return z[: count * size].reshape(count, size), z[count * size :].reshape(count, coefs)

    def gradient(z):
        images, _ = parts(z)
        data = [-(problem.measurement.matrix.conj().T @ ((problem.vis - problem.measurement.matrix @ x) / s**2)).real
                for problem, s, x in zip(problems, noise, images)]
        return np.concatenate([*data, *(np.full(coefs, one.gradient_noise) for one in bounds)])

    linear = np.block([[np.kron(np.eye(count), sign * matrix), np.eye(count * coefs)] for sign in (1, -1)])
    start = np.concatenate([*(0.5 * wanted), *np.abs((matrix @ wanted.T).T) + 0.1])
    result = minimize(lambda z: value(*parts(z)), start, jac=gradient, method="SLSQP", constraints=[
        dict(type="ineq", fun=lambda z: linear @ z, jac=lambda z: linear),
        dict(type="ineq", fun=lambda z: bright**2 - np.sum(parts(z)[0] ** 2, axis=0))],
        options=dict(ftol=1e-13, maxiter=500))
    assert value(wanted, np.abs((matrix @ wanted.T).T)) == pytest.approx(result.fun, rel=1e-5)
    np.testing.assert_allclose(wanted, parts(result.x)[0], atol=1e-3 * bright.max())
    tight = np.isclose(np.linalg.norm(wanted, axis=0), bright, rtol=1e-6)
    assert 3 <= tight.sum() < size
