"""Errors of antenna gains: their fit against dense least squares, and the artefacts that are no emission."""

from dataclasses import replace
from itertools import combinations
from threading import Barrier, Thread

import numpy as np
import pytest
from test_averaging import fourier
from test_visibilities import observation

from casa_sara.data.gain_errors import AntennaGains
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.serial import Serial
from casa_sara.reconstruction.calibration import Calibration
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import reconstruct
from casa_sara.solver.islands import faint_islands, islands_of

ANTENNAS, INTEGRATIONS = 16, 6
PAIRS = np.array(list(combinations(range(ANTENNAS), 2)))
GRID = ImageGrid((64, 64), (1e-6, 1e-6))


def snapshots(scans=2, integrations=INTEGRATIONS, longest=1.6e5, seed=0):
    """Samples of all pairs of antennas, two channels, in scans that are blocks."""
    data = observation([(0, 0, k, 3600.0 * k, integrations) for k in range(scans)], len(PAIRS), channels=2, seed=seed)
    number = data.rows.antenna2 - 1
    data.rows.antenna1, data.rows.antenna2 = PAIRS[number].T
    places = np.random.default_rng(seed).uniform(-0.5, 0.5, (ANTENNAS, 2)) * longest
    baseline = (places[data.rows.antenna2] - places[data.rows.antenna1])[data.row]
    angle = 2 * np.pi * data.rows.time[data.row] / 86164
    cos, sin = np.cos(angle), np.sin(angle)
    data.uvw[:] = 0
    data.uvw[:2] = baseline[:, 0] * cos - baseline[:, 1] * sin, baseline[:, 0] * sin + baseline[:, 1] * cos
    return sort_into_blocks(data, data.rows.scan[data.row])


def corrupted(data, predicted, rms, seed=1, every_integration=False):
    """What antennas with gain errors observe, and g_p + g_q* of each sample."""
    rng, rows = np.random.default_rng(seed), data.rows
    interval = np.unique(rows.time if every_integration else rows.scan, return_inverse=True)[1]
    gains = rms * (rng.standard_normal((interval.max() + 1, ANTENNAS, 2)) @ [1, 1j])
    gains -= gains.mean(axis=1, keepdims=True)
    factors = (gains[interval, rows.antenna1] + gains[interval, rows.antenna2].conj())[data.row]
    first, second = gains[interval, rows.antenna1][data.row], gains[interval, rows.antenna2][data.row]
    return predicted * (1 + first) * (1 + second.conj()), factors


def whitened(data, rng):
    """A model's visibilities, over their noise, and noise."""
    def normal():
        return rng.standard_normal((data.size, 2)) @ [1, 1j]

    return 30 + 5 * normal(), normal()


