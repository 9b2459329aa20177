"""The measurement operator against the explicit Fourier sum, its adjoint, its memory and its errors."""

import gc
import re
import resource
import tracemalloc

import numpy as np
import pytest

from casa_sara.operators import kaiser_bessel
from casa_sara.operators.decimation import AxisDecimation
from casa_sara.operators.measurement import MeasurementOperator, choose_eps

pytestmark = pytest.mark.usefixtures("every_thread")

CELL = np.array([1.1e-6, 0.9e-6])
SINGLE = [(np.float32, eps) for eps in (1e-3, 1e-4, 1e-5, 1e-6)]
DOUBLE = [(np.float64, eps) for eps in (1e-8, 1e-12)]
SHAPES = [(64, 48), (33, 47), (1, 1), (2, 3), (1, 100), (200, 101)]


def random_uv(rng, fill, size):
    """(2, size) wavelengths that reach `fill` of the band on both axes, one of them exactly."""
    uv = rng.uniform(-0.5, 0.5, (2, size)) * fill / CELL[:, None]
    uv[:, 0] = np.array([0.5, -0.5]) * fill * (1 - 1e-15) / CELL
    return uv


def fourier_sum(uv, shape, cell=CELL):
    """Matrices A (M, nx), B (M, ny) with V_k = Σ A[k, ix] image[ix, iy] B[k, iy], as the module's docstring says."""
    east = -(np.arange(shape[0]) - shape[0] // 2) * cell[0]
    north = (np.arange(shape[1]) - shape[1] // 2) * cell[1]
    return np.exp(2j * np.pi * np.outer(uv[0], east)), np.exp(2j * np.pi * np.outer(uv[1], north))


def complex_normal(rng, size):
    return rng.standard_normal(size) + 1j * rng.standard_normal(size)


@pytest.mark.parametrize("dtype, eps", SINGLE + DOUBLE)
@pytest.mark.parametrize("fill", [1.0, 0.84, 0.42, 0.1])
def test_forward_and_adjoint_equal_the_fourier_sum(fill, dtype, eps):
    for number, shape in enumerate(SHAPES):
        rng = np.random.default_rng(number)
        uv, scale = random_uv(rng, fill, 300), rng.uniform(0.5, 2, 300)
        operator = MeasurementOperator(uv, CELL, shape, scale, eps, dtype)
        image, vis = rng.standard_normal(shape), complex_normal(rng, 300)
        a, b = fourier_sum(uv, shape)
        expected = np.einsum("ki,ij,kj->k", a, image, b, optimize=True) * scale
        expected_image = np.einsum("ki,k,kj->ij", a.conj(), vis * scale, b.conj(), optimize=True).real
        found = operator.forward(image, np.full(300, np.nan, operator.complex_dtype))
        found_image = operator.adjoint(vis, np.full(shape, np.nan, dtype))
        assert np.linalg.norm(found - expected) <= eps * np.linalg.norm(image) * np.linalg.norm(scale)
        assert np.linalg.norm(found_image - expected_image) <= eps * np.linalg.norm(vis * scale) * np.sqrt(image.size)


@pytest.mark.parametrize("dtype, eps", [(np.float32, 1e-5), (np.float64, 1e-10)])
def test_every_pixel_up_to_the_corners_is_accurate(dtype, eps):
    rng = np.random.default_rng(0)
    shape, uv = (40, 31), random_uv(rng, 0.4, 200)
    operator = MeasurementOperator(uv, CELL, shape, eps=eps, dtype=dtype)
    a, b = fourier_sum(uv, shape)
    for ix, iy in [(0, 0), (39, 30), (0, 30), (39, 0), (20, 15), (19, 0)]:
        image = np.zeros(shape, dtype)
        image[ix, iy] = 1
        assert np.abs(operator.forward(image) - a[:, ix] * b[:, iy]).max() < 3 * eps


@pytest.mark.parametrize("dtype, bound", [(np.float32, 1e-6), (np.float64, 1e-14)])
@pytest.mark.parametrize("fill", [1.0, 0.4])
@pytest.mark.parametrize("nthreads", [1, 3])
def test_adjoint_is_the_transpose_for_real_inner_products(dtype, bound, fill, nthreads):
    rng = np.random.default_rng(1)
    shape, size = (90, 121), 5000
    uv, scale = random_uv(rng, fill, size), rng.uniform(0, 1, size)
    operator = MeasurementOperator(uv, CELL, shape, scale, 1e-4, dtype, nthreads)
    image, vis = rng.standard_normal(shape), complex_normal(rng, size)
    left = np.vdot(operator.forward(image).astype(complex), vis).real
    right = np.vdot(image, operator.adjoint(vis).astype(float))
    assert abs(left - right) < bound * np.linalg.norm(operator.forward(image)) * np.linalg.norm(vis)


def test_calls_leave_nothing_behind():
    rng = np.random.default_rng(2)
    operator = MeasurementOperator(random_uv(rng, 0.4, 400), CELL, (50, 60), nthreads=2)
    image, vis = rng.standard_normal((50, 60)).astype("f4"), complex_normal(rng, 400).astype("c8")
    first, first_image = operator.forward(image), operator.adjoint(vis)
    operator.forward(np.full((50, 60), np.nan, "f4"))
    operator.adjoint(np.full(400, np.nan, "c8"))
    np.testing.assert_array_equal(operator.forward(image), first)
    np.testing.assert_array_equal(operator.adjoint(vis), first_image)


@pytest.mark.parametrize("fill", [1.0, 0.4])
def test_threads_do_not_change_the_result(fill):
    rng = np.random.default_rng(3)
    uv, shape = random_uv(rng, fill, 3000) * rng.uniform(0, 1, 3000) ** 3, (128, 100)
    image, vis = rng.standard_normal(shape), complex_normal(rng, 3000)
    single, *several = [MeasurementOperator(uv, CELL, shape, None, 1e-9, np.float64, n) for n in (1, 2, 5)]
    for operator in several:
        np.testing.assert_allclose(operator.forward(image), single.forward(image), atol=1e-12 * np.linalg.norm(image))
        np.testing.assert_allclose(operator.adjoint(vis), single.adjoint(vis), atol=1e-12 * np.linalg.norm(vis))


@pytest.mark.parametrize("uv", [np.zeros((2, 1)), [[1e5], [-2e5]], [[-3e5], [0]], np.zeros((2, 9))])
def test_one_visibility_or_one_place(uv):
    uv = np.asarray(uv)
    image = np.random.default_rng(4).uniform(0, 1, (20, 17))
    a, b = fourier_sum(uv, image.shape)
    found = MeasurementOperator(uv, CELL, image.shape, eps=1e-10, dtype=np.float64, nthreads=4).forward(image)
    np.testing.assert_allclose(found, np.einsum("ki,ij,kj->k", a, image, b), atol=1e-10 * image.sum())


@pytest.mark.parametrize("shape", [(8192, 2), (2, 8192)])
def test_single_precision_does_not_suffer_from_large_images(shape):
    rng = np.random.default_rng(5)
    uv, image = random_uv(rng, 0.9, 500), rng.standard_normal(shape)
    a, b = fourier_sum(uv, shape)
    found = MeasurementOperator(uv, CELL, shape, eps=1e-6).forward(image)
    assert np.linalg.norm(found - np.einsum("ki,ij,kj->k", a, image, b, optimize=True)) < 1e-6 * np.linalg.norm(found)


def test_equals_finufft_at_a_real_size():
    finufft = pytest.importorskip("finufft")
    rng = np.random.default_rng(6)
    cell, shape, size = 3e-7, (512, 256), 20000
    uv = rng.standard_normal((2, size)) * np.array([[0.06], [0.05]]) / cell
    weight, image = rng.uniform(0.1, 1, size), rng.uniform(0, 1, shape) ** 8
    x, y = -2 * np.pi * cell * uv[0], 2 * np.pi * cell * uv[1]
    expected = finufft.nufft2d2(x, y, image.astype(complex), isign=+1, eps=1e-12)
    dirty = finufft.nufft2d1(x, y, expected * weight, shape, isign=-1, eps=1e-12).real
    operator = MeasurementOperator(uv, cell, shape, eps=1e-5, nthreads=2)
    assert np.linalg.norm(operator.forward(image) - expected) < 1e-5 * np.linalg.norm(expected)
    assert np.linalg.norm(operator.adjoint(expected * weight) - dirty) < 1e-5 * np.linalg.norm(dirty)


def test_no_allocation_and_no_growth():
    rng = np.random.default_rng(8)
    shape, size = (512, 512), 50000
    operator = MeasurementOperator(random_uv(rng, 0.4, size), CELL, shape, eps=1e-4, nthreads=2)
    image, vis = rng.standard_normal(shape).astype("f4"), np.empty(size, "c8")

    def iterate(times):
        for _ in range(times):
            operator.forward(image, vis)
            operator.adjoint(vis, image)
            image[...] /= np.abs(image).max()

    iterate(3)
    gc.collect()
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tracemalloc.start()
    operator.forward(image, vis)
    operator.adjoint(vis, image)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    iterate(100)
    assert peak < 100_000
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 3_000  # KiB


def test_cell_too_large_names_the_largest_that_works():
    uv = np.array([[2e5, 1e4], [-3e4, 1e5]])
    with pytest.raises(ValueError, match="cell=0.6188arcsec is too large") as error:
        MeasurementOperator(uv, 3.0e-6, (32, 32))
    largest = float(re.search(r"at most cell=([\d.]+)arcsec", str(error.value)).group(1)) / 206264.806
    assert 2.49e-6 < largest < 2.5e-6
    MeasurementOperator(uv, largest, (32, 32))


@pytest.mark.parametrize("changes, message", [
    ({"uv": np.zeros((2, 0))}, "uv must be"), ({"uv": np.zeros((3, 4))}, "uv must be"),
    ({"uv": np.full((2, 4), np.nan)}, "uv must be finite"), ({"shape": (0, 4)}, "imsize"), ({"shape": (4,)}, "imsize"),
    ({"cell_rad": -1e-6}, "cell=-1e-06 must be positive"), ({"row_scale": np.ones(3)}, "row_scale must have shape"),
    ({"dtype": np.int32}, "dtype must be"), ({"eps": 1e-7}, "eps=1e-07 must be at least 1e-06 for float32"),
    ({"eps": 1e-15, "dtype": np.float64}, "eps=1e-15"), ({"eps": 1.0}, "eps=1.0"), ({"nthreads": 0}, "nthreads=0")])
def test_unusable_arguments_are_named(changes, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        MeasurementOperator(**{"uv": np.ones((2, 4)), "cell_rad": 1e-6, "shape": (8, 8)} | changes)


def test_arrays_of_the_wrong_kind_are_refused():
    operator = MeasurementOperator(np.ones((2, 4)), 1e-6, (8, 6))
    with pytest.raises(ValueError, match="image must be"):
        operator.forward(np.ones((6, 8)))
    with pytest.raises(ValueError, match="out must be"):
        operator.forward(np.ones((8, 6)), np.empty(4, complex))
    with pytest.raises(ValueError, match="vis must be"):
        operator.adjoint(np.ones(5))
    with pytest.raises(ValueError, match="out must be"):
        operator.adjoint(np.ones(4), np.empty((6, 8), "f4").T)


def test_chosen_accuracy_keeps_errors_far_below_the_noise_of_the_image():
    rng = np.random.default_rng(9)
    shape, size = (48, 40), 3000
    uv, image = random_uv(rng, 0.4, size), np.zeros(shape)
    image[tuple(rng.integers(8, 32, (2, 5)))] = rng.uniform(1, 2, 5)
    a, b = fourier_sum(uv, shape)
    vis = np.einsum("ki,ij,kj->k", a, image, b, optimize=True)
    dirty = np.einsum("ki,k,kj->ij", a.conj(), vis, b.conj(), optimize=True).real / size
    for dynamic_range in (1e5, 3e4):
        weight = np.full(size, (dynamic_range / dirty.max()) ** 2 / size)  # 1/√Σw is the noise of the dirty image
        eps = choose_eps(vis, weight)
        assert 0.3 / dynamic_range < eps < 1 / dynamic_range
        error = MeasurementOperator(uv, CELL, shape, eps=eps).adjoint(vis) / size - dirty
        assert np.abs(error).max() < 0.2 * dirty.max() / dynamic_range
    assert choose_eps(vis, weight * 1e-12) == choose_eps(vis * 0, weight) == 1e-4
    assert choose_eps(vis, weight * 1e12) == 1e-6
    assert choose_eps(vis, weight * 1e30, np.float64) == 1e-13


@pytest.mark.parametrize("reach, factor", [(0.5, 1), (0.211, 1), (0.21, 2), (0.15, 2), (0.1399, 3), (0.1, 4), (0.0, 8)])
@pytest.mark.parametrize("eps", [1e-3, 1e-6, 1e-11])
def test_decimation_factor_and_aliases(reach, factor, eps):
    axis = AxisDecimation(100, (0.05 - reach, 0.05 + reach), eps, 1e-16)
    assert axis.factor == factor
    frequency = np.linspace(-reach, reach, 101)
    t = np.arange(axis.taps.size) - axis.taps.size // 2

    def spectrum(shift):
        return np.abs(np.exp(-2j * np.pi * np.outer(frequency + 0.05 + shift, t)) @ axis.taps)

    np.testing.assert_allclose(spectrum(0) / factor, axis.response(frequency + 0.05), atol=1e-13)
    assert all(np.all(spectrum(k / factor) <= 1.01 * eps * spectrum(0)) for k in range(1, factor))


@pytest.mark.parametrize("width, eps", [(4, 1e-3), (5, 3e-5), (8, 1e-6), (16, 1e-13)])
def test_padding_is_the_least_that_is_accurate(width, eps):
    sigma = kaiser_bessel.padding(width, eps)
    assert 1.1 < sigma < 4
    assert kaiser_bessel.alias_level(width, sigma) <= eps < kaiser_bessel.alias_level(width, sigma - 1e-3)
    assert kaiser_bessel.padding(width, eps, low=3.9) == 3.9
    assert kaiser_bessel.padding(width, eps, high=sigma - 1e-3) == np.inf


@pytest.mark.parametrize("width, sigma", [(4, 2.0), (7, 1.5), (12, 1.3)])
def test_kernel_transform_and_polynomials(width, sigma):
    beta = kaiser_bessel.kernel_shape(width, sigma)
    nodes, weights = np.polynomial.legendre.leggauss(200)
    for xi in (0.0, 0.1, 0.5, 1.3):
        integral = width / 2 * np.sum(weights * kaiser_bessel.kernel(nodes, beta) * np.cos(np.pi * width * xi * nodes))
        assert kaiser_bessel.transform(xi, width, beta) == pytest.approx(integral, abs=1e-10)
    t = np.linspace(-1, 1, 41)
    polynomial = kaiser_bessel.kernel_polynomial(width, beta, width + 1)
    bound = 0.1 * kaiser_bessel.alias_level(width, sigma)
    for cell in range(width):
        exact = kaiser_bessel.kernel((cell + (1 - t) / 2 - width / 2) * 2 / width, beta)
        np.testing.assert_allclose(np.polyval(polynomial[:, cell], t), exact, atol=bound)
