"""The bootstrap: its errors against the closed form, what is kept of the draws, and an end in the middle of one."""

import numpy as np
import pytest
from dense_problem import Problem
from test_checkpoint import GRID, OPTIONS, assert_same, sky  # noqa: F401  # a fixture

from casa_sara.options import SolverOptions
from casa_sara.reconstruction.bootstrap import DRAW_ITERATIONS, SEED, Bootstrap, Jackknife
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.draws import Draws
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.islands import add_flux_errors, islands_of
from casa_sara.solver.l2_bounds import AdaptiveBounds
from casa_sara.solver.record import CONVERGED

NDRAWS = 400
UNIT_JY = 3.0


def drawn_from_dense_problem(ndraws, kind=Bootstrap, samples=(60, 80), noise=(0.05, 0.15)):
    """Draw a least-squares image, without positivity and prior; return the problem, 1/σ² of its samples and draws."""
    problem = Problem(seed=3, samples=samples, noise=noise)
    ppd = AdaptivePPD(problem.measurement, problem.dictionary, problem.vis, problem.offsets, problem.precond,
                      problem.data_norm_sq(problem.precond), positivity=False)
    weights = np.abs(problem.measurement.matrix[:, 0]) ** 2
    samples = np.diff(problem.offsets)
    bounds = AdaptiveBounds(np.array(problem.noise) * np.sqrt(2.0 * samples), samples,
                            np.add.reduceat(weights, problem.offsets[:-1]), n_bases=3)
    ppd.l1_weights[...] = 0  # no prior
    ppd.unit_jy = UNIT_JY
    ppd.rescale(0.005)  # near the errors, so that a draw converges in its iterations
    bounds.apply_to(ppd)
    for _ in range(500):
        ppd.step()
    draws = Draws(problem.shape, ndraws)
    kind(ppd, bounds, None, 0.0, ppd.model.copy(), ppd.threshold, draws).run(
        lambda: False, lambda draws: None, lambda now: None)
    return problem, np.repeat(np.array(problem.noise) ** -2.0, samples), draws


def test_errors_of_least_squares_are_those_of_the_closed_form():
    """Cov x̂ = (Re Φ†Σ⁻¹Φ)⁻¹: of pixels, and of sums over regions."""
    problem, noise_weights, draws = drawn_from_dense_problem(NDRAWS)
    matrix = problem.measurement.matrix
    covariance = np.linalg.inv((matrix.conj().T @ (noise_weights[:, None] * matrix)).real) * UNIT_JY**2
    scatter = 1 / np.sqrt(2 * NDRAWS)
    ratio = draws.error() / np.sqrt(np.diag(covariance)).reshape(problem.shape)
    assert abs(ratio.mean() - 1) < 3 * scatter  # 16 pixels, less than 16 numbers
    assert np.abs(ratio - 1).max() < 4 * scatter
    labels = np.zeros(problem.shape, int)
    labels[:2], labels[2:, 1:] = 1, 2
    for region, error in enumerate(draws.flux_errors(labels), 1):
        inside = (labels.ravel() == region).astype(float)
        assert abs(error / np.sqrt(inside @ covariance @ inside) - 1) < 3 * scatter


def test_every_draw_is_the_solution_of_its_data():
    """x_b − x̂ = (Re Φ†Σ⁻¹Φ)⁻¹ Re Φ†Σ⁻¹n_b, with the noise n_b that the seed gives."""
    problem, noise_weights, draws = drawn_from_dense_problem(5)
    matrix = problem.measurement.matrix
    information = (matrix.conj().T @ (noise_weights[:, None] * matrix)).real
    for number, difference in enumerate(draws.differences()):
        rng = np.random.default_rng([SEED, number])
        noise = np.concatenate([sigma * (rng.standard_normal(size) + 1j * rng.standard_normal(size))
                                for sigma, size in zip(problem.noise, problem.samples)])
        expected = UNIT_JY * np.linalg.solve(information, (matrix.conj().T @ (noise_weights * noise)).real)
        error = np.linalg.norm(difference.ravel() - expected) / np.linalg.norm(expected)
        assert error < 0.01, number


