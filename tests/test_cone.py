"""The cone |(Q, U, V)| ≤ I: its projection against a brute-force minimiser, and the iteration against dense algebra."""

import numpy as np
import pytest
from dense_problem import Problem
from scipy.optimize import minimize

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.cone import PolarisationCone
from casa_sara.solver.l2_bounds import GivenBounds

UNITS = np.array([2.0, 1.0, 0.5, 1.5])
METRIC = np.array([0.3, 1.0, 0.2, 0.6])


def projected(free, metric=METRIC, lowest=0.0, units=UNITS):
    """Return the images (4, nx, ny) in the units of each, after the projection of one that x ≥ 0 has projected."""
    models = tuple(image.astype(np.float64) for image in free)
    models[0][...] = np.where(np.isinf(lowest), 0, np.maximum(models[0], lowest))
    bars, anchors = (tuple(np.zeros_like(image) for image in models) for _ in range(2))
    kernels.cone_step(models, bars, anchors, free[0].astype(np.float64), np.full(free.shape[1:], lowest), units, metric,
                      0, 1)
    return np.array(models), np.array(bars)


def nearest(free, metric):
    """Return the nearest point of the cone, in Jy, and its distance squared, by general minimisers.

    Where I moves it is max(|p|, I) for any p, which leaves a convex function of p; where not, p has a bound.
    """
    scale = np.abs(free).max()
    free = free / scale

    def distance(p):
        own = (max(np.linalg.norm(p), free[0]) - free[0]) ** 2 / metric[0] if metric[0] > 0 else 0.0
        return own + np.sum((p - free[1:]) ** 2 / metric[1:])

    if metric[0] > 0:
        found = min((minimize(distance, start * free[1:], method="Nelder-Mead",
                              options=dict(xatol=1e-9, fatol=1e-14, maxiter=4000)) for start in (1.0, 0.5, 0.1)),
                    key=lambda one: one.fun)
    else:
        bound = dict(type="ineq", fun=lambda p: free[0] ** 2 - np.sum(p**2))
        found = minimize(distance, 0.1 * free[1:], constraints=[bound], method="SLSQP", options=dict(ftol=1e-15))
    own = max(np.linalg.norm(found.x), free[0]) if metric[0] > 0 else free[0]
    return scale * np.array([own, *found.x]), found.fun


@pytest.mark.parametrize("metric", [METRIC, np.ones(4), np.array([1.0, 1e-3, 1e-3, 2e-3]), np.array([0, 0.5, 1, 0.7])])
def test_projection_is_the_nearest_point_of_the_cone(metric):
    """No point of the cone, found by a general minimiser, is nearer in the metric, and this one is in the cone."""
    rng = np.random.default_rng(1)
    free = rng.standard_normal((4, 5, 6))
    free[0] += 0.5
    if metric[0] == 0:  # I stays as it is, 0 or more
        free[0] = np.abs(free[0])
    models, bars = projected(free, metric)
    assert np.all((bars == 2 * models) | (bars == 0))
    jy = models * UNITS[:, None, None]
    assert np.all(np.sqrt(np.square(jy[1:]).sum(axis=0)) <= jy[0] * (1 + 1e-8) + 1e-12)
    changed = 0
    for i, k in np.ndindex(5, 6):
        point = free[:, i, k] * UNITS
        moves = metric > 0
        distance = np.sum((jy[:, i, k] - point)[moves] ** 2 / metric[moves]) / np.abs(point).max() ** 2
        best, least = nearest(point, metric)
        assert distance <= least + 1e-6
        np.testing.assert_allclose(jy[:, i, k], best, atol=1e-4 * np.abs(point).max())
        changed += distance > 0
    assert 10 < changed < 30


def test_there_is_no_cone_where_the_brightness_may_be_negative_and_no_polarisation_where_it_is_none():
    free = np.random.default_rng(2).standard_normal((4, 3, 3))
    models, _ = projected(free, lowest=-0.1)
    np.testing.assert_array_equal(models[1:], free[1:])
    models, _ = projected(free, lowest=np.inf)
    assert not models.any()


