"""The thermal noise, measured in the data from differences of successive integrations."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from casa_sara.data.distribution import by_baseline
from casa_sara.data.visibilities import RowTable, Visibilities
from casa_sara.data.weight_levels import levels
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.runtime.scratch import IN_MEMORY

__all__ = ["MEDIAN_TO_SIGMA", "noise_from_differences", "series_of_rows"]

FEWEST_DIFFERENCES = 20
MOST_SAMPLES = 2_000_000  # of a block on the disk; of more, some baselines and channels are looked at
MEDIAN_TO_SIGMA = 1.482602218505602  # of |x| for a normal x


def noise_from_differences(visibilities: Visibilities, offsets: np.ndarray, comm: Serial = SERIAL,
                           turns: Sequence[np.ndarray] = ()) -> np.ndarray:
    """Measure the noise of each block relative to the MS weights.

    Along one baseline and channel the sky changes slowly and the noise does not, so
    second differences of three successive integrations,

        d = V₁ − 2V₂ + V₃,   Var(Re d) = Var(Im d) = 1/w₁ + 4/w₂ + 1/w₃,

    hold the noise and what little of the sky curves in between. Where a block has too few
    of them, first differences V₁ − V₂ of variance 1/w₁ + 1/w₂ take their place. The noise is
    1.4826 times the median of |Re d|/σ_d and |Im d|/σ_d together, which outliers hardly move. Where the weights of a
    block fall into levels (:func:`casa_sara.data.weight_levels.levels`), as when most rows are bad and hardly weighed,
    it is measured in each: of levels of M_k samples the rms is √(Σ M_k·noise_k²/M), which a common median is not.

    Sources far from the centre change faster. With a phase factor for each place where there are some, differences are
    taken of these differences, turned to the first place, and so on: those of sources there vanish as well.

    Parameters
    ----------
    visibilities : Visibilities
        In the order of their blocks.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread: each is sent all of some baselines for this.
    turns : sequence of complex (M,)
        exp(2πi(w_o − w)) of places far from the centre; of one rank alone.

    Returns
    -------
    noise : float64 (d,)
        Standard deviation of Re V·√w and of Im V·√w: 1 where the weights are right, 2 where the
        noise is twice what they say. NaN where fewer than 20 differences can be formed.
    """
    visibilities, offsets = by_baseline(visibilities, offsets, comm)
    series = series_of_rows(visibilities.rows)
    return np.array([_block_noise(visibilities, slice(*ends), series, comm, turns)
                     for ends in zip(offsets[:-1], offsets[1:])])


def series_of_rows(rows: RowTable) -> np.ndarray:
    """Number the distinct (MeasurementSet, observation, field, spw, baseline) and return each row's.

    Parameters
    ----------
    rows : RowTable
        Metadata of the rows.

    Returns
    -------
    int (R,)
    """
    key = np.zeros(rows.time.size, dtype=np.int64)
    for column in (rows.ms, rows.observation, rows.field, rows.spw, rows.antenna1, rows.antenna2):
        key = np.unique(key * (int(column.max(initial=0)) + 1) + column, return_inverse=True)[1]
    return key


def _block_noise(visibilities, block, series, comm, turns):
    """Return the noise of one block, or NaN."""
    if visibilities.scratch.on_disk:
        visibilities, block = _some_series(visibilities, block, series), slice(None)
    row, chan = visibilities.row[block], visibilities.chan[block]
    key = series[row] * (int(chan.max(initial=0)) + 1) + chan
    time = visibilities.rows.time[row]
    order = np.lexsort((time, key))
    vis = visibilities.vis[block][order].astype(complex)
    variance = 1.0 / visibilities.weight[block][order].astype(float)
    step = np.diff(time[order])
    same = (np.diff(key[order]) == 0) & (step > 0)
    if not comm.total(np.count_nonzero(same)):
        return np.nan
    next_one = same & (step < 1.5 * comm.median(step[same]))
    level, count = levels(visibilities.weight[block], comm)
    level = level[order]
    found: list[tuple[int, float]] = []  # samples and noise
    for number in reversed(range(count)):  # where differences are too few, the noise is that of the next heavier level
        here = level == number
        successive = next_one & here[:-1] & here[1:]
        noise = _noise_of_turned(vis, variance, successive, [turn[block][order] for turn in turns]) if turns else \
            _noise_of_pairs(vis, variance, successive, comm)
        found.append((comm.total(np.count_nonzero(here)), found[-1][1] if found and np.isnan(noise) else noise))
    sizes, noises = np.array(found).T
    return noises[0] if count == 1 else float(np.sqrt(np.average(np.square(noises), weights=sizes)))


def _some_series(visibilities, block, series):
    """Return the samples of a block, in memory; of a large one those of some baselines and channels."""
    step, chosen = -(-(block.stop - block.start) // MOST_SAMPLES), []
    for piece in visibilities.scratch.pieces(block.start, block.stop):
        number = series[visibilities.row[piece]] + visibilities.chan[piece]
        chosen.append(piece.start + np.flatnonzero(number % step == 0))
    index = np.concatenate(chosen or [np.zeros(0, int)])
    light = replace(visibilities, uvw=visibilities.uvw[:0], imaging_weight=visibilities.imaging_weight[None][:0],
                    freq_hz=None, scratch=IN_MEMORY)
    return light.take(index)


def _noise_of_pairs(vis, variance, next_one, comm):
    """Return the noise of samples of which the next one is that of the next integration, bool (M − 1,), or NaN."""
    middle = next_one[:-1] & next_one[1:]
    if comm.total(np.count_nonzero(middle)) >= FEWEST_DIFFERENCES:
        difference = (vis[:-2] - 2 * vis[1:-1] + vis[2:])[middle]
        variance = (variance[:-2] + 4 * variance[1:-1] + variance[2:])[middle]
    elif comm.total(np.count_nonzero(next_one)) >= FEWEST_DIFFERENCES:
        difference = np.diff(vis)[next_one]
        variance = (variance[:-1] + variance[1:])[next_one]
    else:
        return np.nan
    whitened = difference / np.sqrt(variance)
    return float(MEDIAN_TO_SIGMA * comm.median(np.abs([whitened.real, whitened.imag])))


def _noise_of_turned(vis, variance, next_one, turns):
    """Return the noise from differences that vanish for sources at the centre and where `turns` lead; NaN of too few.

    Differences are second ones at each place, or, where there are too few of them, second ones at the centre, or first.
    """
    places = [np.ones_like(vis), *turns]
    for orders in ([2] * len(places), [2] + [1] * len(turns), [1] * len(places)):
        factors, series = np.ones((1, vis.size), complex), np.ones(vis.size, bool)
        for place, order in zip(places, orders):
            for _ in range(order):  # of the integrations from each one on, turned by their middle
                middle = len(factors) // 2
                turned = factors * place[middle : middle + factors.shape[1]].conj()
                factors = np.pad(turned[:, :-1], ((0, 1), (0, 0))) - np.pad(turned[:, 1:], ((1, 0), (0, 0)))
                series = series[:-1] & next_one[len(factors) - 2 :]
        count = factors.shape[1]
        if np.count_nonzero(series) >= FEWEST_DIFFERENCES:
            terms = [slice(k, k + count) for k in range(len(factors))]
            difference = sum(factor * vis[term] for factor, term in zip(factors, terms))[series]
            power = sum(np.abs(factor) ** 2 * variance[term] for factor, term in zip(factors, terms))[series]
            whitened = difference / np.sqrt(power)
            return float(MEDIAN_TO_SIGMA * np.median(np.abs([whitened.real, whitened.imag])))
    return np.nan