def dense_gains(data, predicted, residual, interval, amplitude, phase):
    """g_p + g_q* of each row by dense least squares in real and imaginary parts of gains of mean 0, with the prior."""
    rows, unknowns = data.rows, (interval.max() + 1) * ANTENNAS
    matrix = np.zeros((data.size, 2 * unknowns), complex)
    samples = np.arange(data.size)
    for antenna, sign in ((rows.antenna1, 1), (rows.antenna2, -1)):
        column = (interval * ANTENNAS + antenna)[data.row]
        matrix[samples, column] += predicted
        matrix[samples, unknowns + column] += sign * 1j * predicted
    of_mean_0 = np.linalg.svd(np.ones((1, ANTENNAS)))[2][1:].T
    free = np.kron(np.eye(2 * (interval.max() + 1)), of_mean_0)
    stacked = np.concatenate([matrix.real, matrix.imag]) @ free
    prior = np.repeat([1 / amplitude**2, 1 / phase**2], free.shape[1] // 2)
    gains = free @ np.linalg.solve(stacked.T @ stacked + np.diag(prior),
                                   stacked.T @ np.concatenate([residual.real, residual.imag]))
    gains = (gains[:unknowns] + 1j * gains[unknowns:]).reshape(-1, ANTENNAS)
    return gains[interval, rows.antenna1] + gains[interval, rows.antenna2].conj()


@pytest.mark.parametrize("every_integration", [False, True])
def test_gains_are_those_of_dense_least_squares(every_integration):
    (data, _), rng = snapshots(), np.random.default_rng(2)
    predicted, noise = whitened(data, rng)
    observed, factors = corrupted(data, predicted, 0.03, every_integration=every_integration)
    residual = observed + noise - predicted
    errors = AntennaGains(data).fit(predicted, residual)
    assert errors.interval == ("integration" if every_integration else "scan")
    interval = np.unique(data.rows.time if every_integration else data.rows.scan, return_inverse=True)[1]
    expected = dense_gains(data, predicted, residual, interval, errors.amplitude, errors.phase)
    np.testing.assert_allclose(errors.factors, expected, rtol=0, atol=1e-6)
    assert errors.significance > 20 and errors.ratio > 5
    assert 0.02 < errors.amplitude < 0.04 and 0.02 < errors.phase < 0.04
    # and what they explain is what was wrong, but for the noise
    assert np.abs(errors.factors[data.row] - factors).std() < 0.3 * np.abs(factors).std()


def test_amplitude_and_phase_are_told_apart():
    (data, _), rng = snapshots(), np.random.default_rng(3)
    predicted, noise = whitened(data, rng)
    gains = 0.04 * rng.standard_normal((2, ANTENNAS))
    rows = data.rows
    phases = (gains[rows.scan, rows.antenna1] - gains[rows.scan, rows.antenna2])[data.row]
    errors = AntennaGains(data).fit(predicted, predicted * (np.exp(1j * phases) - 1) + noise)
    assert 0.03 < errors.phase < 0.05 and errors.amplitude < 0.005


@pytest.mark.parametrize("seed", range(5))
def test_noise_is_no_gain_error(seed):
    data, _ = snapshots(seed=seed)
    predicted, noise = whitened(data, np.random.default_rng(100 + seed))
    errors = AntennaGains(data).fit(predicted, noise)
    assert abs(errors.significance) < 4 and errors.ratio < 1.6 and errors.amplitude + errors.phase < 0.01


def test_emission_that_is_missing_is_no_gain_error():
    """Two sources off centre that the model lacks are not what gains of the antennas make of one in the centre."""
    data, _ = snapshots(scans=6)
    _, noise = whitened(data, np.random.default_rng(4))
    image = np.zeros(GRID.shape)
    image[50, 17] = image[12, 44] = 3.0
    predicted = np.full(data.size, 30, complex)
    missing, gains = (AntennaGains(data).fit(predicted, residual + noise) for residual in (
        fourier(data.uvw, image, GRID), corrupted(data, predicted, 0.05)[0] - predicted))
    assert missing.ratio < 3 < gains.ratio


class _Threads(Serial):
    """A rank of several that are threads, as far as the fit talks to the others."""

    size = 2

    def __init__(self, rank, held, barrier):
        self.rank, self._held, self._barrier = rank, held, barrier

    def allgather(self, value):
        self._held[self.rank] = value
        self._barrier.wait()
        values = list(self._held)
        self._barrier.wait()
        return values

    def allreduce(self, array):
        arrays = self.allgather(array.copy())
        assert len({(one.dtype, one.shape) for one in arrays}) == 1  # or MPI writes past an end
        array[...] = sum(arrays)
        return array


@pytest.mark.parametrize("parts", [3, 1])
def test_two_ranks_fit_what_one_fits(parts):
    """Where there is one part, the other rank has no samples."""
    (data, _), rng = snapshots(), np.random.default_rng(5)
    predicted, noise = whitened(data, rng)
    residual = corrupted(data, predicted, 0.03)[0] - predicted + noise
    whole = AntennaGains(data).fit(predicted, residual)
    held, barrier, found = [None, None], Barrier(2), {}
    mine = [np.flatnonzero(data.row % parts == 0), np.flatnonzero(data.row % parts)]

    def fit(rank):
        part = data.part(mine[rank])
        errors = AntennaGains(part, _Threads(rank, held, barrier)).fit(predicted[mine[rank]], residual[mine[rank]])
        found[rank] = errors, errors.factors[part.row]

    threads = [Thread(target=fit, args=(rank,)) for rank in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == [0, 1]
    for rank, (errors, factors) in found.items():
        assert errors.significance == pytest.approx(whole.significance)
        np.testing.assert_allclose(factors, whole.factors[data.row[mine[rank]]], atol=1e-12)


def test_artefacts_are_the_image_of_the_gains_by_explicit_sums():
    data, offsets = snapshots()
    data.weight[:] = 4.0
    model = np.zeros(GRID.shape, np.float32)
    model[30, 33], model[12, 40] = 30.0, 0.2
    rng = np.random.default_rng(6)
    predicted = fourier(data.uvw, model, GRID)
    observed, _ = corrupted(data, predicted, 0.03)
    data.vis = (observed + 0.5 * (rng.standard_normal((data.size, 2)) @ [1, 1j])).astype(np.complex64)
    operator = MeasurementOperator(data.uvw[:2], GRID.cell_rad, GRID.shape, row_scale=np.sqrt(data.weight), eps=1e-6)
    calibration = Calibration(data, data.vis * np.sqrt(data.weight), offsets, operator)
    weights, asked = np.array([1.0, 0.5]), []

    def in_doubt(snr):
        asked.append(snr)
        return np.where(model == model[12, 40], model, np.float32(0))

    found = calibration.artefacts(model, weights, in_doubt)
    bright = fourier(data.uvw, np.where(model == model[12, 40], 0, model), GRID)
    sigma = np.repeat(0.5 / np.sqrt(weights), np.diff(offsets))
    errors = AntennaGains(data).fit(bright / sigma, (data.vis - bright) / sigma)
    made = errors.factors[data.row] * bright / sigma**2
    l = -(np.arange(64) - 32) * GRID.cell_rad[0]
    m = (np.arange(64) - 32) * GRID.cell_rad[1]
    expected = np.einsum("xi,i,yi->xy", np.exp(-2j * np.pi * np.outer(l, data.uvw[0])), made,
                         np.exp(-2j * np.pi * np.outer(m, data.uvw[1])), optimize=True).real
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())
    whole = AntennaGains(data).fit(predicted / sigma, (data.vis - predicted) / sigma)
    assert asked == [pytest.approx(whole.moved * np.linalg.norm(predicted / sigma), rel=1e-3)]
    assert calibration.summary["interval"] == "scan" and calibration.summary["ratio"] > 3
    # without them there is no image
    clean = replace(data, vis=(predicted + 0.5 * (rng.standard_normal((data.size, 2)) @ [1, 1j])).astype(np.complex64))
    calibration = Calibration(clean, clean.vis * np.sqrt(data.weight), offsets, operator)
    assert calibration.artefacts(model, weights, in_doubt) is None and calibration.summary == {}


def test_faint_islands_are_those_of_little_signal_to_noise():
    rng = np.random.default_rng(7)
    data, _ = snapshots()
    psf = np.zeros(GRID.shape)
    psf[32, 32] = 1
    operator = MeasurementOperator(data.uvw[:2], GRID.cell_rad, GRID.shape)
    psf = operator.adjoint(operator.forward(psf.astype(np.float32)))
    model = np.zeros(GRID.shape)
    for x, y, n, flux in ((10, 10, 3, 0.3), (30, 40, 4, 0.02), (50, 20, 1, 0.5), (50, 50, 2, 0.01)):
        model[x:x + n, y:y + n] = flux * rng.uniform(0.5, 1, (n, n))
    islands = islands_of(model, psf)
    for limit in [0.0, *(island["snr"] * 1.001 for island in islands)]:
        faint = faint_islands(model, psf, limit)
        assert {(i["x_peak"], i["y_peak"]) for i in islands if i["snr"] < limit} == {
            place for place in ((i["x_peak"], i["y_peak"]) for i in islands) if faint[place]}
        assert not faint[model == 0].any()


@pytest.mark.parametrize("rms", [0.06, 0.1])
def test_what_gain_errors_make_is_no_emission(rms):
    """A disc in a snapshot with gain errors: without their fit the model holds islands around it."""
    data, offsets = snapshots(scans=1, integrations=10, seed=4 if rms < 0.1 else 3)
    x, y = np.indices(GRID.shape) - 32
    disc = np.where(np.hypot(x - 2, y + 1) < 6.3, 1.0, 0.0)
    disc /= disc.sum()
    observed, _ = corrupted(data, fourier(data.uvw, disc, GRID), rms, seed=8)
    noise = 0.05 * (np.random.default_rng(9).standard_normal((data.size, 2)) @ [1, 1j])
    data = replace(data, vis=(observed + noise).astype(np.complex64), weight=np.full(data.size, 400, np.float32))
    samples, outside = Samples(data, offsets, np.ones(data.size, np.float32)), np.hypot(x - 2, y + 1) > 10
    found = reconstruct(samples, GRID, SolverOptions(nthreads=1, gainfit=True))
    assert found.record.gain_errors["interval"] == "scan"
    assert found.record.gain_errors["amplitude"] == pytest.approx(rms, rel=0.3)
    assert found.record.gain_errors["phase"] == pytest.approx(rms, rel=0.3)
    before = reconstruct(samples, GRID, SolverOptions(nthreads=1))
    assert before.model[outside].sum() > 0.1 and found.model[outside].sum() < 0.01


@pytest.mark.parametrize(("wrong", "words"), [
    (dict(significance=0), "gainfit = True with significance = 0.* above 0"),
    (dict(method="dabbech2018"), "gainfit = True with method = 'dabbech2018'.*should be False")])
def test_fit_of_gains_is_refused_where_nothing_confines_the_model(wrong, words, tmp_path):
    pytest.importorskip("casatools")
    from casa_sara import tsara

    with pytest.raises(ValueError, match=words):
        tsara(vis=str(tmp_path), imagename="none", imsize=32, cell="1arcsec", gainfit=True, **wrong)


def test_memory_of_the_fit_is_forecast():
    pytest.importorskip("casatools")
    from casa_sara.casa.ms.data_volume import DataVolume
    from casa_sara.imaging.memory_forecast import GAINS, PASSING, Workload

    volume, phases = DataVolume(1_000_000, (1e5, 1e5)), []
    for gainfit in (False, True):
        work = Workload.of(volume, GRID, SolverOptions(averaging=False, gainfit=gainfit))
        phases.append(work.memory()["iterating"]["re-weighting"])
    assert phases == [PASSING * 1_000_000, GAINS * 1_000_000]
