"""Unknown spectra: frequencies, operator and prior against explicit sums and matrices, and whole runs."""

import json
import os
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from dense_problem import DenseMeasurement
from scipy.optimize import minimize
from simulated_ms import column, edit, pixels
from test_spectral import CELL, GRID, INDEX, REFERENCE, SHAPE, SIZE, SOURCES, fluxes, fourier_sum, residual_noise, vis

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.comparison.compare_images import compare_images
from casa_sara.data.visibilities import BlockInfo
from casa_sara.imaging.spectra import LARGEST_ERROR, divided_by_band, spectral_index
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.sky import sky_operator
from casa_sara.operators.subbands import SubbandDictionary, Subbands
from casa_sara.options import Comparing, ImageGrid, Selection, SolverOptions
from casa_sara.reconstruction.problem import Problem, Samples
from casa_sara.runtime.scratch import IN_MEMORY
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.l1_weights import first_weights
from casa_sara.solver.l2_bounds import AdaptiveBounds
from casa_sara.solver.planes import Planes
from casa_sara.solver.point_sources import PointSources
from casa_sara.solver.positivity import Release
from casa_sara.solver.significance import point_response

pytestmark = pytest.mark.usefixtures("every_thread")

__all__ = ["vis"]  # a fixture


def octave(nterms, size=500, seed=5):
    """Frequencies with a gap, their weights, and what follows of them."""
    rng = np.random.default_rng(seed)
    freq_hz = np.concatenate([rng.uniform(1.0e9, 1.3e9, size // 2), rng.uniform(1.5e9, 2.0e9, size - size // 2)])
    weight = rng.uniform(0.2, 3, size)
    return freq_hz, weight, Subbands.of(freq_hz, weight, nterms, 1.5e9)


@pytest.mark.parametrize("nterms", [1, 2, 3, 5])
def test_the_data_do_not_mix_the_frequencies(nterms):
    freq_hz, weight, subbands = octave(nterms)
    factors, roots = subbands.factors(freq_hz), np.sqrt(subbands.shares)
    np.testing.assert_allclose((factors * weight) @ factors.T / weight.sum(), np.eye(nterms), atol=1e-9)
    np.testing.assert_allclose(roots @ factors, 1, rtol=1e-12)  # a sky that is the same at all frequencies
    np.testing.assert_allclose(subbands.orders @ subbands.orders.T, np.eye(nterms), atol=1e-12)
    np.testing.assert_allclose(subbands.orders[0], roots, rtol=1e-12)
    # its polynomial in ln ν, of any power below nterms
    for power in range(nterms):
        at_nodes = np.log(subbands.freqs_hz / 1.5e9) ** power
        np.testing.assert_allclose((at_nodes * roots) @ factors, np.log(freq_hz / 1.5e9) ** power, atol=1e-9)
    assert np.all(np.diff(subbands.freqs_hz) > 0) and freq_hz.min() < subbands.freqs_hz[0]
    parts = np.bincount(subbands.band_of(freq_hz), weight, nterms) / weight.sum()
    np.testing.assert_allclose(parts, subbands.shares, atol=0.12)


def test_more_terms_than_frequencies_are_refused():
    with pytest.raises(ValueError, match="nterms = 3: the data have 2 frequencies; should be at most as many"):
        Subbands.of(np.array([1e9, 2e9, 1e9], np.float32), np.ones(3), 3, 1.5e9)


@pytest.mark.parametrize("dtype, eps", [(np.float32, 1e-6), (np.float64, 1e-10)])
def test_equals_the_sum_over_frequencies(dtype, eps):
    rng = np.random.default_rng(0)
    freq_hz, _, subbands = octave(3, SIZE)
    uvw, scale = rng.uniform(-0.4, 0.4, (3, SIZE)) / np.array([*CELL, 5e-3])[:, None], rng.uniform(0.5, 2, SIZE)
    spectra = rng.uniform(0, 1, (3, *SHAPE)).astype(dtype)
    operator = sky_operator(uvw, ImageGrid(SHAPE, CELL, nterms=3, subbands=subbands), freq_hz, scale, eps, dtype, 2)
    matrix = fourier_sum(uvw, 0) * scale[:, None]
    # Neville's rule for the value of the polynomial, in place of Lagrange's
    values, places = [plane.ravel()[None, :] for plane in spectra], np.log(subbands.freqs_hz)
    at = np.log(freq_hz)[:, None]
    for step in (1, 2):
        values = [((at - places[k + step]) * values[k] - (at - places[k]) * values[k + 1])
                  / (places[k] - places[k + step]) for k in range(3 - step)]
    expected = (matrix * values[0]).sum(axis=1)
    image = subbands.stacked(spectra)
    assert image.shape == operator.shape == (3 * SHAPE[0], SHAPE[1])
    found = operator.forward(image)
    assert np.linalg.norm(found - expected) < 20 * eps * np.linalg.norm(expected)
    np.testing.assert_allclose(subbands.spectra(image), spectra, rtol=1e-6)
    back = rng.standard_normal(SIZE) + 1j * rng.standard_normal(SIZE)
    products = np.vdot(found, back).real, np.vdot(image, operator.adjoint(back))
    assert abs(products[0] - products[1]) < 20 * eps * np.linalg.norm(found) * np.linalg.norm(back)


@pytest.mark.parametrize("nterms", [2, 3])
def test_the_edges_of_the_band_slow_nothing_down(nterms):
    """Where in the uv plane there are but frequencies of one edge, the steps are as long as elsewhere."""
    rng, size, grid = np.random.default_rng(4), 4000, ImageGrid((32, 32), (1e-5, 1e-5))
    freq_hz = rng.uniform(1e9, 2e9, size)
    baseline = rng.uniform(0.02, 0.24, size) / 1e-5  # wavelengths at 1 GHz: beyond half of the longest, high ones alone
    uvw = np.array([*baseline * freq_hz / 1e9 * [np.cos(turn := rng.uniform(0, 6.28, size)), np.sin(turn)],
                    np.zeros(size)])
    ones = np.ones(size, np.float32)
    data = SimpleNamespace(vis=ones.astype(np.complex64), weight=ones, uvw=uvw, freq_hz=freq_hz, size=size, beam=None,
                           scratch=IN_MEMORY)
    density = np.histogram2d(*uvw[:2], 32, [[-5e4, 5e4]] * 2)[0][tuple(np.floor((uvw[:2] + 5e4) / 3125).astype(int))]
    samples = Samples(data, np.array([0, size]), density)
    norms, options = [], SolverOptions(averaging=False)
    for subbands in (None, Subbands.of(freq_hz, ones, nterms, 1.5e9)):
        norms.append(Problem.of(samples, replace(grid, subbands=subbands), options, 1.0, 1e-4).data_norm_sq)
    assert norms[1] < 1.7 * norms[0]


def small_prior(nterms, shape=(4, 4), dtype=np.float64):
    _, _, subbands = octave(nterms)
    one = SaraDictionary(shape, ("dirac", "db1"), 1, dtype)
    return SubbandDictionary(one, subbands.orders), one, subbands


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_prior_is_the_same_to_the_last_bit_for_any_number_of_threads(dtype):
    _, _, subbands = octave(3)
    shape, rng = (96, 130), np.random.default_rng(7)
    image = rng.standard_normal((3 * shape[0], shape[1])).astype(dtype)
    coefs = [SubbandDictionary(SaraDictionary(shape, ("dirac", "db2"), 2, dtype, nthreads=count), subbands.orders,
                               count).analysis(image) for count in (1, 2, 3)]
    np.testing.assert_array_equal(coefs[0], coefs[1])
    np.testing.assert_array_equal(coefs[0], coefs[2])
    orders = np.einsum("kt,txy->kxy", subbands.orders, image.reshape(3, *shape).astype(float))
    np.testing.assert_allclose(coefs[0][:, 0, :, :shape[1]], orders / np.sqrt(2), atol=1e-5)


def test_prior_is_that_of_the_orders_of_the_spectra():
    rng = np.random.default_rng(3)
    prior, one, subbands = small_prior(3)
    image, weights = rng.standard_normal((12, 4)), rng.uniform(0.1, 1, (3, *one.coef_shape))
    orders = np.einsum("kt,txy->kxy", subbands.orders, image.reshape(3, 4, 4))
    coefs = prior.analysis(image)
    for order, found in zip(orders, coefs):
        np.testing.assert_allclose(found, one.analysis(order), atol=1e-12)
    np.testing.assert_allclose(prior.synthesis(coefs), image, atol=1e-12)  # Parseval
    flat = prior.analysis(subbands.stacked(orders[0]))
    np.testing.assert_allclose(flat[0], one.analysis(orders[0]), atol=1e-12)
    assert np.abs(flat[1:]).max() < 1e-12  # a flat spectrum has one order
    assert len(prior.bands()) == 3 * len(one.bands())
    for band, other in zip(prior.bands(), [*one.bands()] * 3):
        assert coefs[band.slice].shape == coefs[0][other.slice].shape

    # the proximal operator of the prior by brute force: u + Ψ†x̄ less its minimiser, for every coefficient
    dual, threshold, rho = rng.standard_normal(coefs.shape), 0.4, 1.3
    before = dual.copy()
    out = prior.dual_step(image, dual, threshold, weights, np.empty((12, 4)), rho)
    step = before + coefs
    trial = np.linspace(-6, 6, 240_001)
    for place in [(0, 0, 1, 2), (1, 0, 3, 3), (1, 1, 0, 0), (2, 1, 2, 1)]:
        cost = 0.5 * (trial - step[place]) ** 2 + threshold * weights[place] * np.abs(trial)
        clipped = step[place] - trial[np.argmin(cost)]
        assert dual[place] == pytest.approx(before[place] + rho * (clipped - before[place]), abs=2e-4)
    np.testing.assert_allclose(out, prior.synthesis(dual), atol=1e-12)

    # weights: of every order by itself
    count = len(one.bands())
    alpha, scale = rng.uniform(0.1, 1, 3 * count), rng.uniform(1, 2, 3 * count)
    found = prior.reweight(image, alpha, scale, prior.allocate())
    for k in range(3):
        part = slice(k * count, (k + 1) * count)
        np.testing.assert_allclose(found[k], one.reweight(orders[k], alpha[part], scale[part], one.allocate()))
    pixels = np.zeros((12, 4), bool)
    pixels[5, 2] = True  # of the second image
    scaled = found.copy()
    prior.scale_at(scaled, pixels, 0.25)
    assert all(after[0, 1, 2] == pytest.approx(0.25 * now[0, 1, 2]) for after, now in zip(scaled, found))


def dense_problem():
    """Two frequencies, 4 × 4 pixels, more unknowns than samples see well."""
    rng = np.random.default_rng(8)
    prior, one, subbands = small_prior(2)
    freq_hz = np.linspace(1e9, 2e9, 40)
    base = (rng.normal(size=(40, 16)) + 1j * rng.normal(size=(40, 16))) * rng.uniform(0.2, 1, 40)[:, None]
    factors = subbands.factors(freq_hz)
    matrix = np.hstack([base * factor[:, None] for factor in factors])
    truth = np.zeros((2, 4, 4))
    truth[:, 1, 2], truth[:, 3, 0] = 2 * (subbands.freqs_hz / 1.5e9) ** -1.0, 1.0
    noise = 0.3 * (rng.normal(size=40) + 1j * rng.normal(size=40))
    return prior, subbands, DenseMeasurement(matrix, (8, 4)), matrix @ subbands.stacked(truth).ravel() + noise, truth


def iteration(prior, subbands, measurement, data):
    precond = np.ones(40)
    norm = np.linalg.norm(np.vstack([measurement.matrix.real, measurement.matrix.imag]), 2) ** 2
    ppd = AdaptivePPD(measurement, prior, data, np.array([0, 15, 40]), precond, norm)
    ppd.planes = Planes(np.sqrt(subbands.shares), subbands.reference_weights(), True)
    ppd.rescale(0.2)
    return ppd


def test_two_frequencies_reach_the_minimiser_that_slsqp_finds():
    prior, subbands, measurement, data, truth = dense_problem()
    ppd, samples = iteration(prior, subbands, measurement, data), np.array([15, 25])
    bounds = AdaptiveBounds(np.array([0.3, 0.4]) * np.sqrt(2.0 * samples), samples, np.array([20.0, 30.0]), 2,
                            rel_change=0.0)
    first_weights(ppd, bounds)
    assert ppd.l1_weights[0].min() == 1 and ppd.l1_weights[1].min() >= 2  # slopes are smaller than the mean
    bounds.apply_to(ppd)
    for _ in range(15_000):
        ppd.step()
    # Ψ†F as one matrix, column by column; the same cost by coordinates: z ≥ 0, t ≥ |WΨ†Fz|
    matrix = np.array([prior.analysis(unit).ravel() for unit in np.eye(32).reshape(-1, 8, 4)]).T
    matrix *= ppd.l1_weights.ravel()[:, None]
    sigma_sq = np.repeat(bounds.noise**2, samples)

    def cost(z):
        residual = data - measurement.matrix @ z[:32]
        gradient = -(measurement.matrix.conj().T @ (residual / sigma_sq)).real
        value = bounds.gradient_noise * z[32:].sum() + 0.5 * np.sum(np.abs(residual) ** 2 / sigma_sq)
        return value, np.concatenate([gradient, np.full(len(matrix), bounds.gradient_noise)])

    linear = np.block([[matrix, np.eye(len(matrix))], [-matrix, np.eye(len(matrix))]])
    start = subbands.stacked(truth).ravel()
    result = minimize(cost, np.concatenate([start, np.abs(matrix @ start)]), jac=True, method="SLSQP",
                      bounds=[(0, None)] * 32 + [(None, None)] * len(matrix),
                      constraints=[{"type": "ineq", "fun": lambda z: linear @ z, "jac": lambda z: linear}],
                      options={"ftol": 1e-14, "maxiter": 1000})
    np.testing.assert_allclose(ppd.model.ravel(), result.x[:32], atol=2e-4 * ppd.model.max())
    seen = ppd.planes.at_reference(ppd.model)
    assert ppd.model_flux == pytest.approx(seen.sum()) and ppd.model_max == pytest.approx(seen.max())


def test_what_all_frequencies_show_together():
    """Point response, places of points and lowered bounds of stacked images."""
    prior, subbands, measurement, data, _ = dense_problem()
    ppd, samples = iteration(prior, subbands, measurement, data), np.array([15, 25])
    bounds = AdaptiveBounds(np.sqrt(2.0 * samples), samples, np.ones(2), 2)
    flat = np.einsum("t,mtp->mp", np.sqrt(subbands.shares), measurement.matrix.reshape(40, 2, 16))
    expected = (flat.conj().T @ flat[:, 10]).real.reshape(4, 4)
    np.testing.assert_allclose(point_response(ppd, bounds), expected, rtol=1e-10)
    assert PointSources([[0.5, 0.25]]).places.tolist() == [[0.5, 0.25]]
    both = ppd.planes.points([PointSources([[0.5, 0.25]])], (8, 4))
    assert both.places.tolist() == [[0.5, 0.25], [4.5, 0.25]]
    # nothing reaches from one image into the next: a bright last row of the first lowers no bound of the second
    ppd.model[3, 1] = 1.0
    release = Release()
    release._asked = np.full(ppd.model.shape, -1e-9, np.float32)
    release.update(ppd, bounds)
    assert not ppd.lowest[4:].any()


def test_blocks_are_divided_by_frequency_unless_a_part_has_few_samples():
    freq_hz, _, subbands = octave(2, 1000)
    block = np.repeat([0, 1], [700, 300])  # of the second, nothing is at low frequencies but 150 samples
    freq_hz = np.concatenate([freq_hz[:350], freq_hz[-350:], freq_hz[350:500], freq_hz[500:650]])
    infos = [BlockInfo("a.ms", (0,), (scan,), 0.0, 1.0, size) for scan, size in ((1, 700), (2, 300))]
    order = np.random.default_rng(0).permutation(1000)
    data = SimpleNamespace(freq_hz=freq_hz[order])
    found, divided = divided_by_band(block[order], infos, data, subbands)
    assert [info.samples for info in divided] == [350, 350, 300] == np.bincount(found).tolist()
    assert [info.scans for info in divided] == [(1,), (1,), (2,)]
    for number, info in enumerate(divided):
        here = data.freq_hz[found == number]
        assert info.band_hz == (here.min(), here.max()) and "GHz, " in info.label
    assert divided[0].band_hz[1] < divided[1].band_hz[0]
    assert divided[2].band_hz[0] < 1.3e9 < 1.5e9 < divided[2].band_hz[1]
    assert divided_by_band(block, infos, data, None)[1] is infos


def test_index_and_error_of_a_power_law():
    _, _, subbands = octave(3)
    rng, noise, truth = np.random.default_rng(2), 1e-3, -0.7
    clean = np.ones((3, 200, 200)) * (subbands.freqs_hz / 1.5e9)[:, None, None] ** truth
    index, _, known = spectral_index(clean, subbands, noise)
    assert known.all() and np.abs(index - truth).max() < 1e-5
    level = noise / np.sqrt(subbands.shares)[:, None, None]
    seen = clean * 0.03 + level * rng.standard_normal(clean.shape)
    seen[:, :, :100] *= 0.1  # too faint
    seen[1, 0, 150] = -0.01
    index, error, known = spectral_index(seen, subbands, noise)
    assert not known[:, :100].any() and not known[0, 150] and known[1:, 100:].mean() > 0.95
    assert error[known].max() <= LARGEST_ERROR and not index[~known].any() and not error[~known].any()
    assert np.std((index[known] - truth) / error[known]) == pytest.approx(1, abs=0.1)


# Runs -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def run(vis, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("run") / "spectra")
    return tsara(vis=vis, imagename=name, nterms=3, savemodel="modelcolumn", **GRID), name


def opened(name):
    ia = casatools.image()
    ia.open(name)
    return ia


def test_index_and_flux_are_found(run):
    """Within 1 %, and 0.02 of the index, of what was simulated; the residual is noise."""
    result, name = run
    np.testing.assert_allclose(fluxes(name), list(SOURCES.values()), rtol=0.01)
    ia = opened(name + ".alpha")
    index, known = (ia.getchunk(getmask=mask)[:, :, 0, 0] for mask in (False, True))
    assert ia.brightnessunit() == "" and ia.restoringbeam() and list(ia.shape()) == [64, 64, 1, 1]
    assert ia.coordsys().referencevalue()["numeric"][3] == REFERENCE
    ia.close()
    for x, y in SOURCES:
        assert known[x, y] and index[x, y] == pytest.approx(INDEX, abs=0.02)
    assert not known[5, 5] and 0.01 < known.mean() < 0.5
    ia = opened(name + ".alpha.error")
    assert 0 < ia.getchunk()[32, 32, 0, 0] < 0.02
    assert np.array_equal(ia.getchunk(getmask=True)[:, :, 0, 0], known)
    ia.close()
    assert residual_noise(result) < 1.1
    assert [block["band_hz"] for block in result["sara"]["blocks"][:3]] == \
        sorted(block["band_hz"] for block in result["sara"]["blocks"][:3])


def test_cube_of_the_frequencies(run):
    ia = opened(run[1] + ".subbands")
    cube, csys = ia.getchunk()[:, :, 0, :], ia.coordsys()
    freqs = [csys.toworld([0, 0, 0, k])["numeric"][3] for k in range(3)]
    assert ia.brightnessunit() == "Jy/pixel" and cube.shape == (64, 64, 3)
    assert cube.min() > -0.02 * cube.max() and (cube < 0).sum() < 3 * 72  # of the points alone: 6 x 6 pixels each
    assert csys.axiscoordinatetypes()[3] == "Spectral"
    ia.close()
    assert 4e9 < freqs[0] < freqs[1] < freqs[2] < 8e9
    np.testing.assert_allclose(run[0]["sara"]["spectra"]["frequencies_hz"], freqs, rtol=1e-9)
    for (x, y), flux in SOURCES.items():
        found = cube[x - 2 : x + 3, y - 2 : y + 3].sum(axis=(0, 1))
        np.testing.assert_allclose(found, flux * (np.array(freqs) / REFERENCE) ** INDEX, rtol=0.015)


def left_in_columns(vis):
    """Reduced χ² of DATA − MODEL_DATA, by window."""
    window, sigma = column(vis, "DATA_DESC_ID"), column(vis, "SIGMA")
    power = np.abs(column(vis, "DATA") - column(vis, "MODEL_DATA")) ** 2 / (2 * sigma[:, None, :] ** 2)
    return [float(power[..., window == number].mean()) for number in np.unique(window)]


def test_model_column_has_the_spectra(run, vis):
    assert max(left_in_columns(vis)) < 1.1
    edit(vis, "MODEL_DATA", lambda old: np.zeros_like(old))
    tsara(vis=vis, imagename=run[1], nterms=3, savemodel="modelcolumn", niter=0, restart=True, **GRID)
    assert max(left_in_columns(vis)) < 1.1


@pytest.mark.slow
def test_errors_are_of_the_draws(run, vis, tmp_path, monkeypatch):
    name = str(tmp_path / "drawn")
    result = tsara(vis=vis, imagename=name, nterms=3, ndraws=8, jackknife=True, **GRID)
    assert result["sara"]["draws"] == dict(asked=8, made=8)
    for suffix in (".model", ".alpha", ".subbands"):
        np.testing.assert_array_equal(pixels(name + suffix), pixels(run[1] + suffix))
    for suffix, unit in ((".model.error", "Jy/pixel"), (".image.error", "Jy/beam"), (".image.jackknife", "Jy/beam")):
        ia = opened(name + suffix)
        assert ia.brightnessunit() == unit and ia.getchunk().shape == (64, 64, 1, 1) and ia.getchunk().max() > 0
        ia.close()
    islands = result["sara"]["islands"]
    noise = result["sara"]["chosen"]["noise_jy_per_beam"]
    assert all(0.2 < one["bootstrap_error_jy"] / noise < 10 and one["jackknife_error_jy"] > 0 for one in islands)
    with np.load(name + ".draws.npz") as arrays:
        assert arrays["shape"].tolist() == [64, 64] and len(arrays["scales"]) == 8
    # stopped within the draws
    from casa_sara.reconstruction.draws import Draws
    from casa_sara.runtime.deadline import Deadline

    stopped, made, add = str(tmp_path / "stopped"), [], Draws.add
    monkeypatch.setattr(Draws, "add", lambda self, difference: made.append(add(self, difference)))
    monkeypatch.setattr(Deadline, "near", lambda self: len(made) > 3)
    options = dict(vis=vis, imagename=stopped, nterms=3, ndraws=8, jackknife=True, **GRID)
    assert not tsara(**options)["sara"].get("draws", {}).get("made")
    monkeypatch.undo()
    tsara(restart=True, **options)
    for suffix in (".model.error", ".image.error", ".image.jackknife"):
        np.testing.assert_array_equal(pixels(stopped + suffix), pixels(name + suffix))


@pytest.mark.slow
def test_report_is_of_the_spectra(run, vis, tmp_path):
    name = str(tmp_path / "told")
    result = tsara(vis=vis, imagename=name, nterms=3, report=True, **GRID)
    assert result["stopcode"] == run[0]["stopcode"]
    measures = json.loads((tmp_path / "told.report/measures.json").read_text())
    (product,) = measures["products"].values()
    assert max(product["natural"]["chi_square"]) < 1.2


def test_one_term_is_what_no_terms_are(vis, tmp_path):
    made = [tsara(vis=vis, imagename=str(tmp_path / name), niter=8, **more, **GRID)
            for name, more in (("a", {}), ("b", dict(nterms=1)))]
    for suffix in (".model", ".residual", ".image", ".psf"):
        first, second = (opened(str(tmp_path / name) + suffix) for name in "ab")
        assert np.array_equal(first.getchunk(), second.getchunk())
        first.close()
        second.close()
    assert made[0]["iterdone"] == made[1]["iterdone"]
    assert not [name for name in os.listdir(tmp_path) if "alpha" in name or "subbands" in name]


@pytest.mark.slow
def test_a_stopped_run_goes_on_to_the_same_images(vis, tmp_path, run, monkeypatch):
    from casa_sara.runtime.deadline import Deadline

    asked = []
    monkeypatch.setattr(Deadline, "near", lambda self: asked.append(1) or len(asked) > 150)
    name = str(tmp_path / "stopped")
    assert tsara(vis=vis, imagename=name, nterms=3, **GRID)["stopDescription"] == "time limit"
    assert os.path.exists(name + ".checkpoint") and os.path.exists(name + ".alpha")
    monkeypatch.undo()
    tsara(vis=vis, imagename=name, nterms=3, restart=True, **GRID)
    for suffix in (".model", ".alpha", ".subbands"):
        first, second = opened(name + suffix), opened(run[1] + suffix)
        assert np.array_equal(first.getchunk(), second.getchunk())
        first.close()
        second.close()


def test_comparison_keeps_the_spectra(run, vis):
    request = Comparing((run[1],), ("spectra",))
    measures = compare_images(request, Selection((vis,), datacolumn="data"), single=True).measures["products"]
    assert max(measures["spectra"]["natural"]["chi_square"]) < 1.2
    with pytest.raises(ValueError, match="inject = .*: needs vis, and images of tsara"):
        compare_images(Comparing((run[1], run[1] + ".model"), ("a", "b"), inject=("19h59m29.8s +40d43m20s",)),
                       Selection((vis,), datacolumn="data"))


def test_memory_and_time_are_forecast(vis, tmp_path):
    said = {n: tsara(vis=vis, imagename=str(tmp_path / "none"), nterms=n, dryrun=True, **GRID)["forecast"]
            for n in (1, 3)}
    parts = {n: one["memory_bytes"]["iterating"] for n, one in said.items()}
    assert parts[3]["wavelet duals and weights"] == 3 * parts[1]["wavelet duals and weights"]
    assert parts[3]["operator"] > parts[1]["operator"] and said[3]["iteration_s"] > 0
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("more, message", [
    (dict(spw="0"), "nterms = 2: the data span 0.05 % in frequency, which shows no spectrum; should be 1"),
    (dict(reffreq="3.7GHz"), "reffreq = '3.7GHz' with nterms = 2: the data are at 4 to 8.002 GHz"),
    (dict(reffreq="8.5GHz"), "reffreq = '8.5GHz' with nterms = 2: the data are at 4 to 8.002 GHz"),
    (dict(nterms=0), "nterms = 0: should be from 1 to 6"), (dict(nterms=7), "nterms = 7: should be from 1 to 6"),
    (dict(gridder="wproject"), "gridder = 'wproject' with nterms = 2: .*; should be 'standard' or 'mosaic'"),
    (dict(spectralindex=-0.7), "spectralindex = -0.7 with nterms = 2: either the index is known"),
    (dict(specmode="cube", reffreq=""), "nterms = 2 has no effect with specmode = 'cube'"),
    (dict(parallel=True), "parallel = True with nterms"),
    (dict(positivity=False), "positivity = False with nterms"),
    (dict(method="dabbech2018"), "method = 'dabbech2018' with nterms"),
    (dict(stokes="V", positivity=False), "stokes = 'V' with nterms")])
def test_what_spectra_do_not_have_is_refused(vis, tmp_path, more, message):
    with pytest.raises(ValueError, match=message):
        tsara(vis=vis, imagename=str(tmp_path / "none"), **GRID | dict(nterms=2) | more)
    assert os.listdir(tmp_path) == []
