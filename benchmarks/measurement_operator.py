"""Time one forward and one adjoint transform, of this package's operator and of the libraries it could be built on.

    python benchmarks/measurement_operator.py [--threads 2] [--repeats 7] [--cases 3]

Prints a Markdown table: median and half the interquartile range in milliseconds, ratio to the operator at 1e-5, and the
relative error on 200 of the visibilities against the explicit Fourier sum.  In each repetition every contestant runs
once, so that they share whatever else the machine does.  The floor is the time to move the bytes that both transforms
must touch (image, grid, points and visibilities, once each) at the bandwidth measured in the same run.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import ducc0
import finufft
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

from machine import bandwidth, machine

from casa_sara.operators._decimation_kernels import decimate, expand, expand_rows, scratch_shape
from casa_sara.operators._workers import Workers
from casa_sara.operators.decimation import AxisDecimation, separable
from casa_sara.operators.measurement import MeasurementOperator

CASES = [(512, 256, 100_000), (1024, 1024, 100_000), (1024, 1024, 1_000_000), (2048, 2048, 1_000_000),
         (4096, 2048, 2_000_000)]
ARMS_M = (21e3, 6.4e3, 1.95e3, 0.6e3)  # lengths of the arms in the A, B, C and D configurations


def vla_uv(size, declination=np.deg2rad(40.7), latitude=np.deg2rad(34.08), freq_hz=8.4e9, channels=4):
    """(2, ~size) wavelengths: 8 h tracks of a Y-shaped array in four configurations, four channels."""
    parts = []
    a, b = np.triu_indices(27, 1)
    freq = freq_hz + 16e6 * np.arange(channels)
    for arm in ARMS_M:
        radius = arm * (np.arange(1, 10) / 9) ** 1.716
        azimuth = np.deg2rad([[355], [115], [236]])
        east, north = (radius * np.sin(azimuth)).ravel(), (radius * np.cos(azimuth)).ravel()
        x, y, z = -np.sin(latitude) * north, east, np.cos(latitude) * north
        x, y, z = x[a] - x[b], y[a] - y[b], z[a] - z[b]
        n_times = max(1, round(size / (len(ARMS_M) * a.size * channels)))
        hour = np.linspace(-np.pi / 3, np.pi / 3, n_times)[:, None]
        u = np.sin(hour) * x + np.cos(hour) * y
        v = np.sin(declination) * (np.sin(hour) * y - np.cos(hour) * x) + np.cos(declination) * z
        parts.append((np.stack([u, v])[..., None] * freq / 299792458.0).reshape(2, -1))
    return np.concatenate(parts, axis=1)


class Finufft:
    """finufft on the whole image."""

    def __init__(self, uv, cell, shape, eps, dtype, nthreads, **options):
        self.plan = finufft.Plan(2, shape, isign=1, eps=eps, dtype=np.result_type(dtype, "c8").name, nthreads=nthreads,
                                 showwarn=0, **options)
        self.plan.setpts((-2 * np.pi * cell * uv[0]).astype(dtype), (2 * np.pi * cell * uv[1]).astype(dtype))
        self.modes = np.zeros(shape, np.result_type(dtype, "c8"))
        self.vis, self.dtype = np.zeros(uv.shape[1], self.modes.dtype), np.dtype(dtype)

    def forward(self, image, out):
        self.modes[...] = image
        self.transform()
        out[...] = self.vis

    def adjoint(self, vis, out):
        self.vis[...] = vis
        self.transpose()
        out[...] = self.modes.real

    def transform(self):
        self.plan.execute(self.modes, self.vis)

    def transpose(self):
        self.plan.execute_adjoint(self.vis, self.modes)


class Ducc(Finufft):
    """ducc0.nufft on the whole image."""

    def __init__(self, uv, cell, shape, eps, dtype, nthreads):
        points = np.stack([-2 * np.pi * cell * uv[0], 2 * np.pi * cell * uv[1]], axis=1)
        self.plan = ducc0.nufft.plan(nu2u=False, coord=points.astype(dtype), grid_shape=shape, epsilon=eps,
                                     nthreads=nthreads)
        self.modes = np.zeros(shape, np.result_type(dtype, "c8"))
        self.vis, self.dtype = np.zeros(uv.shape[1], self.modes.dtype), np.dtype(dtype)

    def transform(self):
        self.plan.u2nu(grid=self.modes, out=self.vis, forward=False)

    def transpose(self):
        self.plan.nu2u(points=self.vis, out=self.modes, forward=True)


def decimated(engine):
    """The same engine behind this package's decimation."""

    class Decimated(engine):
        def __init__(self, uv, cell, shape, eps, dtype, nthreads, **options):
            frequencies = uv * cell * [[-1], [1]]
            sign = np.where(frequencies[1] < 0, -1, 1)
            frequencies = frequencies * sign
            reach = np.abs(frequencies[0]).max()
            self.axes = [AxisDecimation(shape[0], (-reach, reach), eps, 1e-7),
                         AxisDecimation(shape[1], (0, frequencies[1].max()), eps, 1e-7)]
            inner = np.stack([axis.factor * (f - axis.centre) for axis, f in zip(self.axes, frequencies)])
            counts = tuple(axis.count for axis in self.axes)
            super().__init__(inner * [[-1], [1]], 1.0, counts, eps, dtype, nthreads, **options)
            offset = [axis.start + count // 2 for axis, count in zip(self.axes, counts)]
            response = self.axes[0].response(frequencies[0]) * self.axes[1].response(frequencies[1])
            self.scale = (np.exp(2j * np.pi * (inner.T @ offset)) / response).astype(self.vis.dtype)
            self.sign, self.workers = sign, Workers(nthreads)
            self.rows, self.columns = (
                separable(axis, size, np.arange(axis.count), np.ones(axis.count), self.vis.dtype)
                for axis, size in zip(self.axes, shape))
            self.lines = np.zeros((counts[0], shape[1]), dtype)
            self.scratch = np.zeros(scratch_shape(self.columns, nthreads), dtype)

        def forward(self, image, out):
            self.workers.run(decimate, image, self.rows, self.columns, self.modes, self.lines, self.scratch)
            self.transform()
            np.multiply(self.vis, self.scale, out=out)
            out.imag *= self.sign

        def adjoint(self, vis, out):
            self.vis[...] = vis
            self.vis.imag *= self.sign
            self.vis *= self.scale.conj()
            self.transpose()
            self.workers.run(expand, self.modes, self.rows, self.columns, self.lines, self.scratch)
            self.workers.run(expand_rows, self.lines, self.rows, out)

    return Decimated


def contestants(uv, cell, shape, nthreads):
    common = uv, cell, shape
    yield "this operator, 1e-5", MeasurementOperator(*common, eps=1e-5, nthreads=nthreads)
    yield "this operator, 1e-4", MeasurementOperator(*common, eps=1e-4, nthreads=nthreads)
    yield "decimation + ducc0, single, 1e-5", decimated(Ducc)(*common, 1e-5, "f4", nthreads)
    yield "decimation + finufft, single, 1e-5", decimated(Finufft)(*common, 1e-5, "f4", nthreads, upsampfac=1.25)
    yield "ducc0, single, 1e-5", Ducc(*common, 1e-5, "f4", nthreads)
    yield "finufft, single, 1e-5", Finufft(*common, 1e-5, "f4", nthreads, upsampfac=1.25)
    yield "finufft, double, its default 1e-6", Finufft(*common, 1e-6, "f8", nthreads)


def floor_bytes(operator):
    """Bytes that one forward and one adjoint touch at least."""
    grid = operator._nufft.grid.nbytes
    return 2 * (4 * np.prod(operator.shape) + grid + operator.size * (8 + 4 + 8 + 8 + 8))


def exact(uv, cell, image, sample):
    nx, ny = image.shape
    a = np.exp(-2j * np.pi * cell * np.outer(uv[0, sample], np.arange(nx) - nx // 2))
    b = np.exp(2j * np.pi * cell * np.outer(uv[1, sample], np.arange(ny) - ny // 2))
    return np.sum((a @ image) * b, axis=1)


def run(case, nthreads, repeats, bytes_per_s):
    nx, ny, size = case
    rng = np.random.default_rng(0)
    uv = vla_uv(size)
    cell = 0.2 / np.hypot(*uv).max()  # five pixels per fringe of the longest baseline
    image = rng.uniform(0, 1, (nx, ny)) ** 8
    sample = rng.choice(uv.shape[1], 200)
    truth = exact(uv, cell, image, sample)
    entries = list(contestants(uv, cell, (nx, ny), nthreads))
    times, errors = np.zeros((repeats, len(entries))), []
    buffers = [(image.astype(kind), np.zeros((nx, ny), kind), np.zeros(uv.shape[1], np.result_type(kind, "c8")))
               for kind in [operator.dtype for _, operator in entries]]
    for (_, operator), (x, back, vis) in zip(entries, buffers):
        operator.forward(x, vis)
        operator.adjoint(vis, back)
        errors.append(np.linalg.norm(vis[sample] - truth) / np.linalg.norm(truth))
    for repeat in range(repeats):
        for number, ((_, operator), (x, back, vis)) in enumerate(zip(entries, buffers)):
            start = time.perf_counter()
            operator.forward(x, vis)
            operator.adjoint(vis, back)
            times[repeat, number] = 1e3 * (time.perf_counter() - start)
    median = np.median(times, axis=0)
    spread = np.subtract(*np.percentile(times, [75, 25], axis=0)) / 2
    floor = f"{1e3 * floor_bytes(entries[0][1]) / bytes_per_s:.1f}"
    for number, (name, _) in enumerate(entries):
        floor = floor if number == 0 else ""
        print(f"| {nx}×{ny}, {uv.shape[1]:.2g} | {name} | {median[number]:.1f} ± {spread[number]:.1f} "
              f"| {median[number] / median[0]:.2f} | {errors[number]:.1e} | {'' if number else floor} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--cases", type=int, default=len(CASES))
    options = parser.parse_args()
    bytes_per_s = bandwidth(options.threads, options.repeats)
    print(f"{machine()}, {options.threads} thread(s), copy {bytes_per_s / 1e9:.1f} GB/s, "
          f"finufft {finufft.__version__}, ducc0 {ducc0.__version__}\n")
    print("| image, visibilities | operator | forward + adjoint, ms | ratio | error | floor, ms |")
    print("|---|---|---|---|---|---|")
    for case in CASES[: options.cases]:
        run(case, options.threads, options.repeats, bytes_per_s)


if __name__ == "__main__":
    main()
