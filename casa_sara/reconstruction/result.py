"""What a reconstruction has found."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from casa_sara.reconstruction.draws import Draws
from casa_sara.solver.record import UNFINISHED, SolverRecord

__all__ = ["Reconstruction"]


@dataclass
class Reconstruction:
    """A solved image.

    Attributes
    ----------
    model : float32 (nx, ny)
        Jy/pixel.
    l2_bounds, residual_norms : float (d,)
        ε_j and μ_j, whitened.
    nnls_norms : float (d,)
        μ_j of the NNLS image, from which adaptive bounds start.
    record : SolverRecord
    data_norm_sq : float
        ‖U^½Φ‖², whitened, 1/Jy².
    threshold : float
        Last κ, Jy/pixel.
    noise_jy_per_beam : float
        Noise of the naturally weighted dirty image for the noise levels found.
    kept : int (M',)
        Samples that were used, numbers into the data given.
    wild : list of dict
        The others, named: see :class:`casa_sara.data.outliers.WildSamples`.
    averaging : dict
        `averages` to which these samples were averaged, `cell_wavelengths` (u, v) of the largest uv cells, `halvings`
        of each block's, and the `largest_error` of the averages of the first image in units of their noise; empty where
        they were not.
    total_power : dict
        Number of `points` of a single dish, the `brightest_jy_per_beam`, `noise_jy_per_beam` found of them, rms
        `residual_jy_per_beam`, and `alone_jy_per_beam`, the noise from what an image of the dish alone leaves; empty
        without one.
    draws, jackknife : Draws or None
        Of the bootstrap and of the jackknife, where asked for and the solution has come to an end.
    spectra : float32 (T, nx, ny) or None
        The model at several frequencies, Jy/pixel, where it was solved for at these; `model` is that at the reference.
    outliers : list of float32 (nx, ny)
        The models of the outliers, Jy/pixel.
    """

    model: np.ndarray
    l2_bounds: np.ndarray
    residual_norms: np.ndarray
    nnls_norms: np.ndarray
    record: SolverRecord
    data_norm_sq: float
    threshold: float
    noise_jy_per_beam: float
    kept: np.ndarray
    wild: list[dict]
    averaging: dict
    total_power: dict = field(default_factory=dict)
    draws: Draws | None = None
    jackknife: Draws | None = None
    spectra: np.ndarray | None = None
    outliers: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(cls, state: dict[str, Any]) -> Reconstruction:
        """Make it of its attributes as a checkpoint has them.

        Parameters
        ----------
        state : dict
            Attributes by name, the record as of :meth:`SolverRecord.state`.

        Returns
        -------
        Reconstruction
        """
        record = SolverRecord()
        record.set_state(state["record"])
        values: dict[str, Any] = {name: np.array(value) if isinstance(value, np.ndarray) else value
                                  for name, value in state.items()}
        return cls(**values | dict(record=record))

    @property
    def finished(self) -> bool:
        """Whether a restart would have nothing to continue."""
        drawn = [draws for draws in (self.jackknife, self.draws) if draws is not None]
        return self.record.stop_code not in UNFINISHED and all(draws.complete for draws in drawn)
