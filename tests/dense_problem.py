"""A small imaging problem of dense matrices, for tests of the solver."""

from dataclasses import dataclass, field

import numpy as np
import pywt

from casa_sara.operators._workers import Workers


class DenseMeasurement:
    """Φ as a matrix (M, nx·ny)."""

    def __init__(self, matrix, shape):
        self.matrix, self.shape, self.workers = matrix, shape, Workers(1)

    def forward(self, image, out=None):
        out = np.empty(len(self.matrix), complex) if out is None else out
        out[...] = self.matrix @ image.ravel()
        return out

    def adjoint(self, vis, out=None):
        out = np.empty(self.shape) if out is None else out
        out[...] = (self.matrix.conj().T @ vis).real.reshape(self.shape)
        return out


@dataclass
class DenseBand:
    slice: tuple

    def of(self, coefs):
        return coefs[self.slice]


class DenseDictionary:
    """Pixels and Haar wavelets of one and two levels as one matrix Ψ† of (b·n, n), scaled to a Parseval frame."""

    def __init__(self, shape, levels=(1, 2)):
        unit = np.eye(shape[0] * shape[1]).reshape(-1, *shape)
        bases = [unit.reshape(len(unit), -1)]
        for level in levels:
            coefs = [pywt.coeffs_to_array(pywt.wavedec2(image, "db1", "periodization", level))[0] for image in unit]
            bases.append(np.reshape(coefs, (len(unit), -1)))
        self.n_bases, self.shape = len(bases), shape
        self.matrix = np.hstack(bases).T / np.sqrt(len(bases))

    def allocate(self):
        return np.zeros(len(self.matrix))

    def bands(self):
        size = self.matrix.shape[1]
        return [DenseBand(slice(b * size, (b + 1) * size)) for b in range(self.n_bases)]

    def analysis(self, image, out=None):
        out = self.allocate() if out is None else out
        out[...] = self.matrix @ image.ravel()
        return out

    def dual_step(self, model_bar, dual, threshold, weights=None, out=None, relaxation=1.0):
        limit = threshold * (1.0 if weights is None else weights)
        dual += relaxation * (np.clip(dual + self.matrix @ model_bar.ravel(), -limit, limit) - dual)
        out[...] = (self.matrix.T @ dual).reshape(self.shape)
        return out

    def reweight(self, image, alpha, scale, out):
        for band, value, factor in zip(self.bands(), alpha, scale):
            out[band.slice] = factor * value / (value + np.abs(self.matrix[band.slice] @ image.ravel()))
        return out


@dataclass
class Problem:
    """y = Φx + n in two blocks, whitened noise of variance 1 in Re and Im."""

    seed: int = 0
    shape: tuple = (4, 4)
    samples: tuple = (9, 12)
    noise: tuple = (0.05, 0.05)
    measurement: DenseMeasurement = field(init=False)

    def __post_init__(self):
        rng = np.random.default_rng(self.seed)
        size, total = self.shape[0] * self.shape[1], sum(self.samples)
        matrix = rng.normal(size=(total, size)) + 1j * rng.normal(size=(total, size))
        self.offsets = np.concatenate([[0], np.cumsum(self.samples)])
        # rows of very different norm, as whitened visibilities of an uneven density
        self.precond = 10 ** rng.uniform(-2, 0, total)
        matrix *= (self.precond[:, None] ** -0.5) * 0.3
        self.truth = np.zeros(self.shape)
        self.truth.flat[rng.choice(size, 3, replace=False)] = rng.uniform(1, 3, 3)
        self.measurement = DenseMeasurement(matrix, self.shape)
        self.dictionary = DenseDictionary(self.shape)
        scale = np.repeat(self.noise, self.samples)
        error = scale * (rng.normal(size=total) + 1j * rng.normal(size=total))
        self.vis = matrix @ self.truth.ravel() + error
        self.errors = np.array([np.linalg.norm(error[a:b]) for a, b in zip(self.offsets[:-1], self.offsets[1:])])

    def data_norm_sq(self, precond):
        weighted = np.sqrt(precond)[:, None] * self.measurement.matrix
        stacked = np.vstack([weighted.real, weighted.imag])
        return np.linalg.norm(stacked, 2) ** 2
