"""Outliers ("wild" samples): visibilities that no sky can explain, found in the residual of a first image."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from casa_sara.data.distribution import series_with
from casa_sara.data.noise import MEDIAN_TO_SIGMA, series_of_rows
from casa_sara.data.visibilities import Visibilities
from casa_sara.data.weight_levels import APART, levels
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["WildSamples", "find_wild"]

SIGNIFICANT = 20.0  # of the robust scale of its block and level of weights
IMPOSSIBLE = 1.5  # times the flux of the image, which no visibility of a positive sky exceeds
COMPARABLE = 0.2  # of the largest residual
MOST = 0.01  # of the samples: more than that are not wild, the image is wrong
NEIGHBOURS = (-2, -1, 1, 2)


@dataclass
class WildSamples:
    """The samples to leave out, and what was found of each.

    Attributes
    ----------
    index : int (n,)
        Into the visibilities that were searched.
    amplitude_jy, predicted_jy : float (n,)
        |V| as observed and as the first image has it.
    """

    index: np.ndarray
    amplitude_jy: np.ndarray
    predicted_jy: np.ndarray

    def named(self, data: Visibilities) -> list[dict[str, Any]]:
        """Return a list of dicts that name each sample: ms, row, channel, antennas, time (MJD s), amplitudes (Jy).

        Parameters
        ----------
        data : Visibilities
            The samples that were searched.

        Returns
        -------
        list of dict
        """
        rows, row = data.rows, data.row[self.index]
        return [
            dict(ms=data.ms_names[rows.ms[r]] if data.ms_names else "", row=int(rows.row[r]), channel=int(channel),
                 spw=int(rows.spw[r]), antenna1=int(rows.antenna1[r]), antenna2=int(rows.antenna2[r]),
                 time_mjd_s=float(rows.time[r]), amplitude_jy=float(seen), predicted_jy=float(expected))
            for r, channel, seen, expected in zip(row, data.chan[self.index], self.amplitude_jy, self.predicted_jy)
        ]


def find_wild(data: Visibilities, offsets: np.ndarray, residual: np.ndarray, flux_jy: float,
              comm: Serial = SERIAL) -> WildSamples:
    """Find samples that a first image cannot have left for any reason but their own.

    A sample is wild when its residual exceeds 20 times the scale of the samples of like weight in its block (1.4826 ×
    the median of the whitened real and imaginary parts) and what the image predicts for it, and when either

    - its amplitude exceeds 1.5 times the flux of the image, as no visibility of a positive sky does, or
    - it stands alone: the residuals of the same baseline and channel before and after it (median of up to four)
      differ from it by more than half of it, as what the image lacks, or a calibration error, would not.

    Of these only the ones within a factor 5 of the largest residual are named: they may have spoiled the image, and
    made the others look wild, so a next image must tell.  Nothing is wild when more than 1 % of the samples would be.
    Samples that weigh less by a factor of 100 have no say: they are neither neighbours nor counted.

    Parameters
    ----------
    data : Visibilities
        In the order of their blocks.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    residual : complex (M,)
        y − Φx of the image, whitened by √weight.
    flux_jy : float
        Σ|x| of the image.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread; each finds those of its own.

    Returns
    -------
    WildSamples
    """
    found = [_suspects(data, slice(start, stop), residual, comm) for start, stop in zip(offsets[:-1], offsets[1:])]
    suspect, size, predicted = (np.concatenate(parts) for parts in zip(*found))
    impossible = np.abs(data.vis[suspect]) > IMPOSSIBLE * flux_jy
    chosen = impossible | _alone(*series_with(data, residual, suspect, comm))
    wild, size, predicted = suspect[chosen], size[chosen], predicted[chosen]
    counted = data.weight >= comm.largest(data.weight[wild].max(initial=0)) / APART
    if comm.total(wild.size) > MOST * comm.total(int(np.count_nonzero(counted))):
        wild, size, predicted = wild[:0], size[:0], predicted[:0]
    near = size >= COMPARABLE * comm.largest(size.max(initial=0))
    return WildSamples(wild[near], np.abs(data.vis[wild[near]]), predicted[near])


def _suspects(data, block, residual, comm):
    """Return the samples of a block with large residuals, the sizes of these, and what the image predicts for them."""
    size, weight = np.abs(residual[block]), data.weight[block]
    scale = np.empty_like(size)
    level, count = levels(weight, comm)
    for number in range(count):
        here = slice(None) if count == 1 else np.flatnonzero(level == number)
        left = residual[block][here]
        scale[here] = MEDIAN_TO_SIGMA * comm.median(np.abs([left.real, left.imag]))
    predicted = np.abs(data.vis[block] - residual[block] / np.sqrt(weight))
    suspect = np.flatnonzero((size > SIGNIFICANT * scale) & (size > predicted * np.sqrt(weight)))
    data.scratch.let_go()
    return block.start + suspect, size[suspect], predicted[suspect]


def _alone(data, residual, suspect):
    """Whether the samples before and after, of the same series, lack what these have; bool (n,)."""
    if suspect.size == 0:
        return np.zeros(0, bool)
    series = series_of_rows(data.rows)[data.row] * (int(data.chan.max()) + 1) + data.chan
    order = np.lexsort((data.rows.time[data.row], series))
    alone = np.zeros(suspect.size, bool)
    weight, decade = data.weight[order], np.floor(np.log10(data.weight[suspect]))
    for number in np.unique(decade):
        these, like = decade == number, (weight >= 10**number / APART) & (weight < 10 ** (number + 1) * APART)
        alone[these] = _alone_among(order[like], series, residual, suspect[these])
    return alone


def _alone_among(order, series, residual, suspect):
    """Return the same, with the neighbours out of the samples `order`, sorted by series and time."""
    place = np.empty(series.size, order.dtype)
    place[order] = np.arange(order.size)
    around = np.full((len(NEIGHBOURS), suspect.size), np.nan + 0j)
    for k, step in enumerate(NEIGHBOURS):
        there = place[suspect] + step
        inside = (there >= 0) & (there < order.size)
        other = order[np.where(inside, there, 0)]
        same = inside & (series[other] == series[suspect])
        around[k, same] = residual[other[same]]
    known = ~np.all(np.isnan(around.real), axis=0)
    alone = np.zeros(suspect.size, bool)
    middle = np.nanmedian(around.real[:, known], axis=0) + 1j * np.nanmedian(around.imag[:, known], axis=0)
    alone[known] = np.abs(residual[suspect[known]] - middle) > 0.5 * np.abs(residual[suspect[known]])
    return alone