def test_what_has_ended_stays():
    """Q has ended, as has I in the second: the others give way."""
    free = np.abs(np.random.default_rng(3).standard_normal((4, 4, 4)))
    free[0] = free[1] * UNITS[1] / UNITS[0] * 1.1
    for metric in (METRIC * [1, 0, 1, 1], METRIC * [0, 0, 1, 1]):
        models, _ = projected(free, metric)
        np.testing.assert_array_equal(models[1], free[1])
        given, jy = (np.linalg.norm((images * UNITS[:, None, None])[1:], axis=0) for images in (free, models))
        bound = models[0] * UNITS[0]
        outside = given > free[0] * UNITS[0]
        assert outside.sum() > 5 and np.all(jy <= bound * (1 + 1e-9))
        np.testing.assert_allclose(jy[outside], bound[outside], rtol=1e-6)
    np.testing.assert_array_equal(models[0], free[0])


def _together(thresholds, iterations=8000):
    """Iterate I, Q and U of dense problems, in units of their own, under the cone."""
    problems = [Problem(seed=seed, noise=(noise, 2 * noise)) for seed, noise in ((3, 0.2), (4, 0.3), (5, 0.5))]
    ppds, bounds = [], []
    for number, (problem, threshold) in enumerate(zip(problems, thresholds)):
        if number:  # polarised: signed, and brighter than I in some pixels
            problem.vis = problem.measurement.matrix @ (0.8 * np.where(problem.truth > 0.2, -1, 1)
                                                        * problems[0].truth).ravel()
        ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                          problem.data_norm_sq(problem.precond), positivity=number == 0)
        ppd.rescale(threshold)
        ppd.unit_jy = 1.0
        sizes = np.diff(problem.offsets)
        bounds.append(GivenBounds(np.array(problem.noise) * np.sqrt(2.0 * sizes), sizes, np.ones(2), 3))
        bounds[-1].apply_to(ppd)
        ppds.append(ppd)
    cone = PolarisationCone(ppds)
    for _ in range(iterations):
        cone.step(dict(enumerate(bounds)))
    return problems, bounds, [ppd.model.ravel().copy() for ppd in ppds]


@pytest.mark.slow
def test_iterations_side_by_side_minimise_the_sum_over_the_cone():
    """SLSQP minimises Σ_s κ_g,s ‖Ψ†x_s‖₁ + ½ Σ_j ‖y_j − Φ_j x_s‖²/σ_j² with |Ψ†x_s| ≤ t_s, whatever the κ_s are."""
    problems, bounds, found = _together((0.02, 0.05, 0.01))
    size, matrix = found[0].size, problems[0].dictionary.matrix
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
    wanted = np.array(found)
    start = np.concatenate([*(0.9 * wanted + 0.1 * np.array([problems[0].truth.ravel(), 0 * wanted[0], 0 * wanted[0]])),
                            *np.abs((matrix @ wanted.T).T) + 0.1])
    result = minimize(lambda z: value(*parts(z)), start, jac=gradient, method="SLSQP", constraints=[
        dict(type="ineq", fun=lambda z: linear @ z, jac=lambda z: linear),
        dict(type="ineq", fun=lambda z: parts(z)[0][0] ** 2 - np.sum(parts(z)[0][1:] ** 2, axis=0)),
        dict(type="ineq", fun=lambda z: parts(z)[0][0])], options=dict(ftol=1e-13, maxiter=500))
    images, _ = parts(result.x)
    reached = value(wanted, np.abs((matrix @ wanted.T).T))
    assert reached <= result.fun * (1 + 1e-7)
    # near the apex of a cone SLSQP ends early
    np.testing.assert_allclose(wanted, images, atol=3e-3 * images.max())
    tight = np.isclose(np.linalg.norm(wanted[1:], axis=0), wanted[0], rtol=1e-6) & (wanted[0] > 1e-3)
    assert tight.sum() >= 3
