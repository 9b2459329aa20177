"""method='dabbech2018': Algorithms 1 and 2 against a few lines of dense algebra in the paper's symbols,
and the task."""

import copy
import os
import warnings
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import pywt
from scipy.optimize import brentq, nnls as scipy_nnls
from test_visibilities import observation

from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.norms import power_method
from casa_sara.options import SARA_BASES, ImageGrid, SolverOptions
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.paper_method import block_norms
from casa_sara.reconstruction.problem import Problem, Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.reconstruction.settings import schedule_of
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.dabbech2018 import PaperBounds, PaperSchedule, PaperStage, run_paper_algorithm_2
from casa_sara.solver.paperprior import RELAXATION, PaperPrior
from casa_sara.solver.record import CONVERGED, DIVERGED, ITERATION_LIMIT, STOPPED_BY_USER

SHAPE, CELL, LEVELS, TAU = (16, 16), 1e-6, 2, 0.495
SIZE = SHAPE[0] * SHAPE[1]
# every move of Algorithm 1 and 2 within a few hundred iterations
QUICK = PaperSchedule(gamma_1=3e-3, gamma_2=1e-2, gamma_3=0.618, interval=7, kappa=0.02, omega=0.6, reweightings=4,
                      reltol=1e-3, final_reltol=2e-4)


# the paper, in dense matrices of float64 ----------------------------------------------------------------------

