"""The islands of emission of a model: their sky coordinates and their list in the log, with what the residual holds."""

from __future__ import annotations

import math

import numpy as np

from casa_sara.casa.images.image_plane import ImagePlane
from casa_sara.casa.images.island_positions import located
from casa_sara.casa.runtime import log
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.solver.record import SolverRecord
from casa_sara.solver.residual_structure import STRUCTURE

__all__ = ["list_islands"]

DIFFER = 2.0  # times: errors of jackknife and bootstrap that do not agree
MOST_TOLD = 20  # islands of emission that the log lists


def list_islands(record: SolverRecord, plane: ImagePlane, cell_rad: tuple[float, float], significance: float,
                 comm: Serial = SERIAL) -> None:
    """Give the islands of a model sky coordinates, list them in the log, and warn where the residual is not noise.

    Parameters
    ----------
    record : SolverRecord
        Its islands are given `right_ascension` and `declination` (text, in the frame of the image) and `fwhm_arcsec`.
    plane : ImagePlane
        The image plane: coordinates, primary beam, mask.
    cell_rad : (float, float)
        Pixel size.
    significance : float
        That was asked for.
    comm : casa_sara.parallel.serial.Serial or MPI
        Ranks that share the work.
    """
    record.islands = comm.once(located, record.islands, plane, cell_rad)
    _log_islands(record, significance, cell_rad)


def _log_islands(record, significance, cell_rad):
    """Write the islands to the log, to a hundredth of a pixel, and warn where the residual is not noise."""
    if not record.residual_snr:
        return
    islands = [island for island in record.islands if island["snr"] >= significance]
    faint = [island["flux_jy"] for island in record.islands if island["snr"] < significance]
    digits = max(0, 2 - math.floor(math.log10(math.degrees(min(cell_rad)) * 3600)))
    if not record.islands:
        log.info(f"no emission of {significance:g} sigma or more: the model is empty")
    else:
        log.info(f"{len(islands)} islands of emission of {significance:g} sigma or more"
                 + (f", the {MOST_TOLD} most significant:" if len(islands) > MOST_TOLD else ":" if islands else ""))
    for island in islands[:MOST_TOLD]:
        place = " ".join(_shortened(island[name], digits) for name in ("right_ascension", "declination"))
        error = island.get("bootstrap_error_jy", island["flux_error_jy"])
        log.info(f"  {place}: {island['flux_jy']:.4g} +- {error:.2g} Jy, S/N {island['snr']:.3g}, "
                 f"FWHM {island['fwhm_arcsec']:.3g} arcsec")
    if faint:
        log.info(f"  and {len(faint)} fainter islands in their surroundings, {sum(faint):.2g} Jy together")
    _compare_errors(islands)
    if record.gain_errors:
        log.warn("the residual visibilities show antenna gain errors that change from {interval} to {interval}: "
                 "{amplitude:.2%} in amplitude and {degrees:.2g} degrees in phase (rms). What they explain is kept out "
                 "of the model (gainfit = True); self-calibration would remove them"
                 .format(**record.gain_errors, degrees=math.degrees(record.gain_errors["phase"])))
    worst = max((peak for peak in record.residual_snr if peak["beams"] >= 1), key=lambda peak: peak["snr"],
                default=None)
    if worst and worst["snr"] > STRUCTURE:
        log.warn(f"the residual image is not consistent with noise: smoothed to {worst['beams']:g} beams it reaches "
                 f"{worst['snr']:.3g} sigma. Possible causes are calibration errors, emission outside the image, or "
                 "emission that the model cannot represent")


def _compare_errors(islands):
    """Say how the errors of the jackknife compare with those of the bootstrap, where there are both."""
    ratios = [island["jackknife_error_jy"] / island["bootstrap_error_jy"] for island in islands
              if "jackknife_error_jy" in island and island.get("bootstrap_error_jy", 0) > 0]
    if not ratios:
        return
    middle = float(np.median(ratios))
    line = (f"errors of the fluxes of islands by the jackknife over snapshots are {middle:.2g} times those by the "
            f"bootstrap (median of {len(ratios)})")
    if middle > DIFFER:
        log.warn(f"{line}: more than the noise explains, as of calibration errors that differ between snapshots; "
                 "believe the larger ones")
    elif middle < 1 / DIFFER:
        log.warn(f"{line}: less than the noise alone should give")
    else:
        log.info(line)


def _shortened(angle, digits):
    """Return an angle as text, cut to so many decimal places."""
    whole, point, decimals = angle.rpartition(".")
    return whole + point + decimals[:digits] if digits else whole