@pytest.mark.slow
def test_every_solution_of_a_jackknife_lacks_its_blocks():
    """√(g − 1)(x_k − x̂), with x_k and x̂ of least squares; six blocks in four groups."""
    problem, noise_weights, draws = drawn_from_dense_problem(4, Jackknife, (30, 40, 50, 60, 70, 80), 3 * (0.05, 0.1))
    matrix, block = problem.measurement.matrix, np.repeat(np.arange(6), problem.samples)

    def least_squares(used):
        weights = noise_weights * used
        information = (matrix.conj().T @ (weights[:, None] * matrix)).real
        return UNIT_JY * np.linalg.solve(information, (matrix.conj().T @ (weights * problem.vis)).real)

    assert len(draws) == 4
    for group, difference in enumerate(draws.differences()):
        expected = np.sqrt(3) * (least_squares(block % 4 != group) - least_squares(block >= 0))
        assert np.linalg.norm(difference.ravel() - expected) < 0.02 * np.linalg.norm(expected), group


def some_draws(number=6):
    """Draws of many magnitudes, and what they were made of."""
    rng = np.random.default_rng(2)
    images = [10.0 ** rng.uniform(-12, -3, (12, 17)) * rng.standard_normal((12, 17)) * (rng.random((12, 17)) < 0.4)
              for _ in range(number)]
    draws = Draws((12, 17), number)
    for image in images:
        draws.add(image.astype(np.float32))
    return draws, np.array(images)


def test_draws_are_kept_to_a_two_thousandth_of_themselves():
    draws, images = some_draws()
    for found, image in zip(draws.differences(), images, strict=True):
        large = np.abs(image) > 3e-9 * np.abs(image).max()
        np.testing.assert_allclose(found[large], image[large], rtol=5e-4)
        assert np.abs(found - image).max() <= 5e-4 * np.abs(image).max()
    assert sum(values.nbytes + pixels.nbytes for values, pixels in zip(draws.values, draws.pixels)) \
        == 6 * np.count_nonzero(images)
    again = Draws.of(draws.arrays())
    assert again.shape == draws.shape and again.asked == draws.asked and len(again) == len(draws)
    for found, wanted in zip(again.differences(), images, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-9 * np.abs(wanted).max())


def test_errors_are_root_mean_squares_of_what_is_linear():
    draws, images = some_draws()
    np.testing.assert_allclose(draws.error(), np.sqrt((images**2).mean(axis=0)), rtol=1e-3, atol=1e-9)
    sums = images.sum(axis=1)
    np.testing.assert_allclose(draws.error(lambda image: image.sum(axis=0)), np.sqrt((sums**2).mean(axis=0)), rtol=1e-3)
    labels = np.random.default_rng(3).integers(0, 4, (12, 17))
    expected = [np.sqrt(np.mean([image[labels == region].sum() ** 2 for image in images])) for region in (1, 2, 3)]
    np.testing.assert_allclose(draws.flux_errors(labels), expected, rtol=1e-3)


def test_no_draws_are_draws_too():
    draws = Draws((3, 4), 7)
    again = Draws.of(draws.arrays())
    assert len(again) == 0 and again.asked == 7 and not again.complete and again.pixels == []
    draws.add(np.zeros((3, 4), np.float32))
    assert not draws.error().any() and not Draws.of(draws.arrays()).error().any()


def test_islands_have_the_errors_of_their_surroundings():
    model = np.zeros((20, 20))
    model[3:5, 3:6], model[14, 15] = 1, 5
    islands = islands_of(model, np.pad([[1.0]], ((10, 9), (10, 9))))
    assert [(island["x_peak"], island["y_peak"]) for island in islands] == [(14, 15), (3, 3)]
    draws = Draws((20, 20), 2)
    for size in (3.0, 4.0):
        difference = np.zeros((20, 20), np.float32)
        difference[4, 4], difference[6, 4] = size, size  # one pixel of the first island, and one beside it
        difference[14, 15] = -size
        draws.add(difference)
    add_flux_errors(islands, model, draws.flux_errors, "bootstrap_error_jy")
    rms = np.sqrt((3.0**2 + 4.0**2) / 2)
    np.testing.assert_allclose([island["bootstrap_error_jy"] for island in islands], [rms, 2 * rms], rtol=1e-3)
    add_flux_errors([], np.zeros((20, 20)), draws.flux_errors, "x")


