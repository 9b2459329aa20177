"""What the solver asks of the operators that it is given."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

__all__ = ["Dictionary", "Measurement", "Prior"]


class Measurement(Protocol):
    """Φ: from a real image (nx, ny) to whitened visibilities, complex (M,).

    Attributes
    ----------
    shape : (int, int)
        (nx, ny).
    workers : casa_sara.operators._workers.Workers
        Threads: `run(kernel, *arguments)` calls kernel(*arguments, worker, workers) on every one.
    """

    shape: tuple[int, ...]
    workers: Any

    def forward(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Φ·image, complex (M,), of a real image (nx, ny), in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : array, optional
            Receives the result.

        Returns
        -------
        complex (M,)
        """
        ...

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Re(Φ†·vis), real (nx, ny), of complex (M,), in `out` where given.

        Parameters
        ----------
        vis : complex (M,)
            The visibilities.
        out : array, optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        ...


class Prior(Protocol):
    """Ψ with what Step 13 does to the dual variables u; coefficients are arrays of the shape that `allocate` gives.

    Attributes
    ----------
    n_bases : int
    """

    n_bases: int

    def allocate(self) -> np.ndarray:
        """Return an array of coefficients, all 0."""
        ...

    def dual_step(self, model_bar: np.ndarray, dual: np.ndarray, threshold: float, weights: np.ndarray, out: np.ndarray,
                  relaxation: float) -> np.ndarray:
        """Update `dual` in place from Ψ†·model_bar and return ζΨ·dual in `out`, real (nx, ny).

        Parameters
        ----------
        model_bar : real (nx, ny)
            x̄.
        dual, weights : real, of the shape of coefficients
            u and W.
        threshold : float
            κ.
        out : real (nx, ny)
            Receives the result.
        relaxation : float
            ρ.

        Returns
        -------
        real (nx, ny)
        """
        ...


class Dictionary(Prior, Protocol):
    """Ψ by itself, ‖Ψ‖ = 1."""

    def analysis(self, image: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ†·image, in `out` where given.

        Parameters
        ----------
        image : real (nx, ny)
            The image.
        out : real, of the shape of coefficients, optional
            Receives the result.

        Returns
        -------
        real, of the shape of coefficients
        """
        ...

    def synthesis(self, coefs: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Ψ·coefs, real (nx, ny), in `out` where given.

        Parameters
        ----------
        coefs : real, of the shape of coefficients
            The coefficients.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        ...
