"""Point sources between pixels, in the model.

Pixels that may only be positive hold a source between them as something wider, and the data answer with too much flux:
2π²·var·⟨u²⟩ of it, 8 % where the beam has 3.5 pixels.  A known point is held by 6 × 6 pixels in the one shape s that
has, for the data, its place: Lagrange's interpolation, with small negative pixels.  Only its flux is free: the model is
a·s there, a ≥ 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

__all__ = ["PointSources", "SIDE"]

SIDE = 6  # pixels
NODES = np.arange(SIDE) - (SIDE // 2 - 1)  # offsets of the pixels from that at, or before, the place


class PointSources:
    """Point sources at known places.

    Parameters
    ----------
    places : real (n, 2)
        Pixels, anywhere between them.

    Attributes
    ----------
    places : float (n, 2)
    x, y : int (n, 36)
        The pixels of each source.
    shapes : float (n, 36)
        Their values for a source of unit flux.
    """

    def __init__(self, places: npt.ArrayLike = ()) -> None:
        self.places = np.array(places, float).reshape(-1, 2)
        first = np.floor(self.places).astype(int)
        square = np.indices((SIDE, SIDE)).reshape(2, -1) + NODES[0]
        self.x, self.y = (first[:, [axis]] + square[axis] for axis in (0, 1))
        along = _lagrange(self.places - first)
        self.shapes = np.einsum("ni,nj->nij", along[:, 0], along[:, 1]).reshape(len(first), SIDE**2)
        self._sizes_sq = np.square(self.shapes).sum(axis=1)

    def __len__(self) -> int:
        return len(self.places)

    def pixels(self, shape: tuple[int, int]) -> np.ndarray:
        """Return the pixels of all sources, bool (nx, ny).

        Parameters
        ----------
        shape : (int, int)
            Of the image.

        Returns
        -------
        bool (nx, ny)
        """
        covered = np.zeros(shape, bool)
        covered[self.x, self.y] = True
        return covered

    def values(self, image: np.ndarray) -> np.ndarray:
        """Return what an image holds in the pixels of each source, float (n, 36).

        Parameters
        ----------
        image : real (nx, ny)
            The image.

        Returns
        -------
        float (n, 36)
        """
        return image[self.x, self.y].astype(float)

    def project(self, model: np.ndarray, anchor: np.ndarray, model_bar: np.ndarray, before: np.ndarray,
                groups: Sequence[np.ndarray | slice] = (slice(None),)) -> np.ndarray:
        """Project x⁺ on {a·s, a ≥ 0} around every source, in place, and x̄ = 2x⁺ − z with it: Step 17 there.

        Parameters
        ----------
        model, anchor, model_bar : real (nx, ny)
            x⁺, z and x̄.
        before : float (n, 36)
            :meth:`values` of x.
        groups : sequence of int arrays or slices
            Sources whose changes are wanted together.

        Returns
        -------
        float (number of groups, 3)
            What this changes in Σ(x⁺ − x)², Σ(x⁺)² and Σx⁺.
        """
        free = self.values(model)
        flux = np.maximum((free * self.shapes).sum(axis=1) / self._sizes_sq, 0)
        held = (flux[:, None] * self.shapes).astype(model.dtype)
        model[self.x, self.y] = held
        model_bar[self.x, self.y] = 2 * held - anchor[self.x, self.y]
        held = held.astype(float)
        changes = (np.square(held - before) - np.square(free - before), np.square(held) - np.square(free), held - free)
        return np.array([[change[group].sum() for change in changes] for group in groups])


def _lagrange(offset):
    """Weights of the pixels at NODES for a place this far from that at 0, real (…, 6)."""
    weights = np.ones((*np.shape(offset), SIDE))
    for k, node in enumerate(NODES):
        for other in np.delete(NODES, k):
            weights[..., k] *= (offset - other) / (node - other)
    return weights
