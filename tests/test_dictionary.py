"""The SARA dictionary against PyWavelets, in double precision and one basis after another."""

import hashlib
import threading
import time
import tracemalloc
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import pywt
from scipy import ndimage

from casa_sara.operators import _filter_bank, _vectors, _wavelet_kernels, _wavelet_lines
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.options import SARA_BASES

pytestmark = pytest.mark.usefixtures("every_thread")

SHAPES = [(1, 1), (2, 40), (7, 3), (33, 18), (64, 128), (50, 200), (129, 66)]
make = cache(SaraDictionary)


def noise(shape, dtype=np.float64, seed=0):
    return np.random.default_rng(seed).normal(size=shape).astype(dtype)


def oracle_analysis(dictionary, image):
    """Ψ† image by pywt.dwt2, level by level, of the image continued with zeros."""
    coefs = np.zeros(dictionary.coef_shape)
    coefs[:, : image.shape[0], : image.shape[1]] = image
    for plane, name in zip(coefs, dictionary.wavelets):
        nx, ny = plane.shape
        for _ in range(dictionary.levels if name != "dirac" else 0):
            aa, (da, ad, dd) = pywt.dwt2(plane[:nx, :ny].copy(), name, mode="periodization")
            plane[:nx, :ny] = np.block([[aa, ad], [da, dd]])
            nx, ny = nx // 2, ny // 2
    return coefs / np.sqrt(len(coefs))


def oracle_synthesis(dictionary, coefs):
    """Ψ coefs by pywt.idwt2."""
    image = np.zeros(coefs.shape[1:])
    for plane, name in zip(np.array(coefs, float), dictionary.wavelets):
        for level in range(dictionary.levels if name != "dirac" else 0, 0, -1):
            mx, my = plane.shape[0] >> level, plane.shape[1] >> level
            bands = plane[:mx, :my], (plane[mx:2 * mx, :my], plane[:mx, my:2 * my], plane[mx:2 * mx, my:2 * my])
            plane[:2 * mx, :2 * my] = pywt.idwt2(bands, name, mode="periodization")
        image += plane
    return image[: dictionary.shape[0], : dictionary.shape[1]] / np.sqrt(len(coefs))


@pytest.mark.parametrize("levels", [1, 2, 3, 4])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_equals_pywavelets(shape, levels):
    dictionary = make(shape, levels=levels, dtype=np.float64)
    image = noise(shape)
    coefs = dictionary.analysis(image, out=noise(dictionary.coef_shape))
    np.testing.assert_allclose(coefs, oracle_analysis(dictionary, image), atol=1e-14 * np.abs(image).sum())
    coefs = noise(dictionary.coef_shape, seed=1)
    image = dictionary.synthesis(coefs, out=noise(shape))
    np.testing.assert_allclose(image, oracle_synthesis(dictionary, coefs), atol=1e-13)


@pytest.mark.parametrize("wavelets", [*((name,) for name in SARA_BASES), ("db8", "dirac", "db1")], ids=str)
def test_any_subset_of_bases(wavelets):
    dictionary = make((45, 70), wavelets, levels=3, dtype=np.float64)
    image = noise(dictionary.shape)
    coefs = dictionary.analysis(image)
    np.testing.assert_allclose(coefs, oracle_analysis(dictionary, image), atol=1e-13)
    np.testing.assert_allclose(dictionary.synthesis(coefs), image, atol=1e-13)


def test_deep_levels_of_a_small_image():
    dictionary = make((40, 3), levels=6, dtype=np.float64)
    image = noise(dictionary.shape)
    np.testing.assert_allclose(dictionary.analysis(image), oracle_analysis(dictionary, image), atol=1e-13)
    np.testing.assert_allclose(dictionary.synthesis(dictionary.analysis(image)), image, atol=1e-13)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_parseval_frame(shape):
    dictionary = make(shape, dtype=np.float64)
    image, coefs = noise(shape), noise(dictionary.coef_shape, seed=1)
    forth = dictionary.analysis(image)
    assert np.vdot(forth, coefs) == pytest.approx(np.vdot(image, dictionary.synthesis(coefs)), rel=1e-11)
    assert np.vdot(forth, forth) == pytest.approx(np.vdot(image, image), rel=1e-13)
    np.testing.assert_allclose(dictionary.synthesis(forth), image, atol=1e-13)


