"""Images of unknown spectra: the frequencies at which the sky is solved for, and the spectral index that follows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from casa_sara.analysis.metrics import beam_pixels, smooth
from casa_sara.casa.images.sky_image import beam_numbers
from casa_sara.casa.images.spectral_index import reference_hz
from casa_sara.casa.runtime import log
from casa_sara.operators.subbands import Subbands

__all__ = ["LARGEST_ERROR", "divided_by_band", "seen_draws", "spectral_images", "spectral_index", "with_subbands"]

ARCSEC = np.radians(1 / 3600)
FEWEST = 200  # samples of a block, whose noise level they give to 4 %
NARROWEST = 1e-3  # band of which spectra may be solved for
BEYOND = 0.05  # of the band, where a reference frequency may still be
LARGEST_ERROR = 0.3  # of a spectral index that is not masked


def with_subbands(grid, data, plane):
    """Return the grid with the frequencies at which the sky is solved for.

    Parameters
    ----------
    grid : casa_sara.options.ImageGrid
        With `nterms`.
    data : Visibilities
        With `freq_hz`.
    plane : ImagePlane
        The frequency on its spectral axis is that of the model.

    Returns
    -------
    casa_sara.options.ImageGrid

    Raises
    ------
    ValueError
        The data have too few frequencies, their band is too narrow, or the reference frequency is not in it.
    """
    if grid.nterms == 1:
        return grid
    subbands = Subbands.of(data.freq_hz, data.weight, grid.nterms, reference_hz(plane))
    low, high = subbands.band_hz
    if high < (1 + NARROWEST) * low:
        raise ValueError(f"nterms = {grid.nterms}: the data span {100 * (high / low - 1):.2g} % in frequency, which "
                         "shows no spectrum; should be 1")
    if not low <= (1 + BEYOND) * subbands.reference_hz <= (1 + BEYOND) ** 2 * high:
        raise ValueError(f"reffreq = '{grid.reffreq}' with nterms = {grid.nterms}: the data are at {low / 1e9:.5g} to "
                         f"{high / 1e9:.5g} GHz, beyond which no spectrum is known; should be between these")
    listed = ", ".join(f"{freq / 1e9:.5g}" for freq in subbands.freqs_hz)
    log.info(f"nterms = {grid.nterms}: the sky is solved for at {listed} GHz, the model is that at "
             f"{subbands.reference_hz / 1e9:.5g} GHz")
    return replace(grid, subbands=subbands)


def divided_by_band(block_of_sample, infos, data, subbands):
    """Divide blocks by the parts of the band, so that each has noise levels of its own, unless one had few samples.

    Parameters
    ----------
    block_of_sample : int (M,)
        Number of the block of each sample.
    infos : list of d BlockInfo
        The blocks.
    data : Visibilities
        The samples.
    subbands : Subbands or None
        None for blocks that stay as they are.

    Returns
    -------
    block_of_sample, infos
    """
    if subbands is None:
        return block_of_sample, infos
    number = block_of_sample * subbands.n_terms + subbands.band_of(data.freq_hz)
    parts = np.bincount(number, minlength=len(infos) * subbands.n_terms).reshape(-1, subbands.n_terms)
    whole = np.where(parts > 0, parts, FEWEST).min(axis=1) < FEWEST
    number = np.where(whole[block_of_sample], block_of_sample * subbands.n_terms, number)
    found, block_of_sample, samples = np.unique(number, return_inverse=True, return_counts=True)
    divided = []
    for one, size, part in zip(found, samples, np.split(np.argsort(block_of_sample, kind="stable"),
                                                        np.cumsum(samples)[:-1])):
        freqs = data.freq_hz[part]
        divided.append(replace(infos[one // subbands.n_terms], samples=int(size),
                               band_hz=(float(freqs.min()), float(freqs.max()))))
    return block_of_sample, divided


def spectral_images(found, grid, data, beam):
    """Return the model at the frequencies that were solved for, and the spectral index of it smoothed to a beam.

    Parameters
    ----------
    found : Reconstruction
        With `spectra`.
    grid : casa_sara.options.ImageGrid
        With `subbands`.
    data : Visibilities
        The samples; of a mosaic the noise follows from their primary beams.
    beam : dict
        Of the restored image.

    Returns
    -------
    dict
        As :func:`casa_sara.casa.images.products.write_products` takes them: 'alpha', 'alpha.error', 'known',
        'subbands' and 'freqs_hz'.
    """
    *axes, angle = beam_numbers(beam)
    cell = tuple(size / ARCSEC for size in grid.cell_rad)
    seen = beam_pixels(axes, cell) * np.array([smooth(plane, axes, angle, cell) for plane in found.spectra])
    noise = found.noise_jy_per_beam
    if grid.is_mosaic:
        noise = noise * _noise_of_sky(grid, data)
    index, error, known = spectral_index(seen, grid.subbands, noise)
    return {"alpha": index, "alpha.error": error, "known": known, "subbands": found.spectra,
            "freqs_hz": grid.subbands.freqs_hz}


def _noise_of_sky(grid, data):
    """Return the noise of the sky at each frequency in units of that of the image of flat noise, float32 (T, nx, ny).

    As that of a single pointing it is to be divided by the root of the share of the frequency. It is infinite where
    nothing is modelled.
    """
    mosaic = grid.mosaic
    seen = mosaic.sensitivity(mosaic.sums(data.beam, data.weight))
    at_each = np.array([mosaic.power(mosaic.sums(data.beam, data.weight * np.square(factor)))
                        for factor in grid.subbands.factors(data.freq_hz)])
    at_each = np.sqrt(at_each / np.float32(data.weight.sum(dtype=float))) * (seen > 0)
    return np.divide(seen.max(), at_each, out=np.full_like(at_each, np.inf), where=at_each > 0)


def spectral_index(seen, subbands, noise):
    """Fit I(ν) ∝ ν^α to the brightness at several frequencies, weighted by its S/N.

    Parameters
    ----------
    seen : real (T, nx, ny)
        Brightness, Jy/beam.
    subbands : Subbands
        Their frequencies, and the shares of the data that they stand for.
    noise : float, or (T, nx, ny)
        Of an image of all data, Jy/beam; that of one frequency is this over the root of its share.

    Returns
    -------
    index, error : float32 (nx, ny)
        0 where it is not known.
    known : bool (nx, ny)
        Where the brightness is positive, and the error at most `LARGEST_ERROR`.
    """
    place = np.log(subbands.freqs_hz / subbands.reference_hz)[:, None, None]
    good = ((seen > 0) & np.isfinite(noise)).all(axis=0)
    brightness = np.where(good, seen, 1.0)
    weight = np.where(good, subbands.shares[:, None, None] * (brightness / noise) ** 2, 1.0)
    total = weight.sum(axis=0)
    offset = place - (weight * place).sum(axis=0) / total
    spread = (weight * offset**2).sum(axis=0)
    index = (weight * offset * np.log(brightness)).sum(axis=0) / spread
    error = spread**-0.5
    known = good & (error <= LARGEST_ERROR)
    return *(np.where(known, image, 0).astype(np.float32) for image in (index, error)), known


def seen_draws(found, grid):
    """Return the draws of bootstrap and jackknife of a reconstruction: of several frequencies, at the reference."""
    drawn = found.draws, found.jackknife
    if grid.subbands is None:
        return drawn
    weights = grid.subbands.reference_weights().astype(np.float32)

    def at_reference(stacked):
        return np.tensordot(weights, stacked.reshape(weights.size, -1, stacked.shape[-1]), 1)

    return tuple(one and one.seen(at_reference) for one in drawn)
