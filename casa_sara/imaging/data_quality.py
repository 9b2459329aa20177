"""Warnings about image plane, data and results: cell, w-term, suspect blocks, masks, scales that are not seen."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter, label

from casa_sara.imaging.mosaic import w_note
from casa_sara.operators.measurement import check_cell, check_field
from casa_sara.parallel.serial import SERIAL

__all__ = ["beyond_baselines", "check_confined", "image_limits", "left_outside", "named_suspects", "nowhere_visible",
           "suspects", "thermal_noise", "without_w_term"]

PEAK_OUTSIDE = 6.0  # standard deviations of the thermal noise
ABOVE_INSIDE = 1.5  # times the largest residual inside: calibration errors leave as much on either side
FAR_ABOVE = 3.0  # times the median of the other blocks
FAR_ABOVE_WEIGHTS = 1.5  # relative to the MS weights
FEWEST_PIXELS = 3.0  # of the finest fringe
LARGEST_W_PHASE = 0.3  # rad, in the corners of the image
SEEN, LOWEST, MAIN = 0.6, 0.05, 0.2  # of the shortest baseline's fringe; of the peak; of the flux
BINS = 5  # in the standard deviation of a Gaussian
# of the reasons, for the log
NAMES = {"thermal noise": "thermal noise is", "errors": "errors (noise and calibration) are"}
FWHM = 2.3548200450309493  # of a Gaussian, in standard deviations


def check_confined(model, support):
    """Return a support as float32 ones and zeros; raise unless the model is exactly zero outside.

    Raises
    ------
    RuntimeError
    """
    outside = int(np.count_nonzero(model[~support]))
    if outside:
        raise RuntimeError(f"mask: {outside} pixels of the model outside the mask are not zero; please report this")
    return support.astype(np.float32)


def thermal_noise(data, weights, noise, offsets, comm=SERIAL):
    """Standard deviation of the thermal noise in the dirty image of some imaging weights W, in Jy/beam.

    √(Σ W²σ²)/Σ W, with σ_m = noise_j/√w_m of block j.

    Parameters
    ----------
    data : Visibilities
        In the order of their blocks.
    weights : real (M,)
        Imaging weights.
    noise : float (d,)
        Of each block relative to the MS weights; 1 is assumed where it is NaN.
    offsets : int (d + 1,)
        Block j is the slice offsets[j]:offsets[j + 1].
    comm : casa_sara.parallel.serial.Serial or MPI
        Over whose ranks the samples are spread.

    Returns
    -------
    float
    """
    power = 0.0
    for piece in data.scratch.pieces(0, data.size):
        counts = np.diff(np.clip(offsets, piece.start, piece.stop))
        level = np.repeat(np.where(np.isfinite(noise), noise, 1.0), counts)
        power += float(np.sum((weights[piece] * level) ** 2 / data.weight[piece], dtype=float))
    power = comm.total(power)
    return float(np.sqrt(power) / comm.total(float(weights.sum(dtype=float))))


def left_outside(residual, support, sigma):
    """Warn where the residual outside the support holds emission that the mask keeps from the model.

    Parameters
    ----------
    residual : real (nx, ny), Jy/beam
        The residual image, Jy/beam.
    support : bool (nx, ny)
        Pixels that may be non-zero.
    sigma : float
        Its thermal noise, Jy/beam.

    Returns
    -------
    list of at most one str
    """
    size = np.abs(residual)
    outside = np.where(support, 0, size)
    peak = float(outside.max())
    if peak <= PEAK_OUTSIDE * sigma or peak <= ABOVE_INSIDE * float(size[support].max()):
        return []
    x, y = np.unravel_index(np.argmax(outside), outside.shape)
    return [f"mask: the residual outside the mask reaches {peak:.3g} Jy/beam, {peak / sigma:.1f} times its noise, at "
            f"pixel [{x}, {y}]: emission outside the mask raises the noise found, and its sidelobes disturb the model "
            "inside"]


def suspects(blocks, measured, l2_bounds):
    """Find the blocks whose errors are far above those of the others.

    From 2M numbers a noise level is known to 1/√(4M), 2 % for the smallest block, so a factor of 3 is no chance. Two
    levels are tested, each relative to the MS weights, against the median of the other blocks: the one that the
    adaptation found, against the same MeasurementSet (calibration errors go with the flux that a configuration sees),
    or against all where it has fewer than three blocks; and the thermal noise measured in the data, against all.

    Parameters
    ----------
    blocks : list of d BlockInfo
        The blocks.
    measured : float (d,)
        NaN where unknown.
    l2_bounds : float (d,)
        Their bounds, whitened.

    Returns
    -------
    list of dict
        `block` (its number), `noise_found`, `noise_measured`, `others` (the median that it exceeds), `reason`.
    """
    found = np.asarray(l2_bounds) / np.sqrt([2.0 * max(block.samples, 1) for block in blocks])
    measured, names = np.asarray(measured, float), np.array([block.ms_name for block in blocks])
    doubtful = []
    for j in range(len(blocks)):
        others = np.arange(len(blocks)) != j
        alike = others & (names == names[j])
        if alike.sum() < 2:
            alike = others
        for level, those, reason in ((measured, others, "thermal noise"), (found, alike, "errors")):
            reference = np.nanmedian(level[those]) if np.isfinite(level[those]).any() else np.nan
            if level[j] > FAR_ABOVE * reference and level[j] > FAR_ABOVE_WEIGHTS:
                doubtful.append(dict(block=j, noise_found=float(found[j]), noise_measured=float(measured[j]),
                                     others=float(reference), reason=reason))
                break
    return doubtful


def named_suspects(blocks, doubtful):
    """Yield a line for the log about each of the `suspects`."""
    for one in doubtful:
        level = one["noise_measured"] if one["reason"] == "thermal noise" else one["noise_found"]
        yield (f"suspect data: block {one['block']}, {blocks[one['block']].label}: its {NAMES[one['reason']]} "
               f"{level:#.3g} x MS weights, {level / one['others']:.2g} times the median of the other blocks. The "
               "reconstruction allows for that; flag these data if they are bad")


def beyond_baselines(model, cell_rad, shortest):
    """Warn where the model holds a source that is too large for the shortest baseline.

    A Gaussian of FWHM θ = 0.6/u has 28 % of its flux at the baseline u (exp(−(0.6π)²/4 ln 2)): of what is larger the
    data see less than that, and what the image has of it comes from the prior. Sources are the connected regions
    of the model, smoothed by θ/4, above 5 % of its peak, which hold 20 % of the flux at least; the size of one is 2.355
    times its smaller standard deviation, so that one that is narrow in some direction passes. Pixels are summed to bins
    of a fifth of the smoothing's standard deviation first.

    Parameters
    ----------
    model : real (nx, ny), Jy/pixel
        Jy/pixel.
    cell_rad : (float, float)
        Pixel size in radians.
    shortest : float
        Shortest projected baseline in wavelengths.

    Returns
    -------
    list of at most one str
    """
    largest = SEEN / shortest
    smoothing = largest / 4 / FWHM
    bins = [max(1, int(smoothing / cell / BINS)) for cell in cell_rad]
    cell_rad = [cell * size for cell, size in zip(cell_rad, bins)]
    bright = np.abs(model)
    for axis, size in enumerate(bins):
        bright = np.add.reduceat(bright, np.arange(0, bright.shape[axis], size), axis=axis)
    smooth = gaussian_filter(bright, [smoothing / cell for cell in cell_rad], mode="constant")
    labels, count = label(smooth > LOWEST * smooth.max()) if bright.any() else (None, 0)
    for number in range(1, count + 1):
        pixels = np.nonzero(labels == number)
        flux = bright[pixels].astype(float)
        if flux.sum() >= MAIN * bright.sum(dtype=float):
            place = np.array([cell * axis for cell, axis in zip(cell_rad, pixels)])
            size = FWHM * np.sqrt(np.linalg.eigvalsh(np.cov(place, aweights=flux, ddof=0))[0])
            if size > largest:
                arcsec = np.degrees([size, largest]) * 3600
                return [f"the shortest baseline is sensitive to scales up to {arcsec[1]:.3g} arcsec (0.6 of its "
                        f"fringe), but the image holds a source of {arcsec[0]:.3g} arcsec: its total flux is not "
                        "measured by these data; add data with shorter baselines"]
    return []


def image_limits(data, grid, comm=SERIAL):
    """Return warnings about this image plane and these baselines; raise where no image can be made of them."""
    notes = []
    reach = [[comm.largest(longest)] for longest in data.reach[:2]]
    max_uv, max_w = comm.largest(data.max_uv), comm.largest(data.max_w)
    check_cell(np.array(reach), grid.cell_rad)
    check_field(max_uv, grid.shape, grid.cell_rad)
    arcsec = np.degrees(grid.cell_rad[0]) * 3600
    pixels = 1 / (max_uv * max(grid.cell_rad))
    if pixels < FEWEST_PIXELS:
        notes.append(f"cell = '{arcsec:.4g}arcsec' gives the finest fringe {pixels:.2g} pixels: below "
                     f"{FEWEST_PIXELS:g} sources between pixels cannot be represented; 5 would be cell = "
                     f"'{arcsec * pixels / 5:.3g}arcsec'")
    if grid.is_mosaic:
        return notes + w_note(max_w, grid.mosaic, LARGEST_W_PHASE)
    return notes + without_w_term(max_w, grid)


def without_w_term(max_w, grid, image="this image"):
    """Return the warning about a w-term that is not modelled where it matters, for a largest |w| in wavelengths."""
    phase = np.pi * max_w * 0.25 * sum((n * cell) ** 2 for n, cell in zip(grid.shape, grid.cell_rad))
    if phase <= LARGEST_W_PHASE or grid.gridder != "standard":
        return []
    return [f"the w-term is not modelled: it changes phases by up to {phase:.2g} rad in the corners of {image}; "
            "gridder = 'wproject' models it"]


def nowhere_visible(grid, output):
    """Return the warning about an image whose pixels are masked everywhere."""
    return (f"phasecenter = '{grid.phasecenter}': the primary beam is below pblimit = {output.pblimit:g} in the whole "
            "image, so all of its pixels are masked")
