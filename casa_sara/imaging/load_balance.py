"""The division of the work among the ranks, so that all finish at the same time.

The cost of one iteration, in ns on one core, measured by benchmarks/parallel.py at 2048² in single precision.  Only
their ratios matter.
"""

from __future__ import annotations

import math

import numpy as np

from casa_sara.operators.dictionary import filter_lengths
from casa_sara.operators.measurement import grid_bytes
from casa_sara.parallel.partition import RankAssignment

__all__ = ["assign_ranks", "basis_costs", "operator_costs", "solver_samples"]

DIRAC, WAVELET, TAP = 2.3, 3.3, 0.17  # of a pixel: the pixel basis, a wavelet, and more for each tap
PIXEL, CELL, SAMPLE = 8.1, 6.2, 132.0  # of the operator and its adjoint: a pixel, a cell of the uv grid, a visibility
CELL_BYTES = 8
ALIKE = 0.05  # times that differ by less are the same


def basis_costs(wavelets, shape):
    """Seconds of each basis, float (b,)."""
    taps = filter_lengths(wavelets)
    return np.where(taps > 0, WAVELET + TAP * taps, DIRAC) * math.prod(shape) * 1e-9


def solver_samples(volume, grid, options):
    """Return how many samples an iteration is thought to have: those that there are, or averages of them.

    More averages than pixels there are only where cells are not enlarged any more, and more than half of the samples
    never.
    """
    averages = options.averages and grid.nterms == 1
    return min(volume.samples // 2, math.prod(grid.shape)) if averages else volume.samples


def operator_costs(volume, grid, samples):
    """Seconds that the operator takes on every rank that has some of these samples, and those that the ranks share."""
    reach = [min(max(wave * cell, 1e-6), 0.5) for wave, cell in zip(volume.reach, grid.cell_rad)]
    cells = grid_bytes(samples, reach, grid.shape) / CELL_BYTES
    return (PIXEL * math.prod(grid.shape) + CELL * cells) * 1e-9, SAMPLE * samples * 1e-9


def assign_ranks(comm, volume, grid, options, fits=lambda ranks: True):
    """Return the division of the work among the ranks: the fastest one for which all have enough memory.

    Every rank that has visibilities does a whole Fourier transform, so their number, too, is chosen for the least time;
    the bases then go to whoever has least to do, the costly ones first.

    Parameters
    ----------
    comm : casa_sara.parallel.serial.Serial or MPI
        The ranks.
    volume : casa_sara.casa.ms.data_volume.DataVolume
        How many data there are.
    grid : casa_sara.options.ImageGrid
        Size, pixels, direction and gridder of the image.
    options : casa_sara.options.SolverOptions
        Task parameters of the method.
    fits : callable
        Tells whether the ranks have the memory for a division of the work; the same on every rank.

    Returns
    -------
    RankAssignment
    """
    if comm.size == 1:
        return RankAssignment(comm)
    bases = basis_costs(options.wavelets, grid.shape) * (options.niter > 0)
    fixed, shared = operator_costs(volume, grid, solver_samples(volume, grid, options))
    plans = []
    for readers in range(1, comm.size + 1):
        ranks = RankAssignment(comm, readers)
        load = np.array([0.0 if ranks.reader(rank) is None else fixed + shared / readers for rank in range(comm.size)])
        owners = np.zeros(bases.size, int)
        for basis in np.argsort(-bases, kind="stable"):
            owners[basis] = np.argmin(load)
            load[owners[basis]] += bases[basis]
        plans.append((load.max(), RankAssignment(comm, readers, tuple(owners.tolist()))))
    least = min(load for load, _ in plans)
    # of plans that are alike the one with fewest readers first
    plans.sort(key=lambda plan: int(plan[0] / least / ALIKE))
    return next((ranks for _, ranks in plans if fits(ranks)), plans[0][1])
