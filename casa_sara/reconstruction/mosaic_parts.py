"""The parts of the image that the samples of a mosaic see, within which they are averaged."""

from __future__ import annotations

import numpy as np

from casa_sara.data.averaging import cell_sides
from casa_sara.data.parts import Parts
from casa_sara.operators.beams import Mosaic, around

__all__ = ["parts_of"]


def parts_of(mosaic: Mosaic, uvw: np.ndarray, beam_of_sample: np.ndarray) -> Parts:
    """Return what samples are in the parts of the image that their beams take.

    Parameters
    ----------
    mosaic : Mosaic
        The beams.
    uvw : float64 (3, M)
        Baselines in wavelengths.
    beam_of_sample : int (M,)
        Number of the beam of each sample.

    Returns
    -------
    Parts
        With cells for a source in the corner of a part.
    """
    uv, turn = np.empty((2, uvw.shape[1])), np.empty(uvw.shape[1], np.complex64)
    middles, sides = np.empty((len(mosaic.beams), 2)), np.empty((len(mosaic.beams), 2))
    for number, beam in enumerate(mosaic.beams):
        here, middle = np.flatnonzero(beam_of_sample == number), mosaic.middle(number)
        uv[:, here], turn[here] = around(uvw[:, here], middle)
        shape = tuple(axis.stop - axis.start for axis in beam.box(mosaic.shape, mosaic.cell_rad))
        middles[number], sides[number] = middle[:2], cell_sides(shape, mosaic.cell_rad)[1::-1]
    return Parts(np.asarray(beam_of_sample, np.int32), uv, turn, middles, sides)
