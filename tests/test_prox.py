"""The ellipsoid projection against its definition and a brute-force minimiser."""

import numpy as np
import pytest
from scipy.optimize import minimize

from casa_sara.solver import _kernels as kernels
from casa_sara.solver.prox import ellipsoid_multiplier, project_ellipsoid


def _case(rng, size, decades):
    precond = 10 ** rng.uniform(-decades, 0, size)
    centre = rng.normal(size=size) + 1j * rng.normal(size=size)
    point = centre + 3 * (rng.normal(size=size) + 1j * rng.normal(size=size))
    return point, centre, precond


@pytest.mark.parametrize("decades", [0, 2, 5, 8])
@pytest.mark.parametrize("bound", [1e-3, 0.5, 5.0])
def test_projection_lies_on_the_ball_to_1e_8_and_satisfies_the_optimality_condition(decades, bound):
    point, centre, precond = _case(np.random.default_rng(1), 300, decades)
    projected = project_ellipsoid(point, centre, precond, bound)
    radius = np.linalg.norm(projected - centre)
    assert abs(radius - bound) < 1e-8 * bound
    # U(s − z) is a positive multiple of z − y
    normal, outward = precond * (point - projected), projected - centre
    multiplier = np.vdot(outward, normal).real / radius**2
    assert multiplier > 0
    np.testing.assert_allclose(normal, multiplier * outward, atol=1e-9 * np.abs(normal).max())


def test_projection_equals_a_brute_force_minimiser():
    rng = np.random.default_rng(2)
    point, centre, precond = _case(rng, 3, 2)
    bound = 0.7

    def cost(z):
        return np.sum(precond * np.abs(z[:3] + 1j * z[3:] - point) ** 2)

    inside = {"type": "ineq", "fun": lambda z: bound**2 - np.sum(np.abs(z[:3] + 1j * z[3:] - centre) ** 2)}
    start = np.concatenate([centre.real, centre.imag])
    found = minimize(cost, start, constraints=[inside], method="SLSQP", options={"ftol": 1e-14, "maxiter": 500}).x
    np.testing.assert_allclose(project_ellipsoid(point, centre, precond, bound), found[:3] + 1j * found[3:], atol=1e-5)


def test_a_point_inside_stays_and_has_no_multiplier():
    rng = np.random.default_rng(3)
    point, centre, precond = _case(rng, 50, 3)
    bound = np.linalg.norm(point - centre) * 1.01
    np.testing.assert_array_equal(project_ellipsoid(point, centre, precond, bound), point)


@pytest.mark.parametrize("guess", [0.0, 1e-6, 1.0, 1e6])
def test_the_multiplier_does_not_depend_on_the_first_guess(guess):
    point, centre, precond = _case(np.random.default_rng(4), 200, 6)
    zero = np.zeros_like(centre)
    expected = ellipsoid_multiplier(zero, point, centre, precond, 0.1)
    assert ellipsoid_multiplier(zero, point, centre, precond, 0.1, guess) == pytest.approx(expected, rel=1e-9)


def test_newton_takes_a_few_steps(monkeypatch):
    point, centre, precond = _case(np.random.default_rng(8), 2000, 6)
    calls, plain = [], kernels.shifted_norms
    monkeypatch.setattr(kernels, "shifted_norms", lambda *args: calls.append(1) or plain(*args))
    ellipsoid_multiplier(np.zeros_like(centre), point, centre, precond, 1.0)
    assert len(calls) <= 12


def test_the_dual_update_is_moreaus_complement_of_the_projection():
    rng = np.random.default_rng(5)
    point, centre, precond = _case(rng, 80, 3)
    dual = rng.normal(size=80) + 1j * rng.normal(size=80)
    shifted = dual / precond + point
    expected = precond * (shifted - project_ellipsoid(shifted, centre, precond, 2.0))
    multiplier = ellipsoid_multiplier(dual, point, centre, precond, 2.0)
    anchor, norms_sq = np.zeros(80, complex), np.zeros(2)
    model = 0.5 * (point + anchor)
    pairs = [vis.view(float).reshape(-1, 2) for vis in (dual, point, anchor, centre)]
    pieces = np.array([[0, 50, 0], [50, 80, 0]])
    for worker in range(2):
        kernels.data_step(*pairs, precond, pieces, np.array([multiplier]), 1.0, norms_sq, worker, 2)
    np.testing.assert_allclose(dual, expected, rtol=1e-8)
    np.testing.assert_allclose(anchor, model, rtol=1e-12)  # that of z + ρ(x − z), ρ = 1
    np.testing.assert_allclose(norms_sq,
                               [np.linalg.norm((centre - model)[part]) ** 2 for part in (slice(50), slice(50, 80))])


def test_float32_projection_is_as_exact_as_single_precision_allows():
    point, centre, precond = _case(np.random.default_rng(6), 5000, 4)
    exact = project_ellipsoid(point, centre, precond, 20.0)
    single = project_ellipsoid(point.astype("c8"), centre.astype("c8"), precond.astype("f4"), 20.0)
    np.testing.assert_allclose(single, exact, atol=1e-5 * np.abs(exact).max())


def test_non_finite_data_raise():
    point, centre, precond = _case(np.random.default_rng(7), 10, 1)
    point[3] = np.nan
    with pytest.raises(RuntimeError, match="finite"):
        ellipsoid_multiplier(np.zeros_like(point), point, centre, precond, 0.1)
