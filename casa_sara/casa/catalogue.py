"""The islands of a model on the sky, for the log and the record."""

from __future__ import annotations

import numpy as np

from casa_sara.casa import log
from casa_sara.parallel import SERIAL
from casa_sara.solver.islands import STRUCTURE

__all__ = ["list_islands"]

MOST_TOLD = 20  # islands that the log lists


def list_islands(record, plane, cell_rad, significance, comm=SERIAL):
    """Give the islands of a model their places on the sky, list them in the log, and say whether the residual is noise.

    Parameters
    ----------
    record : SolverRecord
        Its islands are given `right_ascension` and `declination` (text, in the frame of the image) and `fwhm_arcsec`.
    plane : ImagePlane
    cell_rad : (float, float)
        Pixel size.
    significance : float
        That was asked for.
    comm : casa_sara.parallel.Serial or MPI
        Ranks that share the work.
    """
    record.islands = comm.once(_located, record.islands, plane, cell_rad)
    _tell(record, significance)


def _located(islands, plane, cell_rad):
    import casatools

    csys = casatools.coordsys()
    csys.fromrecord(plane.csys)
    rest = np.asarray(csys.referencepixel()["numeric"])[2:]
    arcsec = float(np.degrees(np.sqrt(cell_rad[0] * cell_rad[1])) * 3600)
    located = []
    for island in islands:
        longitude, latitude = csys.toworld([island["x"], island["y"], *rest], "s")["string"][:2]
        located.append(island | dict(right_ascension=str(longitude), declination=str(latitude),
                                     fwhm_arcsec=arcsec * island["fwhm_pixels"]))
    return located


def _tell(record, significance):
    if not record.residual_snr:
        return
    islands = record.islands
    if not islands:
        log.info(f"no emission of {significance:g} sigma or more: the model is empty")
    else:
        log.info(f"{len(islands)} islands of emission of {significance:g} sigma or more"
                 + (f", the {MOST_TOLD} most significant:" if len(islands) > MOST_TOLD else ":"))
    for island in islands[:MOST_TOLD]:
        log.info(f"  {island['right_ascension']} {island['declination']}: {island['flux_jy']:.4g} +- "
                 f"{island['flux_error_jy']:.2g} Jy, S/N {island['snr']:.3g}, FWHM {island['fwhm_arcsec']:.3g} arcsec")
    worst = max((peak for peak in record.residual_snr if peak["beams"] >= 1), key=lambda peak: peak["snr"], default=None)
    if worst and worst["snr"] > STRUCTURE:
        log.warn(f"the residual is not noise: it reaches {worst['snr']:.3g} sigma when smoothed to {worst['beams']:g} beams; "
                 "calibration errors, emission outside the image, or emission that the model cannot hold")
