"""Averages at the centre of mass, against explicit sums, and their solution against that of all visibilities."""

from dataclasses import replace

import numpy as np
import pytest
from test_visibilities import observation

from casa_sara.data.averaging import PHASE, Averaged, Cells, cell_sides
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.operators.beams import Beam, Mosaic
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, SolverOptions, Spectrum
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.flat_noise import FlatNoise
from casa_sara.reconstruction.problem import Problem, Samples, averaging_cell
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.record import STOPPED_BY_USER

GRID = ImageGrid((48, 40), (1e-6, 1e-6))
INDEX = np.linspace(-2, 1, 48 * 40).reshape(48, 40)
WIDE = ImageGrid((48, 40), (1e-3, 1e-3), gridder="wproject", spectrum=Spectrum(INDEX, 1e9))
OPTIONS = SolverOptions(wavelets=("dirac", "db1", "db3"), wavelevels=2, significance=0, reltol=1e-6, finalreltol=1e-8)
SOURCES = {(24, 20): 1.0, (3, 3): 0.7, (44, 4): 0.5, (4, 36): 0.6, (43, 35): 0.8}  # pixel: Jy; centre and corners


def tracks(integrations=150, longest=2e5, seed=0):
    """Samples of 40 baselines, two channels and two scans, each a block, with the uvw of an Earth that turns."""
    data = observation([(0, 0, k, 3600.0 * k, integrations) for k in range(2)], 40, channels=2, seed=seed)
    rng = np.random.default_rng(seed)
    baseline = (data.rows.antenna2 - 1)[data.row]
    length, angle = longest * np.sqrt(rng.uniform(0.01, 1, 40)), rng.uniform(0, 2 * np.pi, 40)
    turned = angle[baseline] + 2 * np.pi * data.rows.time[data.row] / 86164
    data.freq_hz = (1e9 * (1 + 0.2 * data.chan)).astype(np.float32)
    data.uvw[:] = np.array([np.cos(turned), 0.7 * np.sin(turned), 0.3 * np.cos(turned)])
    data.uvw *= length[baseline] * data.freq_hz / 1e9
    return sort_into_blocks(data, data.rows.scan[data.row])


