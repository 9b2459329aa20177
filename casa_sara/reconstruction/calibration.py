"""What errors of the antenna gains may have made of a model's emission: artefacts that are not to be taken for sky."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from casa_sara.data.gain_errors import AntennaGains, GainErrors
from casa_sara.data.visibilities import Visibilities
from casa_sara.operators.measurement import Summed
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["Calibration"]


class Calibration:
    """Artefacts of gain errors in the image of a residual.

    Parameters
    ----------
    data : Visibilities
        All samples, not averaged.
    vis : complex (M,)
        y, whitened by the MS weights.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    operator : object
        Φ of all samples of this rank, whitened like y.
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Attributes
    ----------
    found : GainErrors or None
        What the last residual showed; None before, and where it showed none.
    """

    def __init__(self, data: Visibilities, vis: np.ndarray, offsets: np.ndarray, operator: Any,
                 comm: Serial = SERIAL) -> None:
        self._data, self._vis, self._offsets, self._operator, self._comm = data, vis, offsets, operator, comm
        self._gains: AntennaGains | None = None
        self.found: GainErrors | None = None

    @property
    def summary(self) -> dict[str, Any]:
        """What was found, for the record; {} where nothing was."""
        names = ("interval", "amplitude", "phase", "significance", "ratio")
        return {} if self.found is None else {name: getattr(self.found, name) for name in names}

    def artefacts(self, model: np.ndarray, noise_weights: np.ndarray,
                  in_doubt: Callable[[float], np.ndarray]) -> np.ndarray | None:
        """Return the image that gain errors make of the bright part of a model, Φ†Σ⁻¹(g_p + g_q*)Φx.

        Where |g_p + g_q*| is δ in the rms, δ‖Σ^{−½}Φx‖ of the data is moved in all.  Emission of less than this S/N is
        in doubt: it may have been fitted to that.  So the gains are those that explain what the rest of the model
        leaves, where what all of it leaves has shown δ.

        Parameters
        ----------
        model : real (nx, ny)
            x.
        noise_weights : float (d,)
            1/σ_j² of each block, relative to the MS weights.
        in_doubt : callable
            Takes an S/N and returns the part of the model, real (nx, ny), whose islands have less.

        Returns
        -------
        real (nx, ny) or None
            None where the residual shows no gain errors.
        """
        gains = self._gains = self._gains or AntennaGains(self._data, self._comm)
        left = _Left(self._operator, self._vis, model, np.repeat(
            np.sqrt(noise_weights[:len(self._offsets) - 1]).astype(self._vis.real.dtype), np.diff(self._offsets)))
        total = float(np.sqrt(self._comm.total(float(np.vdot(left.predicted, left.predicted).real))))
        errors = gains.fit(left.predicted, left.residual)
        self.found = errors if errors.believed else None
        if self.found is None:
            return None
        left.take_for_sky(model - in_doubt(self.found.moved * total))
        factors = gains.fit(left.predicted, left.residual).factors.astype(left.predicted.dtype)
        left.predicted *= factors[self._data.row]
        left.predicted *= left.whitening
        return Summed(self._operator, self._comm).adjoint(left.predicted)


class _Left:
    """Visibilities that a part of a model predicts, and what it leaves of those observed, all over their noise."""

    def __init__(self, operator, vis, model, whitening):
        self._operator, self._sky, self.whitening = operator, model, whitening
        self.predicted = operator.forward(model)
        self.residual = (vis - self.predicted) * whitening
        self.predicted *= whitening

    def take_for_sky(self, sky):
        """Let another part of the model predict."""
        if np.array_equal(sky, self._sky):
            return
        change = self._operator.forward(sky - self._sky)
        change *= self.whitening
        self.predicted += change
        self.residual -= change
        self._sky = sky