def fourier_matrix(uv):
    """Φ: V = Σ x exp(2πi(ul + vm)), l = (nx/2 − ix)·cell, m = (iy − ny/2)·cell."""
    ix, iy = np.divmod(np.arange(SIZE), SHAPE[1])
    return np.exp(2j * np.pi * CELL * (np.outer(uv[0], SHAPE[0] // 2 - ix) + np.outer(uv[1], iy - SHAPE[1] // 2)))


def analysis_matrices():
    """Ψ_i† of Dirac and Db1–8, each orthonormal."""
    unit = np.eye(SIZE).reshape(-1, *SHAPE)
    matrices = [np.eye(SIZE)]
    for name in SARA_BASES[1:]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of filters longer than the image
            coefs = [pywt.coeffs_to_array(pywt.wavedec2(one, name, "periodization", LEVELS))[0].ravel() for one in unit]
        matrices.append(np.array(coefs).T)
    return matrices


def ellipsoid_projection(point, y, U, eps):
    """P_E of a point: the nearest s̄ with ‖U^{-1/2}s̄ − y‖ ≤ ε, by the root of its multiplier."""
    def of(multiplier):
        return y + (U**-0.5 * point - y) * U / (U + multiplier)

    if np.linalg.norm(of(0) - y) <= eps:
        return point
    end = 1.0
    while np.linalg.norm(of(end) - y) > eps:
        end *= 10
    root = brentq(lambda multiplier: np.linalg.norm(of(multiplier) - y) - eps, 0, end, xtol=1e-15, rtol=1e-14)
    return U**0.5 * of(root)


def paper(y, Phi, U, eps, kappa, par):
    """Yield (t, k, x, ε) after each iteration; y, Φ, U, ε are lists of blocks."""
    PsiT, (d, N) = analysis_matrices(), (len(y), Phi[0].shape[1])
    weighted = np.vstack([np.sqrt(u)[:, None] * phi for u, phi in zip(U, Phi)])
    eta = np.linalg.norm(np.vstack([weighted.real, weighted.imag]), 2) ** -2.0
    x, xbar, x_before = np.zeros(N), np.zeros(N), np.zeros(N)
    u, v = [np.zeros(N) for _ in PsiT], [np.zeros(len(one), complex) for one in y]
    W, eps, p, sigma, t, k, last = [np.ones(N) for _ in PsiT], list(eps), [0] * d, np.inf, 0, 0, par.reweightings == 0
    while True:
        PsiW = np.vstack([w[:, None] * psi for w, psi in zip(W, PsiT)])
        norm = np.linalg.norm(PsiW, 2)
        zeta = norm**-2.0
        while True:  # Algorithm 1
            t += 1
            mu, moved = [0.0] * d, False
            for j in range(d):
                s = v[j] / U[j] + Phi[j] @ xbar
                v[j] = U[j] * (s - U[j] ** -0.5 * ellipsoid_projection(U[j] ** 0.5 * s, y[j], U[j], eps[j]))  # Step 5
                mu[j] = np.linalg.norm(y[j] - Phi[j] @ x)  # Step 6
            for i, psi in enumerate(PsiT):  # Step 13
                point = u[i] + W[i] * (psi @ xbar)
                u[i] = point - np.sign(point) * np.maximum(np.abs(point) - kappa * norm, 0)
            gradient = eta * sum((phi.conj().T @ vj).real for phi, vj in zip(Phi, v))
            gradient += zeta * sum(psi.T @ (w * ui) for psi, w, ui in zip(PsiT, W, u))
            new = np.maximum(x - TAU * gradient, 0)  # Step 17
            x, xbar, sigma_new = new, 2 * new - x, np.linalg.norm(new - x) / np.linalg.norm(new)  # Steps 17–19
            for j in range(d):  # Steps 7–10
                if sigma < par.gamma_1 and t - p[j] >= par.interval and abs(mu[j] - eps[j]) / eps[j] > par.gamma_2:
                    eps[j], p[j], moved = par.gamma_3 * mu[j] + (1 - par.gamma_3) * eps[j], t, True
            sigma = sigma_new
            yield t, k, x, np.array(eps)
            met = all(mu[j] <= (1 + par.gamma_2) * eps[j] for j in range(d))
            if sigma < (par.final_reltol if last else par.reltol) and met and not moved:
                break
        if last:
            return
        change, x_before = np.linalg.norm(x - x_before) / np.linalg.norm(x), x
        if change < par.varrho:
            last = True
            continue
        k += 1  # equation (5)
        W = [par.omega**k / (par.omega**k + np.abs(psi @ x) / np.abs(psi @ x).max()) for psi in PsiT]
        last = k >= par.reweightings


# the same problem, for both -----------------------------------------------------------------------------------

def scene(seed=3, samples=(90, 120, 60), noise=(0.3, 0.3, 0.9)):
    """uv in wavelengths, whitened y, U, offsets and the sky."""
    rng = np.random.default_rng(seed)
    uv = rng.normal(size=(2, sum(samples))) * 0.13 / CELL
    uv = np.clip(uv, -0.45 / CELL, 0.45 / CELL)
    sky = np.zeros(SHAPE)
    sky[4, 9], sky[11, 5], sky[6:10, 6:10] = 4.0, 1.5, 0.5
    error = np.repeat(noise, samples) * (rng.normal(size=uv.shape[1]) + 1j * rng.normal(size=uv.shape[1]))
    precond = np.exp(-((0.3 - np.hypot(*uv) * CELL).clip(0) / 0.12) ** 2)
    offsets = np.concatenate([[0], np.cumsum(samples)])
    return SimpleNamespace(uv=uv, y=fourier_matrix(uv) @ sky.ravel() + error, U=precond / precond.max(),
                           offsets=offsets,
                           sky=sky, blocks=[slice(a, b) for a, b in zip(offsets[:-1], offsets[1:])])


def dense_norm_sq(apply, shape, dtype):
    """‖A‖² of A†A as a function of images."""
    matrix = [apply(one.reshape(shape).astype(dtype)).ravel() for one in np.eye(shape[0] * shape[1])]
    return float(np.linalg.eigvalsh(np.array(matrix))[-1])


def iteration(problem, dtype=np.float64, norm_sq=dense_norm_sq, eps=1e-13):
    """Algorithm 1 of the package, with its own transforms and wavelets."""
    measurement = MeasurementOperator(problem.uv, CELL, SHAPE, eps=eps, dtype=dtype)
    dictionary = SaraDictionary(SHAPE, SARA_BASES, LEVELS, dtype=dtype)
    vis, precond = problem.y.astype(np.result_type(dtype, np.complex64)), problem.U.astype(dtype)
    weighted = np.sqrt(problem.U)[:, None] * fourier_matrix(problem.uv)
    norm = np.linalg.norm(np.vstack([weighted.real, weighted.imag]), 2) ** 2
    prior = PaperPrior(dictionary, measurement.workers, norm_sq)
    return AdaptivePPD(measurement, prior, vis, problem.offsets, precond, norm, relaxation=RELAXATION)


def first_bounds(problem):
    """ε_j of scipy's non-negative least squares, block by block."""
    bounds = []
    for block in problem.blocks:
        phi, y = fourier_matrix(problem.uv[:, block]), problem.y[block]
        bounds.append(scipy_nnls(np.vstack([phi.real, phi.imag]), np.concatenate([y.real, y.imag]), maxiter=100_000)[1])
    return np.array(bounds)


def solved(ppd, bounds, schedule, kappa, **more):
    """Run ours and return the record and (t, k, x, ε) of every iteration."""
    ppd.rescale(kappa)
    trace = []

    def note(ppd, record):
        trace.append((ppd.iteration, record.reweighting[-1], ppd.model.ravel().copy(), bounds.l2_bounds.copy()))

    return run_paper_algorithm_2(ppd, bounds, schedule, note, **more), trace


def bounds_of(problem, start, **more):
    return PaperBounds(start, np.diff(problem.offsets), np.ones(len(start)), **more)


def compare(par, factors):
    """Assert that ours and the dense algebra agree in every iteration, from NNLS bounds × factors;
    return the record."""
    problem = scene()
    start = first_bounds(problem) * factors
    kappa = par.kappa * problem.sky.max()
    blocks = [[array[..., block] for block in problem.blocks] for array in (problem.y, problem.U, problem.uv)]
    wanted = list(paper(blocks[0], [fourier_matrix(uv) for uv in blocks[2]], blocks[1], start, kappa, par))
    record, trace = solved(iteration(problem), bounds_of(problem, start), par, kappa)
    assert record.stop_code == CONVERGED and len(trace) == len(wanted)
    largest = problem.sky.max()
    for ours, theirs in zip(trace, wanted):
        assert ours[:2] == theirs[:2]
        np.testing.assert_allclose(ours[2], theirs[2], atol=1e-7 * largest)
        np.testing.assert_allclose(ours[3], theirs[3], rtol=1e-7)
    return record


@pytest.mark.parametrize("varrho", [0.0, 0.03])
def test_every_iteration_is_the_papers(varrho):
    """Bounds move up and down, weights change, the last problem has its own tolerance: to the round-off of float64."""
    record = compare(replace(QUICK, varrho=varrho), [1.0, 1.0, 1.7])  # the last bound comes down
    moves = np.diff([bounds for _, bounds in record.bounds], axis=0)
    assert np.sum(moves > 0) >= 3 and np.sum(moves < 0) >= 3  # else this shows little
    assert 2 <= len(record.reweightings) < 4 if varrho else len(record.reweightings) == 4


def test_a_bound_that_moves_poses_a_new_problem():
    """Settled and met, but a bound has just come down: the problem goes on."""
    record = compare(replace(QUICK, gamma_1=1e-2, reltol=1e-2, omega=0.95), [3.0, 3.0, 1.7])
    ends = [update["iteration"] for update in record.reweightings]
    assert len(record.bounds) > 3 and not set(ends) & {one for one, _ in record.bounds}


def test_single_precision_stays_with_the_paper():
    """As the task runs it, float32 and norms from above, while nothing has had time to part."""
    problem, par = scene(), QUICK
    start, kappa = first_bounds(problem), QUICK.kappa * problem.sky.max()
    blocks = [[array[..., block] for block in problem.blocks] for array in (problem.y, problem.U, problem.uv)]
    wanted = paper(blocks[0], [fourier_matrix(uv) for uv in blocks[2]], blocks[1], start, kappa, par)
    ppd = iteration(problem, np.float32, power_method, 1e-6)
    _, trace = solved(ppd, bounds_of(problem, start), replace(par, niter=40), kappa)
    for ours, theirs in zip(trace, wanted):
        np.testing.assert_allclose(ours[2], theirs[2], atol=2e-5 * problem.sky.max())


def test_a_solution_goes_on_from_any_iteration():
    """Interrupted in the first problem, after a move of the bounds, and after re-weightings: the same image."""
    problem = scene()
    start, kappa = first_bounds(problem), QUICK.kappa * problem.sky.max()
    record, wanted = solved(iteration(problem), bounds_of(problem, start), QUICK, kappa)
    last = len(wanted)
    moves = [one for one, _ in record.bounds]
    # the last move after which P holds the next back
    soon = [one for one, following in zip(moves, moves[1:]) if following - one == QUICK.interval][-1]
    moments = [3, soon + 2, soon + QUICK.interval - 1,
               *(update["iteration"] + 3 for update in record.reweightings[::3])]
    for moment in moments:
        kept, ppd, bounds = [], iteration(problem), bounds_of(problem, start)

        def keep(stage, now):
            if now:
                kept.append(copy.deepcopy((ppd.state(), bounds.state(), stage.state())))

        stopped, _ = solved(ppd, bounds, QUICK, kappa, stopped=lambda: ppd.iteration == moment, keep=keep)
        assert stopped.stop_code == STOPPED_BY_USER
        again, bounds = iteration(problem), bounds_of(problem, start)
        again.set_state(kept[0][0])
        bounds.set_state(kept[0][1])
        record = run_paper_algorithm_2(again, bounds, QUICK, stage=PaperStage.of(kept[0][2]))
        assert again.iteration == last and record.resumed == [moment]
        np.testing.assert_array_equal(again.model.ravel(), wanted[-1][2])


def test_bounds_that_are_given_never_move():
    problem = scene(noise=(0.3, 0.3, 0.3))
    start = 0.3 * np.sqrt(2.0 * np.diff(problem.offsets)) * 1.5
    bounds, kappa = bounds_of(problem, start, adapts=False), QUICK.kappa * problem.sky.max()
    record, trace = solved(iteration(problem), bounds, QUICK, kappa)
    assert record.stop_code == CONVERGED and len(record.bounds) == 1
    residual = problem.y - fourier_matrix(problem.uv) @ trace[-1][2]
    norms = np.array([np.linalg.norm(residual[block]) for block in problem.blocks])
    assert np.all(norms < (1 + 1.2 * QUICK.gamma_2) * start)


def test_the_limit_of_iterations_and_divergence():
    problem = scene()
    ppd, start = iteration(problem), first_bounds(problem)
    record, _ = solved(ppd, bounds_of(problem, start), replace(QUICK, niter=5), 0.02)
    assert (record.stop_code, ppd.iteration) == (ITERATION_LIMIT, 5)
    ppd = iteration(problem)
    ppd.start_from(problem.sky)
    ppd.l2_step *= np.inf
    assert solved(ppd, bounds_of(problem, start), QUICK, 0.02)[0].stop_code == DIVERGED
    np.testing.assert_array_equal(ppd.model, problem.sky)


# values and parameters ----------------------------------------------------------------------------------------

def test_values_are_the_papers_unless_the_user_gives_others():
    usual = PaperSchedule.of(SolverOptions(method="dabbech2018"))
    assert (usual.gamma_1, usual.gamma_2, usual.gamma_3, usual.interval) == (1e-4, 1e-3, 0.618, 100)
    assert (usual.kappa, usual.reweightings + 1, usual.reltol, usual.final_reltol) == (1e-5, 70, 1e-5, 1e-6)
    given = dict(boundrelchange=1e-3, boundtol=2e-3, boundstep=0.5, boundinterval=7, nreweights=3, reweightdecay=0.7,
                 reweighttol=5e-3, reltol=1e-4, finalreltol=2e-5, niter=90)
    found = schedule_of(SolverOptions(method="dabbech2018", **given))
    assert found == PaperSchedule(gamma_1=1e-3, gamma_2=2e-3, gamma_3=0.5, interval=7, omega=0.7, reweightings=3,
                                  varrho=5e-3, reltol=1e-4, final_reltol=2e-5, niter=90)
    assert not isinstance(schedule_of(SolverOptions()), PaperSchedule)


# blocks of visibilities ---------------------------------------------------------------------------------------

@pytest.fixture(scope="module")
def blocks():
    """Two sources in two blocks of different noise, 240 samples each."""
    data = observation([(0, 0, 0, 0, 40), (0, 0, 1, 1e4, 40)], channels=1, seed=5)
    rng = np.random.default_rng(6)
    data.uvw *= 8e4
    for flux, x, y in ((3, 12, 20), (1, 26, 30)):
        data.vis += flux * np.exp(2j * np.pi * CELL * (data.uvw[0] * (20 - x) + data.uvw[1] * (y - 24)))
    data.weight[:] = 25
    noise = np.where(data.rows.scan[data.row] == data.rows.scan.min(), 0.2, 0.5)
    data.vis += noise * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    return sort_into_blocks(data, data.rows.scan[data.row])


GRID = ImageGrid((40, 48), (CELL, CELL))
OPTIONS = SolverOptions(method="dabbech2018", wavelets=("dirac", "db1", "db3"), wavelevels=2, nreweights=5, reltol=3e-6,
                        finalreltol=2e-6, boundrelchange=1e-3, boundinterval=10)


def test_first_bounds_are_nnls_of_each_block_alone(blocks):
    """Without preconditioner, against scipy: the density here would change the fit by several per cent."""
    data, offsets = blocks
    density = np.random.default_rng(1).uniform(1, 30, data.size)
    problem_of = partial(Problem.of, grid=GRID, options=OPTIONS, unit_jy=0.2, eps=1e-6)
    samples = Samples(data, offsets, density)
    found = block_norms(problem_of(samples), problem_of, OPTIONS, lambda: False)
    ix, iy = np.divmod(np.arange(40 * 48), 48)
    phi = np.exp(2j * np.pi * CELL * (np.outer(data.uvw[0], 20 - ix) + np.outer(data.uvw[1], iy - 24)))
    y, scale = data.vis * np.sqrt(data.weight), np.sqrt(data.weight)[:, None]
    expected = []
    for a, b in zip(offsets[:-1], offsets[1:]):
        rows = (scale * phi)[a:b]
        expected.append(scipy_nnls(np.vstack([rows.real, rows.imag]), np.concatenate([y[a:b].real, y[a:b].imag]))[1])
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def image(blocks, path="", stop_at=None, options=OPTIONS):
    data, offsets = blocks
    checkpoint = None
    if path:
        checkpoint = Checkpoint(str(path), "1", {})
        if os.path.exists(path):
            checkpoint.open()
    reached = [0]
    samples = Samples(data, offsets, np.ones(data.size), np.array([1.0, 2.5]))
    return reconstruct(samples, GRID, options, control=Control(
        lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))


def test_a_reconstruction_is_kept_and_goes_on(blocks, tmp_path, monkeypatch):
    wanted = image(blocks)
    assert wanted.record.stop_code == CONVERGED and len(wanted.record.reweightings) == 5
    assert wanted.model.min() >= 0 and np.unravel_index(np.argmax(wanted.model), GRID.shape) == (12, 20)
    whitened = blocks[0].vis * np.sqrt(blocks[0].weight)
    assert wanted.record.residual_norm[0] == pytest.approx(np.linalg.norm(whitened), rel=1e-5)  # x⁽⁰⁾ = 0
    middle = wanted.record.reweightings[1]["iteration"] + 3
    assert image(blocks, tmp_path / "c", middle).record.stop_code == STOPPED_BY_USER
    monkeypatch.setattr("casa_sara.reconstruction.paper_method.nnls", None)  # not needed any more
    found = image(blocks, tmp_path / "c")
    assert found.record.resumed == [middle]
    np.testing.assert_array_equal(found.model, wanted.model)
    np.testing.assert_array_equal(found.l2_bounds, wanted.l2_bounds)


@pytest.mark.parametrize("databound, l2bound, noise", [("weights", (), 1.0), ("fixed", (1.2, 2.7), (1.2, 2.7))])
def test_given_bounds_are_hard_constraints(blocks, databound, l2bound, noise):
    found = image(blocks, options=replace(OPTIONS, databound=databound, l2bound=l2bound, nreweights=1, niter=50))
    degrees = 2.0 * np.diff(blocks[1])
    np.testing.assert_allclose(found.l2_bounds, noise * np.sqrt(degrees + 2 * np.sqrt(2 * degrees)))


# the task -----------------------------------------------------------------------------------------------------

ARCSEC = np.radians(1 / 3600)
SKY = [(1.0, -12 * ARCSEC, 7 * ARCSEC), (0.4, 9 * ARCSEC, -10 * ARCSEC)]
SKY += [(0.02, x * ARCSEC, y * ARCSEC) for x in range(-4, 5, 2) for y in range(-4, 5, 2)]
GOOD = dict(imsize=64, cell="1arcsec", datacolumn="data", method="dabbech2018", nthreads=1)


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    pytest.importorskip("casatools")
    from simulated_ms import simulate

    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=14, sky=SKY, noise=0.02,
                    scans=3, integration=20.0, spacing_seconds=5400.0, hour_angle=-2.5, seed=4)


@pytest.mark.slow
def test_the_task_images_with_the_paper(vis, tmp_path, caplog):
    from casatasks import casalog
    from simulated_ms import pixels

    from casa_sara import tsara

    casalog.setlogfile(str(tmp_path / "casa.log"))
    try:
        result = tsara(vis=vis, imagename=str(tmp_path / "a"), nreweights=8, reltol=1e-4, finalreltol=1e-5, **GOOD)
    finally:
        casalog.setlogfile(os.devnull)
    truth = np.zeros((64, 64))
    for flux, l, m in SKY:
        truth[round(32 - l / ARCSEC), round(32 + m / ARCSEC)] += flux
    model = pixels(str(tmp_path / "a.model"))
    assert 20 * np.log10(np.linalg.norm(truth) / np.linalg.norm(model - truth)) > 25  # dB
    assert model.min() == 0 and model.sum() == pytest.approx(truth.sum(), rel=0.06)
    sara = result["sara"]
    assert result["stopcode"] == CONVERGED and len(sara["reweightings"]) == 8 and sara["method"] == "dabbech2018"
    np.testing.assert_allclose([update["scale"] for update in sara["reweightings"]], 0.8 ** np.arange(1, 9))
    # κ is 1e-5 of the brightest pixel of the first image, which is within a factor of that of the last
    assert 1e-6 < sara["chosen"]["threshold_jy_per_pixel"] / model.max() < 2e-5
    assert "constant" in sara["why"]["threshold_jy_per_pixel"]
    assert all(block["noise_found"] == pytest.approx(1.0, rel=0.1) for block in sara["blocks"])
    assert "method = 'dabbech2018'" in (tmp_path / "casa.log").read_text()


@pytest.mark.slow
def test_a_cube_is_imaged_channel_by_channel(vis, tmp_path):
    from casa_sara import tsara

    result = tsara(vis=vis, imagename=str(tmp_path / "a"), specmode="cube", niter=3, **GOOD)
    channels = result["sara"]["channels"]
    assert result["sara"]["method"] == "dabbech2018" and len(channels) == 3
    assert all(channel["chosen"]["regscale"] == 1.0 for channel in channels)


@pytest.mark.parametrize("name, value", [("regscale", 2.0), ("parallel", True)])
def test_what_means_nothing_is_refused_by_name(vis, tmp_path, name, value):
    from casa_sara import tsara

    with pytest.raises(ValueError, match=rf"{name} = {value} with method = 'dabbech2018': .*; should be "):
        tsara(vis=vis, imagename=str(tmp_path / "a"), **GOOD | {name: value})
    assert not os.listdir(tmp_path)


def test_another_method_is_refused(vis, tmp_path):
    from casa_sara import tsara

    with pytest.raises(ValueError, match="method = 'clean': should be .*'tsara', 'dabbech2018'"):
        tsara(vis=vis, imagename=str(tmp_path / "a"), **GOOD | {"method": "clean"})


def test_a_dry_run_counts_what_the_paper_takes(vis, tmp_path):
    from casa_sara import tsara

    said = [tsara(vis=vis, imagename=str(tmp_path / "a"), dryrun=True, **GOOD | {"method": method})["forecast"]
            for method in ("tsara", "dabbech2018")]
    duals = [one["memory_bytes"]["iterating"]["wavelet duals and weights"] for one in said]
    assert duals[1] == 1.5 * duals[0] and said[1]["iterations"] > 10 * said[0]["iterations"]
