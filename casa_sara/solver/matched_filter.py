"""The signal-to-noise ratio of emission at every place and of every size: matched filters.

A source of shape q in data whose other sources x_far are known has the signal-to-noise ratio

    T = ⟨q, Φ†Σ⁻¹(y − Φx_far)⟩ / ‖Σ^{−½}Φq‖,

normal with unit variance where there is nothing but noise.  q is a Gaussian around a pixel.  Near the pixel is where the
response K = Φ†Σ⁻¹Φq is above a fraction of its peak; with x_far the model beyond that,

    T = [q ⊛ Φ†Σ⁻¹(y − Φx) + (K where near) ⊛ x] / ‖Σ^{−½}Φq‖:

what is left in the residual and what the model holds nearby, whatever noise the model has been fitted to.
"""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.ndimage import label

__all__ = ["MatchedFilter"]

BEAMS = (0.0, 1.0, 2.0, 4.0, 8.0)  # widths (FWHM) of the templates, in beams
LARGEST = 0.25  # width of a template, of the shorter side of the image
NEAR, NEAR_WIDE = 0.3, 0.05  # of the peak of the response of a point, and of wider templates
LEAST_SIDELOBE, MOST_SIDELOBE, MARGIN = 0.25, 0.9, 1.2  # what sidelobes are taken for, and over the largest there is
SIGMA_TO_FWHM = np.sqrt(8 * np.log(2))


class MatchedFilter:
    """Images of the signal-to-noise ratio.

    Parameters
    ----------
    psf : real (nx, ny)
        Φ†Σ⁻¹Φ of a pixel of 1 at (nx // 2, ny // 2).
    workers : int
        Threads.

    Attributes
    ----------
    beam : float
        FWHM of the natural beam, of a circle of the same area, pixels.
    widths : list of float
        FWHM of the templates, pixels; the first is 0, a point.
    sidelobe : float
        Fraction of a source that another peak must exceed not to be one of its sidelobes.
    """

    def __init__(self, psf, workers=1):
        self.psf, self.shape, self._workers = psf, psf.shape, workers
        self._centre = tuple(n // 2 for n in psf.shape)
        self.beam = _beam(psf, self._centre)
        self.widths = [width * self.beam for width in BEAMS if width * self.beam <= LARGEST * min(psf.shape)]
        self._padded = [fft.next_fast_len(int(n + 2 * (self.widths[-1] + self.beam)), real=True) for n in psf.shape]
        self._psf_spectrum = self._spectrum(psf)
        outside = np.where(self._near(psf, NEAR_WIDE), 0, psf).max() / psf[self._centre]
        self.sidelobe = float(np.clip(MARGIN * outside, LEAST_SIDELOBE, MOST_SIDELOBE))

    def norm(self, scale):
        """‖Σ^{−½}Φq‖ of template number `scale`."""
        transfer = self._template(self.widths[scale])
        return float(np.sqrt(self._image(self._psf_spectrum * transfer * transfer)[self._centre]))

    def spectrum(self, image):
        """Return what :meth:`snr` takes for an image (nx, ny)."""
        return self._spectrum(image)

    def snr(self, gradient, scale, model=None):
        """Return T of template number `scale`, real (nx, ny).

        Parameters
        ----------
        gradient : complex
            :meth:`spectrum` of Φ†Σ⁻¹(y − Φx).
        scale : int
        model : real (nx, ny), optional
            x, or that part of it which is not to be taken as known; without it, T of the residual.
        """
        template = self._template(self.widths[scale])
        found = gradient * template
        if model is not None:
            response = self._image(self._psf_spectrum * template)
            response[~self._near(response, NEAR_WIDE if scale else NEAR)] = 0
            near = np.zeros(self._padded, np.float32)
            near[:self.shape[0], :self.shape[1]] = response
            near = fft.rfft2(np.roll(near, [-c for c in self._centre], (0, 1)), workers=self._workers)
            near *= self._spectrum(model)
            found += near
        return self._image(found) / np.float32(self.norm(scale))

    def _spectrum(self, image):
        padded = np.zeros(self._padded, np.float32)
        padded[:self.shape[0], :self.shape[1]] = image
        return fft.rfft2(padded, workers=self._workers, overwrite_x=True)

    def _image(self, spectrum):
        return fft.irfft2(spectrum, s=self._padded, workers=self._workers)[:self.shape[0], :self.shape[1]]

    def _template(self, width):
        """Transfer function of a Gaussian of unit sum."""
        kx, ky = np.fft.fftfreq(self._padded[0]), np.fft.rfftfreq(self._padded[1])
        decay = -2 * (np.pi * width / SIGMA_TO_FWHM) ** 2
        return np.exp(decay * kx**2).astype(np.float32)[:, None] * np.exp(decay * ky**2).astype(np.float32)

    def _near(self, response, fraction):
        """The disc around the centre out to where the response, averaged over circles, falls below a fraction."""
        distance = np.hypot(*np.ogrid[tuple(slice(-c, n - c) for c, n in zip(self._centre, self.shape))])
        ring = distance.astype(np.int32).ravel()
        below = np.flatnonzero(np.bincount(ring, response.ravel()) < fraction * response[self._centre] * np.bincount(ring))
        return distance < (below[0] if below.size else max(self.shape))


def _beam(psf, centre):
    """FWHM of a circle as large as what is above half of the peak."""
    labels = label(psf > 0.5 * psf[centre])[0]
    return float(2 * np.sqrt(np.count_nonzero(labels == labels[centre]) / np.pi))