@pytest.mark.parametrize("weighted, relaxation", [(False, 1.0), (True, 1.0), (True, 1.7)])
@pytest.mark.parametrize("threshold", [0.3, tuple(np.linspace(0.0, 0.4, 9))], ids=["scalar", "per basis"])
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_dual_step(shape, threshold, weighted, relaxation):
    dictionary = make(shape, dtype=np.float64)
    image, before = noise(shape), 0.2 * noise(dictionary.coef_shape, seed=1)
    weights = np.random.default_rng(2).uniform(0, 2, dictionary.coef_shape) if weighted else None
    dual = before.copy()
    out = dictionary.dual_step(image, dual, np.array(threshold), weights, noise(shape, seed=3), relaxation)

    u = before + oracle_analysis(dictionary, image)
    limit = np.reshape(threshold, (-1, 1, 1)) * (1 if weights is None else weights)
    soft = np.sign(u) * np.maximum(np.abs(u) - limit, 0)
    expected = (1 - relaxation) * before + relaxation * (u - soft)
    np.testing.assert_allclose(dual, expected, atol=1e-13)
    np.testing.assert_allclose(out, oracle_synthesis(dictionary, expected), atol=1e-13)


def test_single_precision():
    dictionary = make((256, 320))
    image = noise(dictionary.shape, np.float32)
    exact = oracle_analysis(dictionary, image.astype(float))
    coefs = dictionary.analysis(image, noise(dictionary.coef_shape, np.float32))
    assert coefs.dtype == np.float32
    assert np.abs(coefs - exact).max() < 2e-6 * np.abs(exact).max()
    assert np.abs(dictionary.synthesis(coefs) - image).max() < 2e-6 * np.abs(image).max()
    dual = np.zeros(dictionary.coef_shape, np.float32)
    out = dictionary.dual_step(image, dual, 0.1)
    expected = oracle_synthesis(dictionary, np.clip(exact, -0.1, 0.1))
    assert np.abs(out - expected).max() < 2e-6 * np.abs(expected).max()


@pytest.mark.parametrize("shape", [(1, 1), (50, 200), (333, 129)], ids=str)
def test_threads_change_no_bit(shape):
    image = noise(shape, np.float32)
    weights = dual = None
    results = []
    for nthreads in (1, 2, 3, 11):
        dictionary = make(shape, nthreads=nthreads)
        weights = dictionary.reweight(image, 0.1, 1.0, out=dictionary.allocate())
        dual = dictionary.allocate() + np.float32(0.01)
        out = dictionary.dual_step(image, dual, 0.2, weights)
        results.append(np.concatenate([weights.ravel(), dual.ravel(), out.ravel()]))
    for other in results[1:]:
        np.testing.assert_array_equal(other, results[0])


@pytest.mark.parametrize("shape", [(5, 9), (64, 128)], ids=str)
def test_bands_cover_every_coefficient_once(shape):
    dictionary = make(shape, levels=3)
    count = np.zeros(dictionary.coef_shape, int)
    for band in dictionary.bands():
        count[band.slice] += 1
        plane = count[band.basis]
        if band.level:
            assert count[band.slice].shape == (plane.shape[0] >> band.level, plane.shape[1] >> band.level)
    assert dictionary.n_coefs == count.size
    assert np.all(count[1:] == 1)
    assert np.all(count[0, : shape[0], : shape[1]] == 1) and count[0].sum() == shape[0] * shape[1]


def test_band_orientation():
    """A pattern that alternates along the first axis only is detail along that axis only."""
    dictionary = make((64, 32), ("dirac", "db1"), dtype=np.float64)
    image = np.tile([[1.0], [-1.0]], (32, 32))
    coefs = dictionary.analysis(image)
    energy = {band[:3]: np.sum(coefs[band.slice] ** 2) for band in dictionary.bands()}
    assert energy.pop((1, 1, "da")) == pytest.approx(image.size / 2)
    assert energy.pop((0, 0, "aa")) == pytest.approx(image.size / 2)
    assert max(energy.values()) < 1e-20


