"""The signal-to-noise ratio of emission at every place and of every size: matched filters.

A source of shape q in data whose other sources x_far are known has the signal-to-noise ratio

    T = ⟨q, Φ†Σ⁻¹(y − Φx_far)⟩ / ‖Σ^{−½}Φq‖,

normal with unit variance where there is nothing but noise.  q is a Gaussian around a pixel.  Near the pixel is where
the response K = Φ†Σ⁻¹Φq is above a fraction of its peak; with x_far the model beyond that,

    T = [q ⊛ Φ†Σ⁻¹(y − Φx) + (K where near) ⊛ x] / ‖Σ^{−½}Φq‖:

what is left in the residual and what the model holds nearby, whatever noise the model has been fitted to.

A template that reaches over the edge of the image is cut there, and then sees noise of baselines that average it away
where it is whole: where ‖Σ^{−½}Φq‖ of the cut one is larger, T is divided by that.
"""

from __future__ import annotations

import numpy as np
from scipy import fft
from scipy.ndimage import label

from casa_sara.solver.convolution import convolve_valid

__all__ = ["MatchedFilter", "distance", "gaussian"]

BEAMS = (0.0, 1.0, 2.0, 4.0, 8.0)  # widths (FWHM) of the templates, in beams
LARGEST = 0.25  # width of a template, of the shorter side of the image
NEAR, NEAR_WIDE = 0.3, 0.05  # of the peak of the response of a point, and of wider templates
LEAST_SIDELOBE, MOST_SIDELOBE, MARGIN = 0.25, 0.9, 1.2  # what sidelobes are taken for, and over the largest there is
SQUARE = 1.5  # half the side of what is kept of a response, in widths of template and beam together
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
        FWHM of the natural beam, of a circle of the same area, pixels; without the plateau under it that baselines
        leave which do not resolve the image, as those between the telescopes of one site.
    widths : list of float
        FWHM of the templates, pixels; the first is 0, a point.
    sidelobe : float
        Fraction of a source that another peak must exceed not to be one of its sidelobes.
    """

    def __init__(self, psf: np.ndarray, workers: int = 1) -> None:
        self.psf, self.shape, self._workers = psf, psf.shape, workers
        self._plateau = max(float(psf.mean()), 0.0)
        self.beam = _beam(psf - self._plateau)
        self.widths = [width * self.beam for width in BEAMS if width * self.beam <= LARGEST * min(psf.shape)]
        self._padded = [fft.next_fast_len(int(n + 2 * (self.widths[-1] + self.beam)), real=True) for n in psf.shape]
        self._known: dict[int, tuple] = {}
        self._cut: dict[int, list] = {}
        outside = np.where(self._near(psf, NEAR_WIDE), 0, psf).max() / psf[_centre(psf)]
        self.sidelobe = float(np.clip(MARGIN * outside, LEAST_SIDELOBE, MOST_SIDELOBE))

    def norm(self, scale: int) -> float:
        """‖Σ^{−½}Φq‖ of template number `scale`.

        Parameters
        ----------
        scale : int
            Number of the template, 0 for a point.

        Returns
        -------
        float
        """
        return self._response(scale)[0]

    def snr(self, gradient: np.ndarray, scale: int) -> np.ndarray:
        """Return T of template number `scale` for the residual, real (nx, ny).

        Parameters
        ----------
        gradient : complex
            :meth:`spectrum` of Φ†Σ⁻¹(y − Φx).
        scale : int
            Number of the template, 0 for a point.

        Returns
        -------
        real (nx, ny)
        """
        found = gradient * self._template(self.widths[scale])
        return self._per_noise(self._image(found), scale)

    def nearby(self, model: np.ndarray, scale: int) -> np.ndarray:
        """Return what a model near each pixel adds to T of template number `scale`, real (nx, ny).

        Parameters
        ----------
        model : real (nx, ny)
            x, or that part of it which is not to be taken as known.
        scale : int
            Number of the template, 0 for a point.

        Returns
        -------
        real (nx, ny)
        """
        near = self._response(scale)[1]
        half = [n // 2 for n in near.shape]
        kernel = np.zeros(self._padded, np.float32)
        kernel[:near.shape[0], :near.shape[1]] = near
        spectrum = fft.rfft2(np.roll(kernel, [-h for h in half], (0, 1)), workers=self._workers, overwrite_x=True)
        spectrum *= self.spectrum(model)
        return self._per_noise(self._image(spectrum), scale)

    def _per_noise(self, image, scale):
        """Divide by ‖Σ^{−½}Φq‖ of the template around each pixel, in place."""
        image /= np.float32(self.norm(scale))
        if self.widths[scale]:
            x, y = self._edges(scale)
            image /= x[:, None]
            image /= y[None, :]
        return image

    def _edges(self, scale):
        """What the edges make of ‖Σ^{−½}Φq‖, as factors for every column and row; never below 1."""
        if scale not in self._cut:
            self._cut[scale] = [_cut_norms(psf, self.widths[scale]) for psf in (self.psf, self.psf.T)]
        return self._cut[scale]

    def _response(self, scale):
        """‖Σ^{−½}Φq‖, and K of a template where it is near, in a square around its middle."""
        if scale not in self._known:
            width = self.widths[scale]
            half = min(int(np.ceil(SQUARE * (width + self.beam))), (min(self._padded) - 1) // 2)
            psf = _square(self.psf, 2 * half)
            response = convolve_valid(psf, gaussian(half, width)) if width else _square(psf, half)
            norm_sq = float(np.vdot(response, gaussian(half, width)))
            norm = np.sqrt(norm_sq) if norm_sq > 0 else np.inf  # where no baseline sees the template, T is 0
            near = np.where(self._near(response, NEAR_WIDE if width else NEAR), response, 0)
            self._known[scale] = norm, near.astype(np.float32)
        return self._known[scale]

    def _near(self, response, fraction):
        """The disc around the centre, to where the response, averaged over circles, falls below a fraction of its peak.

        Above the plateau of baselines that see the whole image as a point.
        """
        radius = distance(response.shape)
        ring = radius.astype(np.int32).ravel()
        least = self._plateau + fraction * (response[_centre(response)] - self._plateau)
        below = np.flatnonzero(np.bincount(ring, response.ravel()) < least * np.bincount(ring))
        return radius < (below[0] if below.size else max(response.shape))

    def spectrum(self, image: np.ndarray) -> np.ndarray:
        """Return what :meth:`snr` takes for an image (nx, ny).

        Parameters
        ----------
        image : real (nx, ny)
            The image to transform.

        Returns
        -------
        complex, of the padded image
        """
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


def _centre(image):
    return tuple(n // 2 for n in image.shape)


def _beam(psf):
    """FWHM of a circle as large as what is above half of the peak."""
    labels = label(psf > 0.5 * psf[_centre(psf)])[0]
    return float(2 * np.sqrt(np.count_nonzero(labels == labels[_centre(psf)]) / np.pi))


def _square(image, half):
    """The square of 2 half + 1 pixels around the centre, zeros beyond the image."""
    centre = _centre(image)
    padded = np.pad(image, half) if min(image.shape) <= 2 * half + 1 else image
    centre = [c + half * (padded is not image) for c in centre]
    return padded[tuple(slice(c - half, c + half + 1) for c in centre)]


def gaussian(half: int, width: float) -> np.ndarray:
    """A Gaussian of unit sum in a square of 2 half + 1 pixels; a pixel of 1 where the width is 0.

    Parameters
    ----------
    half : int
        The image has 2·half + 1 pixels along each axis.
    width : float
        FWHM in pixels; 0 for a point.

    Returns
    -------
    float64 (2·half + 1, 2·half + 1)
    """
    if not width:
        return (distance((2 * half + 1,) * 2) == 0).astype(float)
    values = np.exp(-0.5 * (distance((2 * half + 1,) * 2) * SIGMA_TO_FWHM / width) ** 2)
    return values / values.sum()


def distance(shape: tuple[int, int]) -> np.ndarray:
    """Distance of each pixel from that in the middle.

    Parameters
    ----------
    shape : (int, int)
        Of the image.

    Returns
    -------
    float64 (nx, ny)
        Pixels.
    """
    return np.hypot(*np.ogrid[tuple(slice(-(n // 2), n - n // 2) for n in shape)])


def _cut_norms(psf, width):
    """‖Σ^{−½}Φq‖ of a Gaussian cut by the edges of the first axis, over that of a whole one, at least 1: float32 (nx,).

    q is a product a(x) b(y), so that ‖·‖² = Σ a(x) a(x′) p(x − x′), with p the response summed over y as b asks for.
    """
    nx, ny = psf.shape
    half = min(int(np.ceil(SQUARE * width)), nx - 1)
    a = np.exp(-0.5 * (np.arange(-half, half + 1) * SIGMA_TO_FWHM / width) ** 2)
    b = np.exp(-0.25 * ((np.arange(ny) - ny // 2) * SIGMA_TO_FWHM / width) ** 2)  # the autocorrelation of b(y)
    p = np.zeros(4 * half + 1)
    lags = np.arange(nx) - nx // 2
    seen = np.abs(lags) <= 2 * half
    p[lags[seen] + 2 * half] = (psf @ b)[seen]
    products = np.outer(a, a) * p[np.subtract.outer(np.arange(a.size), np.arange(a.size)) + 2 * half]
    # the first k pixels of the template are what an edge leaves of it
    norms_sq = np.diagonal(np.cumsum(np.cumsum(products, axis=0), axis=1))
    ratio = np.sqrt(np.maximum(norms_sq[half:] / norms_sq[-1], 1)) if norms_sq[-1] > 0 else np.ones(half + 1)
    factors = np.ones(nx, np.float32)
    inside = np.minimum(np.arange(nx), np.arange(nx)[::-1])
    near = inside <= half
    factors[near] = ratio[inside[near]]
    return factors
