"""Mosaics: what is solved for is the sky times the sensitivity, whose noise is the same everywhere.

With S² = Σ_g W_g A_g²/Σ_g W_g (W_g the summed weight of the samples of beam g) every pixel of the image x = S·I has a
column of Φ/S of the same norm, √(Σ w), as in an image of a single pointing. All that the solver takes for granted of a
single pointing (one noise level of the image, one response, steps that suit every pixel, ℓ1 weights by band) then holds
for a mosaic too; of one pointing alone it is the same problem, the sky as the antennas see it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from casa_sara.data.visibilities import Visibilities
from casa_sara.options import ImageGrid
from casa_sara.parallel.serial import SERIAL, Serial

__all__ = ["FlatNoise"]


@dataclass(frozen=True)
class FlatNoise:
    """The change of variables x = S·I.

    Attributes
    ----------
    sensitivity : real (nx, ny)
        S; 0 where nothing is modelled.
    """

    sensitivity: np.ndarray

    @classmethod
    def of(cls, data: Visibilities, grid: ImageGrid, comm: Serial = SERIAL) -> FlatNoise | None:
        """Return that of these samples, by their weights; None unless they are of a mosaic.

        Parameters
        ----------
        data : Visibilities
            With `weight` and `beam`.
        grid : ImageGrid
            With its mosaic.
        comm : casa_sara.parallel.serial.Serial or MPI
            Over whose ranks the samples are spread.

        Returns
        -------
        FlatNoise or None
        """
        if grid.mosaic is None:
            return None
        return cls(grid.mosaic.sensitivity(comm.allreduce(grid.mosaic.sums(data.beam, data.weight))))

    def grid(self, grid: ImageGrid) -> ImageGrid:
        """Return the image plane of x.

        Parameters
        ----------
        grid : ImageGrid
            That of the sky.

        Returns
        -------
        ImageGrid
        """
        return replace(grid, mosaic=grid.mosaic.flat(self.sensitivity))

    def support(self, support: np.ndarray | None) -> np.ndarray:
        """Return where x may be non-zero, bool (nx, ny), within a support.

        Parameters
        ----------
        support : bool (nx, ny) or None
            Where the sky may be non-zero; everywhere without it.

        Returns
        -------
        bool (nx, ny)
        """
        seen = self.sensitivity > 0
        return seen if support is None else seen & support

    def image(self, sky: np.ndarray | None) -> np.ndarray | None:
        """Return x of a sky I, real (nx, ny).

        Parameters
        ----------
        sky : real (nx, ny) or None
            I.

        Returns
        -------
        real (nx, ny) or None
        """
        return None if sky is None else sky * self.sensitivity

    def of_sky(self, found: Any) -> Any:
        """Return a reconstruction of x as one of the sky.

        Its noise is that of an image of flat noise, sky × S/max S, as of .residual.

        Parameters
        ----------
        found : casa_sara.reconstruction.result.Reconstruction
            That of x.

        Returns
        -------
        casa_sara.reconstruction.result.Reconstruction
        """
        largest = float(self.sensitivity.max())
        sky, spectra = (image if image is None else np.divide(
            image, self.sensitivity, out=np.zeros_like(image), where=self.sensitivity > 0)
            for image in (found.model, found.spectra))
        return replace(found, model=sky, spectra=spectra, noise_jy_per_beam=found.noise_jy_per_beam / largest,
                       threshold=found.threshold / largest)
