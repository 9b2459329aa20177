"""The islands of emission of a model on the sky."""

from __future__ import annotations

import numpy as np

__all__ = ["located"]


def located(islands, plane, cell_rad):
    """Return the islands of a model with their places on the sky.

    Parameters
    ----------
    islands : list of dict
        Of :func:`casa_sara.solver.islands.islands_of`.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    cell_rad : (float, float)
        Pixel size.

    Returns
    -------
    list of dict
        With `right_ascension` and `declination` (text, in the frame of the image) and `fwhm_arcsec` besides.
    """
    import casatools

    csys = casatools.coordsys()
    csys.fromrecord(plane.csys)
    rest = np.asarray(csys.referencepixel()["numeric"])[2:]
    arcsec = float(np.degrees(np.sqrt(cell_rad[0] * cell_rad[1])) * 3600)
    found = []
    for island in islands:
        longitude, latitude = csys.toworld([island["x"], island["y"], *rest], "s")["string"][:2]
        found.append(island | dict(right_ascension=str(longitude), declination=str(latitude),
                                   fwhm_arcsec=arcsec * island["fwhm_pixels"]))
    return found
