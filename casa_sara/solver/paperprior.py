"""The ℓ1 prior of Dabbech et al. 2018, with the weights W inside the operator, and equation (5)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from casa_sara.runtime import jit
from casa_sara.solver.interfaces import Dictionary

__all__ = ["PaperPrior"]

RELAXATION = 1.0  # ρ: Algorithm 1 has no over-relaxation


@jit.kernel()
def _dual_rows(coefs, dual, weights, limit, relaxation, worker, workers):
    """u ← u + ρ(clip(u + W c, ± limit) − u), c ← W u; all (rows, columns)."""
    for i in range(coefs.shape[0] * worker // workers, coefs.shape[0] * (worker + 1) // workers):
        for k in range(coefs.shape[1]):
            old, weight = dual[i, k], weights[i, k]
            new = min(max(old + weight * coefs[i, k], -limit), limit)
            new = old + relaxation * (new - old)
            dual[i, k] = new
            coefs[i, k] = weight * new


class PaperPrior:
    """The dictionary with the weights inside the operator, as the iteration wants it: Step 13, and ζΨWu of Step 17.

    u ← (1 − S_{κ‖ΨW‖})(u + WΨ†x̄),  ζ = 1/‖ΨW‖².

    Parameters
    ----------
    dictionary : SaraDictionary
        With ‖Ψ‖ = 1; its coefficients are (b, NX, NY), one plane for each basis.
    workers : object
        `run(kernel, *arguments)`.
    norm_sq : callable
        (A†A as a function of an image, shape, dtype) → ‖A‖²: :func:`casa_sara.operators.norms.power_method`.

    Attributes
    ----------
    norm : float
        ‖ΨW‖ of the present weights.
    """

    def __init__(self, dictionary: Dictionary, workers: Any, norm_sq: Callable[..., float]) -> None:
        self.dictionary, self._run, self._norm_sq = dictionary, workers.run, norm_sq
        self.n_bases, self.allocate = dictionary.n_bases, dictionary.allocate
        self._coefs = dictionary.allocate()
        self.norm = 1.0

    def dual_step(self, model_bar: np.ndarray, dual: np.ndarray, threshold: float, weights: np.ndarray,
                  out: np.ndarray, relaxation: float = RELAXATION) -> np.ndarray:
        """Update u in place (Step 13) and return ζΨWu.

        Parameters
        ----------
        model_bar : real (nx, ny)
            x̄.
        dual, weights : real (b, NX, NY)
            u and W.
        threshold : float
            κ.
        out : real (nx, ny)
            Receives ζΨWu.
        relaxation : float
            ρ.

        Returns
        -------
        real (nx, ny)
            ζΨWu.
        """
        real = dual.dtype.type
        self.dictionary.analysis(model_bar, self._coefs)
        rows = [array.reshape(-1, array.shape[-1]) for array in (self._coefs, dual, weights)]
        self._run(_dual_rows, *rows, real(threshold * self.norm), real(relaxation))
        self.dictionary.synthesis(self._coefs, out)
        out *= real(self.norm**-2.0)
        return out

    def reweight(self, model: np.ndarray, scale: float, weights: np.ndarray) -> None:
        """Equation (5): W_i = ω^k/(ω^k + |Ψ_i†x|/max|Ψ_i†x|) in every basis i, and its ‖ΨW‖.

        Parameters
        ----------
        model : real (nx, ny)
            x.
        scale : float
            ω^k.
        weights : real (b, NX, NY)
            Receives W.
        """
        self.dictionary.analysis(model, weights)
        np.abs(weights, out=weights)
        for basis in weights:
            largest = float(basis.max())
            basis *= 1 / (scale * largest) if largest > 0 else 0
            basis += 1
            np.reciprocal(basis, out=basis)

        def normal(image):
            coefs = self.dictionary.analysis(image, self._coefs)
            coefs *= weights
            coefs *= weights
            return self.dictionary.synthesis(coefs)

        self.norm = float(np.sqrt(self._norm_sq(normal, model.shape, dtype=model.dtype)))