@pytest.mark.parametrize("shape", [(37, 20), (64, 64), (1, 1), (40, 3)], ids=str)
def test_reweight(shape):
    """Against a 3×3 mean filter of scipy's, down to bands of one row or one column."""
    dictionary = make(shape, dtype=np.float64)
    image, bands = noise(shape), dictionary.bands()
    alpha, scale = np.random.default_rng(1).uniform(0.1, 1, (2, len(bands)))
    weights = dictionary.reweight(image, alpha, scale, out=noise(dictionary.coef_shape))
    coefs = oracle_analysis(dictionary, image)
    for band, value, factor in zip(bands, alpha, scale):
        around = np.sqrt(ndimage.convolve(coefs[band.slice] ** 2, np.full((3, 3), 1 / 9), mode="wrap"))
        np.testing.assert_allclose(weights[band.slice], factor * value / (value + around), rtol=1e-11)


def test_nothing_is_allocated():
    dictionary = make((256, 250), nthreads=2)
    image, out = noise(dictionary.shape, np.float32), np.empty(dictionary.shape, np.float32)
    dual, weights = dictionary.allocate(), dictionary.allocate()

    def everything():
        dictionary.analysis(image, dual)
        dictionary.synthesis(dual, out)
        dictionary.reweight(image, 0.1, 1.0, weights)
        dictionary.dual_step(image, dual, 0.1, weights, out)

    everything()
    tracemalloc.start()
    everything()
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < image.nbytes / 4


def test_two_dictionaries_at_once():
    shape = (200, 150)
    expected = make(shape, nthreads=2).analysis(noise(shape, np.float32))
    found = [None] * 4

    def work(i):
        dictionary = SaraDictionary(shape, nthreads=2)
        for _ in range(5):
            found[i] = dictionary.analysis(noise(shape, np.float32))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(len(found))]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for coefs in found:
        np.testing.assert_array_equal(coefs, expected)


def test_idle_threads_sleep():
    dictionary = make((256, 250), nthreads=2)
    dictionary.analysis(noise(dictionary.shape, np.float32))
    busy = time.process_time()
    time.sleep(0.3)
    assert time.process_time() - busy < 0.03


@pytest.mark.parametrize("arguments, name", [
    ({"shape": (0, 5)}, "imsize"),
    ({"shape": (5,)}, "imsize"),
    ({"wavelets": ("db9",)}, "wavelets"),
    ({"wavelets": ("db1", "db1")}, "wavelets"),
    ({"wavelets": ()}, "wavelets"),
    ({"levels": 0}, "wavelevels"),
    ({"dtype": np.complex64}, "dtype"),
    ({"nthreads": 0}, "nthreads"),
])
def test_bad_arguments(arguments, name):
    with pytest.raises(ValueError, match=name):
        SaraDictionary(**{"shape": (8, 8), **arguments})


def test_bad_arrays():
    dictionary = make((20, 30), levels=2)
    image, coefs = np.zeros((20, 30), np.float32), dictionary.allocate()
    with pytest.raises(ValueError, match="image"):
        dictionary.analysis(image.T)
    with pytest.raises(ValueError, match="coefs"):
        dictionary.synthesis(coefs.astype(np.float64))
    with pytest.raises(ValueError, match="out"):
        dictionary.synthesis(coefs, np.zeros((30, 20), np.float32).T)
    with pytest.raises(ValueError, match="dual"):
        dictionary.dual_step(image, coefs[1:], 0.1)
    with pytest.raises(ValueError, match="weights"):
        dictionary.dual_step(image, coefs, 0.1, coefs[0])
    with pytest.raises(ValueError, match="threshold"):
        dictionary.dual_step(image, coefs, -0.1)
    with pytest.raises(ValueError, match="alpha"):
        dictionary.reweight(image, 0.0, 1.0, coefs)


def test_cached_code_knows_its_source():
    """Numba's cache watches _wavelet_kernels.py only; SOURCE there makes it change together with the other files."""
    digest = hashlib.sha256(b"".join(Path(module.__file__).read_bytes()
                                     for module in (_vectors, _filter_bank, _wavelet_lines)))
    assert _wavelet_kernels.SOURCE == digest.hexdigest()[:12], f"set SOURCE = {digest.hexdigest()[:12]!r}"