# within a reconstruction

WITH_DRAWS = SolverOptions(**vars(OPTIONS) | dict(ndraws=3))


def image(sky, path="", stop_in=None, options=WITH_DRAWS, noise=(1.0, np.nan)):  # noqa: F811
    """Reconstruct, and stop after so many iterations of draws."""
    data, offsets = sky
    checkpoint = None
    if path:
        checkpoint = Checkpoint(str(path), "1", {})
        if path.exists():
            checkpoint.open()
    drawing = []

    def stopped():
        if drawing:
            drawing[0] += 1
        return bool(drawing) and drawing[0] == stop_in

    samples = Samples(data, offsets, np.ones(data.size), np.array(noise))
    return reconstruct(samples, GRID, options, control=Control(
        stopped=stopped, checkpoint=checkpoint, drawn=lambda name, draws: drawing or drawing.append(0)))


@pytest.fixture(scope="module")
def whole(sky):  # noqa: F811
    return image(sky)


def test_draws_leave_the_image_as_it_is(sky, whole):  # noqa: F811
    plain = image(sky, options=SolverOptions(**vars(WITH_DRAWS) | dict(ndraws=0)))
    assert plain.draws is None and plain.finished and whole.finished and whole.record.stop_code == CONVERGED
    np.testing.assert_array_equal(whole.model, plain.model)
    np.testing.assert_array_equal(whole.residual_norms, plain.residual_norms)
    assert whole.threshold == plain.threshold
    islands = [dict(island) for island in whole.record.islands]
    errors = [island.pop("bootstrap_error_jy") for island in islands]
    assert islands == plain.record.islands and len(islands) > 0 and min(errors) > 0
    assert len(whole.draws) == 3 and whole.draws.complete


@pytest.mark.parametrize("moments", [(1, 5), (29, 2), (30, 31, 60), (DRAW_ITERATIONS,), (DRAW_ITERATIONS + 40, 1)])
def test_draws_go_on_as_if_never_stopped(sky, whole, tmp_path, moments):  # noqa: F811
    path = tmp_path / "c"
    for moment in moments:
        stopped = image(sky, path, moment)
        assert not stopped.finished and not stopped.draws.complete and stopped.record.stop_code == CONVERGED
    found = image(sky, path)
    assert_same((found.model, found.record), (whole.model, whole.record), [whole.record.iteration[-1]] * len(moments))
    for name, array in whole.draws.arrays().items():
        np.testing.assert_array_equal(found.draws.arrays()[name], array)
    np.testing.assert_array_equal(found.kept, whole.kept)


def test_a_jackknife_and_the_draws_after_it_go_on_as_if_never_stopped(sky, tmp_path):  # noqa: F811
    data, offsets = sky
    quarters = data, np.sort(np.concatenate([offsets, (offsets[:-1] + offsets[1:]) // 2]))
    options = SolverOptions(**vars(OPTIONS) | dict(ndraws=2, jackknife=True))

    def solved(path="", stop_in=None):
        return image(quarters, path, stop_in, options, noise=np.full(4, np.nan))

    wanted, path = solved(), tmp_path / "c"
    assert len(wanted.jackknife) == 4 and len(wanted.draws) == 2 and wanted.finished
    plain = image(quarters, options=SolverOptions(**vars(OPTIONS) | dict(ndraws=2)), noise=np.full(4, np.nan))
    np.testing.assert_array_equal(plain.model, wanted.model)
    for moment in (50, DRAW_ITERATIONS + 10, 2 * DRAW_ITERATIONS - 60 + 45):  # groups 0 and 1, then the first draw
        stopped = solved(path, moment)
        assert not stopped.finished and stopped.draws is not None
    assert len(stopped.jackknife) >= 3
    found = solved(path)
    for name in ("jackknife", "draws"):
        for key, array in getattr(wanted, name).arrays().items():
            np.testing.assert_array_equal(getattr(found, name).arrays()[key], array)
    assert [(island["bootstrap_error_jy"], island["jackknife_error_jy"]) for island in found.record.islands] \
        == [(island["bootstrap_error_jy"], island["jackknife_error_jy"]) for island in wanted.record.islands]
