"""Stokes I visibilities of one image, and their split into snapshot blocks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

__all__ = ["RowTable", "Visibilities"]


@dataclass
class RowTable:
    """What is known of each MeasurementSet row that holds at least one sample, all (R,).

    `row` counts in its own MeasurementSet, `ms` numbers the MeasurementSets,
    `time` is the centroid in MJD seconds and `interval` its length in seconds.
    """

    ms: np.ndarray
    row: np.ndarray
    time: np.ndarray
    interval: np.ndarray
    scan: np.ndarray
    observation: np.ndarray
    field: np.ndarray
    spw: np.ndarray
    antenna1: np.ndarray
    antenna2: np.ndarray


@dataclass
class Visibilities:
    """All usable Stokes I samples, rotated to the image's phase centre.

    Attributes
    ----------
    vis : complex64 (M,)
        Visibilities in Jy.
    weight : float32 (M,)
        Inverse variance of the real part, and of the imaginary part, in 1/Jy²:
        4 / (1/w_RR + 1/w_LL), exact when WEIGHT = 1/SIGMA².
    imaging_weight : float32 (M,)
        tclean's natural gridding weight, (w_RR + w_LL) / 2.
    uvw : float64 (3, M)
        Baselines in wavelengths at the LSRK frequency of the integration.
    row : int32 (M,)
        Index into `rows`.
    chan : int16 (M,)
        Channel number in the spectral window.
    rows : RowTable
    ms_names : tuple of str
    dropped : dict
        Reason → number of samples that were left out.
    notes : list of str
        Warnings that the user must see, also in the record of the run.
    """

    vis: np.ndarray
    weight: np.ndarray
    imaging_weight: np.ndarray
    uvw: np.ndarray
    row: np.ndarray
    chan: np.ndarray
    rows: RowTable
    ms_names: tuple[str, ...] = ()
    dropped: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def size(self) -> int:
        """Number of samples M."""
        return self.vis.size