def fourier(uvw, image, grid):
    """The explicit Fourier sum of an image over its pixels that are not 0."""
    total = 0
    for x, y in np.argwhere(image):
        l, m = -(x - grid.shape[0] // 2) * grid.cell_rad[0], (y - grid.shape[1] // 2) * grid.cell_rad[1]
        total = total + image[x, y] * np.exp(2j * np.pi * (uvw[0] * l + uvw[1] * m))
    return total


class Explicit:
    """Φ by the explicit Fourier sum, whitened."""

    def __init__(self, uvw, weight):
        self._uvw, self._scale = uvw, np.sqrt(weight)

    def forward(self, image):
        return self._scale * fourier(self._uvw, image, GRID)


def averaged(data, offsets, grid=GRID, finer=None):
    operator = Explicit(data.uvw, data.weight.astype(float))
    finer = np.zeros(len(offsets) - 1, int) if finer is None else finer
    return Averaged.of(data, offsets, averaging_cell(grid), finer, data.vis.astype(complex) * operator._scale, operator)


def sky_of(sources, shape=GRID.shape):
    image = np.zeros(shape)
    for place, flux in sources.items():
        image[place] = flux
    return image


def observed(noise_db, seed=0):
    """Samples of the sources with noise, and the noise of the flux of a point."""
    data, offsets = tracks(seed=seed)
    data.freq_hz = None
    sigma = sum(SOURCES.values()) * 10 ** (-noise_db / 20)
    rng = np.random.default_rng(seed + 1)
    noise = sigma * (rng.standard_normal(data.size) + 1j * rng.standard_normal(data.size))
    data.vis[:] = fourier(data.uvw, sky_of(SOURCES), GRID) + noise
    data.weight[:] = sigma**-2
    cells = np.rint(data.uvw[0] * 48e-6) + 1000 * np.rint(data.uvw[1] * 48e-6)
    _, inverse, counts = np.unique(cells, return_inverse=True, return_counts=True)
    return Samples(data, offsets, counts[inverse] * sigma**-2), sigma / np.sqrt(data.size)


# cells

@pytest.mark.parametrize("seed", [0, 1])
def test_cells_are_those_of_blocks_and_of_a_lattice(seed):
    """Against a dictionary of what is in each cell, in the order of their blocks."""
    rng = np.random.default_rng(seed)
    places, sides, values = [rng.uniform(0, 7, 500), rng.normal(0, 3, 500)], [1.1, 0.8], rng.normal(size=500)
    offsets, finer = np.array([0, 180, 180, 500]), np.array([0, 1, 2])
    cells = Cells(places, sides, offsets, finer)
    expected = {}
    for block, (start, stop) in enumerate(zip(offsets[:-1], offsets[1:])):
        for m in range(start, stop):
            place = tuple(int(np.floor(axis[m] / side * 2**finer[block])) for axis, side in zip(places, sides))
            expected.setdefault((block, *place), []).append(m)
    blocks = np.array(sorted(key[0] for key in expected))
    assert cells.size == len(expected) < 500
    np.testing.assert_array_equal(cells.offsets, np.searchsorted(blocks, np.arange(4)))
    sums = [values[expected[key]].sum() for key in sorted(expected)]
    np.testing.assert_allclose(cells.sums(values), sums, rtol=1e-12, atol=1e-12)


def test_a_full_cell_turns_a_source_in_the_corner_by_the_phase_that_is_said():
    sides = cell_sides(GRID.shape, GRID.cell_rad)
    rng = np.random.default_rng(0)
    v, u = (rng.uniform(-side / 2, side / 2, 100_000) for side in sides[:2])
    phase = 2 * np.pi * (u * 24e-6 + v * 20e-6)
    assert np.std(phase) == pytest.approx(PHASE, rel=0.01) and np.all(np.isinf(sides[2:]))


def test_too_many_cells_to_be_numbered_are_refused():
    with pytest.raises(OverflowError, match="2 blocks"):
        Cells([np.array([0.0, 1e12]), np.array([0.0, 1e12])], [1e-1, 1e-1], np.array([0, 1, 2]), np.zeros(2, int))


# averages

def test_averages_are_weighted_means_at_weighted_means():
    """Of one block in one cell, some samples of which lie at v < 0."""
    data, offsets = tracks(integrations=20)
    data.freq_hz = None
    found, uvw, _ = averaged(data, offsets)
    sign = np.where(data.uvw[1] < 0, -1, 1)
    sides = averaging_cell(GRID)
    places = [np.floor(sign * data.uvw[axis] / sides[1 - axis]) for axis in (1, 0)]
    _, inverse = np.unique(np.column_stack([data.rows.scan[data.row], *places]), axis=0, return_inverse=True)
    inverse = inverse.reshape(-1)
    weight, vis = data.weight.astype(float), np.where(sign < 0, data.vis.conj(), data.vis)
    total = np.bincount(inverse, weight)
    assert 50 < total.size < 0.5 * data.size and np.any(sign < 0)
    for axis in (0, 1):
        np.testing.assert_allclose(uvw[axis], np.bincount(inverse, weight * sign * data.uvw[axis]) / total, rtol=1e-9)
    mean = (np.bincount(inverse, weight * vis.real) + 1j * np.bincount(inverse, weight * vis.imag)) / total
    np.testing.assert_allclose(found.whitened_mean(found.vis), np.sqrt(total) * mean, rtol=1e-6)
    np.testing.assert_allclose(found.sum_of_weights, total)


def test_what_averages_are_wrong_by_is_of_second_order():
    """The average of a source in the corner against the source at the mean (u, v), by explicit sums."""
    data, offsets = tracks()
    data.freq_hz = None
    sky, wrong = sky_of({(2, 3): 1.0}), []
    for halvings in range(3):
        found, uvw, _ = averaged(data, offsets, finer=np.full(2, halvings))
        predicted = Explicit(uvw, found.sum_of_weights).forward(sky)
        exact = found.whitened_mean(found.operator.forward(sky))
        wrong.append(np.linalg.norm(predicted - exact) / np.linalg.norm(exact))
        if not halvings:  # half of the variance of the phase
            turned = 2 * np.pi * np.where(data.uvw[1] < 0, -1, 1) * (data.uvw[0] * 22e-6 - data.uvw[1] * 17e-6)
            mean = found.weighted_mean(turned)
            variance = np.maximum(found.weighted_mean(turned**2) - mean**2, 0)
            expected = np.linalg.norm(np.sqrt(found.sum_of_weights) * 0.5 * variance) / np.linalg.norm(exact)
            assert wrong[0] == pytest.approx(expected, rel=0.02) and wrong[0] < 0.5 * PHASE**2
    assert wrong[1] < 0.3 * wrong[0] and wrong[2] < 0.3 * wrong[1]


def test_chi_square_is_that_of_all_samples():
    """‖y − Φx‖² exactly of the model for which averages are made, nearly of others; the sources are bright."""
    data, offsets = tracks()
    data.freq_hz = None
    rng = np.random.default_rng(1)
    sky = sky_of(SOURCES)
    data.vis[:] = fourier(data.uvw, sky, GRID) + 0.05 * (rng.normal(size=data.size) + 1j * rng.normal(size=data.size))
    found, uvw, _ = averaged(data, offsets)
    operator = Explicit(uvw, found.sum_of_weights)

    cells = found.cells.offsets

    def of_samples(vis):
        return np.array([np.sum(np.abs(vis[a:b]) ** 2) for a, b in zip(offsets[:-1], offsets[1:])])

    def of_averages(vis):
        return np.array([np.sum(np.abs(vis[a:b]) ** 2) for a, b in zip(cells[:-1], cells[1:])])

    near = 0.97 * sky
    vis = operator.forward(near)
    scatter, _ = found.renew(near, vis)
    for model, tolerance in ((near, 1e-9), (sky, 2e-3), (0.9 * sky, 5e-3)):
        left = of_averages(vis - operator.forward(model)) + scatter
        np.testing.assert_allclose(left, of_samples(found.residual(model)), rtol=tolerance)
    # averages of the data themselves leave what the sources change within the cells to the scatter
    raw, predicted = found.whitened_mean(found.vis), operator.forward(near)
    plain = of_samples(found.vis) - of_averages(raw)
    assert np.all(of_averages(raw - predicted) + plain > 1.5 * of_samples(found.residual(near)))
    wrong = of_averages(found.whitened_mean(found.operator.forward(near)) - predicted) / np.diff(cells)
    np.testing.assert_allclose(found.error(found.residual(near), raw - predicted), np.sqrt(wrong / 2))


@pytest.mark.parametrize("grid", [GRID, WIDE], ids=["plane", "w-term and spectrum"])
def test_the_operator_of_averages_is_that_of_all(grid):
    """Φx and Φ†UΦx, with U of all samples; the w-term and an image of spectral indices are in the cells as well."""
    data, offsets = tracks(longest=2e5 if grid is GRID else 200.0)
    if grid is GRID:
        data.freq_hz = None
    samples = Samples(data, offsets, np.random.default_rng(2).uniform(1, 3, data.size))
    options = replace(OPTIONS, precondition=True)
    every, few = (Problem.of(samples, grid, replace(options, averaging=on), 1.0, 1e-6) for on in (False, True))
    assert every.averaged is None and few.vis.size < 0.5 * every.vis.size
    image = np.random.default_rng(3).uniform(0, 1, grid.shape).astype(np.float32)
    predicted, exact = few.measurement.forward(image), few.averaged.whitened_mean(every.measurement.forward(image))
    assert np.linalg.norm(predicted - exact) < 5e-3 * np.linalg.norm(exact)
    one, other = (each.measurement.adjoint(each.precond * each.measurement.forward(image)) for each in (every, few))
    assert np.linalg.norm(one - other) < 1e-2 * np.linalg.norm(one)
    assert few.data_norm_sq == pytest.approx(every.data_norm_sq, rel=0.02)


def test_cells_respect_w_and_frequency():
    """Samples at one (u, v) with other w or frequencies are averaged only where the image does not depend on them."""
    data, offsets = tracks(integrations=6)
    data.uvw[:2] = 10.0
    data.uvw[2] = np.linspace(0, 3e4, data.size)
    flat = replace(WIDE, gridder="standard", spectrum=None)
    grids = flat, replace(flat, spectrum=WIDE.spectrum), WIDE
    sizes = [averaged(data, offsets, grid)[0].cells.size for grid in grids]
    assert sizes[0] == 2 and sizes[0] < sizes[1] < sizes[2]


# solutions

@pytest.mark.slow
@pytest.mark.parametrize("noise_db", [20, 40, 60])
def test_the_solution_is_that_of_all_samples_within_a_tenth_of_the_noise(noise_db):
    """Points in the centre and in the corners, each in its own pixel; rms of four observations."""
    support, different, errors = sky_of(SOURCES) > 0, [], []
    for seed in range(4):
        samples, noise = observed(noise_db, seed)
        every = reconstruct(samples, GRID, replace(OPTIONS, averaging=False), support=support)
        few = reconstruct(samples, GRID, OPTIONS, support=support)
        assert few.averaging["averages"] < 0.2 * samples.data.size and every.averaging == {}
        different.append([(few.model - every.model)[place] / noise for place in SOURCES])
        errors.append([(every.model[place] - flux) / noise for place, flux in SOURCES.items()])
        np.testing.assert_allclose(few.residual_norms, every.residual_norms, rtol=1e-4)
        np.testing.assert_allclose(few.l2_bounds, every.l2_bounds, rtol=0.02)
    different, errors = (np.sqrt(np.mean(np.square(values), axis=0)) for values in (different, errors))
    assert different.max() < 0.1 and different[0] < 0.03
    assert np.all((errors > 0.3) & (errors < 3))  # which are those of the noise


def test_cells_are_halved_where_the_first_image_is_too_bright_for_them():
    samples = replace(observed(60)[0], noise=np.ones(2))
    told = []
    found = reconstruct(samples, GRID, replace(OPTIONS, niter=3), control=Control(tell=told.append))
    assert found.averaging["halvings"] == [1, 1] and found.averaging["largest_error"] < 1
    assert f"24000 visibilities are averaged to {found.averaging['averages']} for the solver," in told[0]
    assert "2 times smaller" in told[0]


def test_cells_are_not_halved_for_ever_nor_numbered_beyond_integers(monkeypatch):
    """Noise that is far too low asks for cells so small that no two samples share one; smaller ones have no numbers."""
    samples = replace(observed(40)[0], noise=np.full(2, 1e-9))
    found = reconstruct(samples, GRID, replace(OPTIONS, niter=2))
    assert found.averaging == {} and np.isfinite(found.model).all()
    monkeypatch.setattr("casa_sara.data.averaging.PHASE", 1e-9)
    assert reconstruct(samples, GRID, replace(OPTIONS, niter=2)).averaging == {}


def test_nothing_is_averaged_where_it_is_not_worthwhile_or_not_possible():
    samples, _ = observed(40)
    told = []
    for options in (replace(OPTIONS, databound="weights"), replace(OPTIONS, method="dabbech2018")):
        assert reconstruct(samples, GRID, replace(options, niter=2), control=Control(tell=told.append)).averaging == {}
    few = samples.without(np.flatnonzero(np.arange(24000) % 100))
    assert reconstruct(few, GRID, replace(OPTIONS, niter=2), control=Control(tell=told.append)).averaging == {}
    assert "databound = 'weights'" in told[0] and "method = 'dabbech2018'" in told[1] and "more than half" in told[2]


def mosaic_of(noise_db, seed=0):
    """Samples of the sources by two pointings, whose parts of the image overlap, with the grid."""
    samples, noise = observed(noise_db, seed)
    falls = np.linspace(1, 0, 257, dtype=np.float32)
    beams = tuple(Beam((x, 20.0), 2.2e-5, falls) for x in (10.0, 38.0))
    grid = replace(GRID, gridder="mosaic", mosaic=Mosaic(GRID.shape, GRID.cell_rad, beams))
    data, sky = samples.data, sky_of(SOURCES)
    data.beam = (data.row // 2 % 2).astype(np.int32)
    seen = sky_operator(data.uvw, grid, beam=data.beam).forward(sky.astype(np.float32))
    data.vis += seen - fourier(data.uvw, sky, GRID)
    return samples, grid, noise


def test_averages_of_a_mosaic_are_of_one_pointing_and_around_its_middle():
    """Φx and Φ†UΦx, and the weights of each pointing; sources far from the centre of the image, with w."""
    samples, grid, _ = mosaic_of(40)
    data = samples.data
    options = replace(OPTIONS, precondition=True)
    every, few = (Problem.of(samples, grid, replace(options, averaging=on), 1.0, 1e-6) for on in (False, True))
    assert every.averaged is None and few.vis.size < 0.5 * every.vis.size and np.abs(data.uvw[2]).max() > 1e4
    weights = np.bincount(few.averaged.part_of_cell, few.averaged.sum_of_weights)
    np.testing.assert_allclose(weights, np.bincount(data.beam, data.weight.astype(float)), rtol=1e-9)
    image = sky_of(SOURCES).astype(np.float32)
    predicted, exact = few.measurement.forward(image), few.averaged.whitened_mean(every.measurement.forward(image))
    assert np.linalg.norm(predicted - exact) < 5e-3 * np.linalg.norm(exact)
    one, other = (each.measurement.adjoint(each.precond * each.measurement.forward(image)) for each in (every, few))
    assert np.linalg.norm(one - other) < 2e-2 * np.linalg.norm(one)


@pytest.mark.slow
@pytest.mark.parametrize("noise_db", [20, 50])
def test_the_solution_of_a_mosaic_is_that_of_all_samples_within_a_tenth_of_the_noise(noise_db):
    """In the centre and in the corners; rms of four observations."""
    support, different = sky_of(SOURCES) > 0, []
    for seed in range(4):
        samples, grid, noise = mosaic_of(noise_db, seed)
        sensitivity = FlatNoise.of(samples.data, grid).sensitivity
        every = reconstruct(samples, grid, replace(OPTIONS, averaging=False), support=support)
        told = []
        few = reconstruct(samples, grid, OPTIONS, support=support, control=Control(tell=told.append))
        assert few.averaging["averages"] < 0.3 * samples.data.size and "pointing and kind of baseline" in told[0]
        different.append([(few.model - every.model)[place] * sensitivity[place] / noise for place in SOURCES])
        np.testing.assert_allclose(few.residual_norms, every.residual_norms, rtol=1e-4)
        np.testing.assert_allclose(few.residual_norms, norms_of_all(samples, few.model, grid), rtol=1e-4)
        np.testing.assert_allclose(few.model, sky_of(SOURCES), atol=6 * noise / sensitivity[support].min())
    assert np.sqrt(np.mean(np.square(different), axis=0)).max() < 0.1


def norms_of_all(samples, model, grid=GRID):
    """‖y_j − Φ_j x‖ of all samples, by an operator of their own."""
    data = samples.data
    left = (data.vis - sky_operator(data.uvw, grid, beam=data.beam).forward(model)) * np.sqrt(data.weight)
    return [np.linalg.norm(left[a:b]) for a, b in zip(samples.offsets[:-1], samples.offsets[1:])]


def test_averages_are_renewed_at_the_beginning_and_at_every_reweighting(monkeypatch):
    """The residual norms are those of all samples, but for what the model has changed since."""
    samples, _ = observed(60)
    times, renew = [], AdaptivePPD.renew_averages

    def counted(ppd, model):
        times.append(ppd.iteration)
        renew(ppd, model)

    monkeypatch.setattr(AdaptivePPD, "renew_averages", counted)
    support = sky_of(SOURCES) > 0
    begun = reconstruct(samples, GRID, replace(OPTIONS, niter=1), support=support)
    assert times == [0]
    np.testing.assert_allclose(begun.residual_norms, begun.nnls_norms, rtol=1e-4)  # of the model before the step
    found = reconstruct(samples, GRID, OPTIONS, support=support)
    assert {0, *(update["iteration"] for update in found.record.reweightings)} <= set(times[1:]) and len(times) > 5
    np.testing.assert_allclose(found.residual_norms, norms_of_all(samples, found.model), rtol=1e-4)


def test_a_solution_goes_on_with_its_averages(tmp_path):
    """Stopped before and after a re-weighting, with cells that were halved, it ends at the same image, bit by bit."""
    samples = replace(observed(60)[0], noise=np.ones(2))
    options, path, reached = replace(OPTIONS, niter=150), str(tmp_path / "c"), [0]

    def run(stop_at=None):
        checkpoint = Checkpoint(path, "1", {})
        if stop_at != 50:
            checkpoint.open()
        return reconstruct(samples, GRID, options, control=Control(
            lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))

    wanted = reconstruct(samples, GRID, options)
    assert wanted.averaging["halvings"] == [1, 1] and wanted.record.reweightings[0]["iteration"] == 60
    stopped = [run(stop_at) for stop_at in (50, 70)]
    assert [one.record.stop_code for one in stopped] == 2 * [STOPPED_BY_USER]
    found = run()
    np.testing.assert_array_equal(found.model, wanted.model)
    np.testing.assert_array_equal(found.residual_norms, wanted.residual_norms)
    assert found.averaging == wanted.averaging and found.record.resumed == [50, 70]
