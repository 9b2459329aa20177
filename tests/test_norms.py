"""The norm estimate against exact eigenvalues."""

import numpy as np
import pytest

from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.norms import power_method


def normal(matrix, calls):
    def apply(image):
        calls.append(1)
        return (matrix.T @ (matrix @ image.ravel())).reshape(image.shape)
    return apply


def dense(seed):
    """Random matrices: flat, steep, and crowded spectra."""
    rng = np.random.default_rng(seed)
    rows, columns = rng.integers(1, 200, 2)
    matrix = rng.standard_normal((rows, columns))
    if seed % 3 == 1:
        matrix *= np.geomspace(1, rng.uniform(1e-4, 1), columns)
    if seed % 3 == 2:
        basis = np.linalg.qr(rng.standard_normal((columns, columns)))[0]
        matrix = basis * np.linspace(rng.uniform(0.5, 0.999), 1, columns) ** 0.5 @ basis.T
    return matrix


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("tol", [0.01, 0.002])
def test_estimate_is_above_the_norm_by_at_most_the_tolerance(tol, dtype):
    for seed in range(60):
        matrix = dense(seed).astype(dtype)
        exact = np.linalg.norm(matrix.astype(float), 2) ** 2
        estimate = power_method(normal(matrix, []), (matrix.shape[1], 1), dtype, tol, seed=seed)
        assert exact * (1 - 1e-5) <= estimate <= exact * (1 + tol + 1e-5)


def test_needs_few_calls():
    calls = []
    for seed in range(30):
        power_method(normal(dense(seed), calls), (dense(seed).shape[1], 1))
    assert len(calls) / 30 < 25


def test_norm_of_a_measurement_operator():
    rng = np.random.default_rng(0)
    uv, scale = rng.standard_normal((2, 500)) * 5e4, rng.uniform(0.5, 1, 500)
    operator = MeasurementOperator(uv, 1e-6, (16, 24), scale, 1e-6)
    matrix = np.stack([operator.forward(pixel.reshape(16, 24)) for pixel in np.eye(16 * 24)], axis=1)
    exact = np.linalg.norm(np.concatenate([matrix.real, matrix.imag]), 2) ** 2
    estimate = power_method(lambda image: operator.adjoint(operator.forward(image)), (16, 24), np.float32)
    assert exact <= estimate <= 1.02 * exact


def test_zero_operator_and_one_pixel():
    assert power_method(lambda image: 0 * image, (8, 8)) == 0
    assert power_method(lambda image: 4 * image, (1, 1)) == pytest.approx(4, rel=0.011)


def test_failures_are_told():
    with pytest.raises(RuntimeError, match="not finite"):
        power_method(lambda image: image * np.nan, (4, 4))
    with pytest.raises(RuntimeError, match="after 2 iterations"):
        power_method(normal(dense(0), []), (dense(0).shape[1], 1), max_iter=2)
