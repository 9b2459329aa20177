"""Time and memory of one whole iteration of adaptive PPD, beside the same algorithm on PyWavelets and finufft.

    python benchmarks/iteration.py [--cases 0 1 2 …] [--repeat 15] [--pfb]
    python benchmarks/iteration.py --stages [--repeat 15]   # every stage with one thread and with two

The iteration is that of the task: single precision, Dirac and Db1–Db8 on four levels, weights, over-relaxation, all
blocks through one operator. "PyWavelets + finufft" is the same algorithm (the same class, in double precision) on
wavedec2 and waverec2, the bases shared out to threads, and on finufft with its defaults, one transform for all blocks.
Medians (quartiles); both take turns. The floor: bytes that have to be moved (image-sized and visibility-sized arrays,
coefficients and weights, grid) over the copy bandwidth measured in the same run, or the multiplications and additions
of the wavelet filters over the peak rate, whichever is more. With --pfb the analysis and synthesis of pfb-imaging's
dictionary (from PyPI) are timed too, in double precision as it has them.

With --stages the kernels and FFTs of an iteration are timed one by one, with one thread and with two in turns; the rest
is Python. "wake" is the time of a call of all threads with nothing to do: an iteration has 19 of them.

Memory is that of a process with casatools loaded, above what it takes before, at its peak through operators and
iterations; growth is what is added from the 10th iteration to the last.
"""

from __future__ import annotations

import argparse
import gc
import subprocess
import sys
import time
from collections import defaultdict
from pathlib import Path
from unittest import mock

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))

import finufft
import pywt
from dictionary import PyWaveletsStep, filter_flops
from machine import bandwidth, machine, peak, resident_mb, seconds, spread
from measurement_operator import Finufft, vla_uv

from casa_sara.operators._workers import Workers
from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.runtime.jit import kernel
from casa_sara.solver.adaptive_ppd import RELAXATION, AdaptivePPD

CASES = [(512, 256, 100_000, 12, 1), (512, 256, 100_000, 12, 2), (1024, 1024, 100_000, 12, 1),
         (1024, 1024, 1_000_000, 12, 1), (2048, 2048, 1_000_000, 12, 2), (4096, 2048, 2_000_000, 22, 2)]
STAGED = [(256, 256, 20_000, 12, 2), (1024, 1024, 100_000, 12, 2), (1024, 1024, 1_000_000, 12, 2)]
THRESHOLD = 1e-3


class PyWaveletsDictionary:
    """The prior step of PyWavelets as the solver calls it."""

    def __init__(self, shape, wavelets, nthreads):
        self.step = PyWaveletsStep(shape, wavelets, nthreads, np.float64, THRESHOLD, RELAXATION)

    def allocate(self):
        return np.zeros(0)

    def dual_step(self, model_bar, dual, threshold, weights, out, relaxation):
        out[...] = self.step(model_bar)


class DefaultFinufft(Finufft):
    """finufft with its defaults, in double precision."""

    def __init__(self, uv, cell, shape, nthreads):
        super().__init__(uv, cell, shape, 1e-6, "f8", nthreads)
        self.shape, self.workers = shape, Workers(nthreads)


def visibilities(case):
    """Baselines in wavelengths, pixel size, image, and the offsets of the blocks."""
    nx, ny, size, blocks, _ = case
    uv = vla_uv(size)
    image = np.random.default_rng(0).uniform(0, 1, (nx, ny)).astype(np.float32) ** 8
    return uv, 0.2 / np.hypot(*uv).max(), image, np.linspace(0, uv.shape[1], blocks + 1).astype(int)


def solver(measurement, dictionary, image, offsets):
    """The iteration on one image's visibilities, with every array it has in the task."""
    vis = np.zeros(offsets[-1], np.result_type(image.dtype, np.complex64))
    measurement.forward(image, vis)
    ppd = AdaptivePPD(measurement, dictionary, vis, offsets, np.full(vis.size, 0.5, image.dtype), float(offsets[-1]))
    ppd.threshold, ppd.multipliers[:] = THRESHOLD, 0.1
    return ppd


def ours(case):
    """The iteration as the task has it."""
    uv, cell, image, offsets = visibilities(case)
    shape, nthreads = image.shape, case[4]
    return solver(MeasurementOperator(uv, cell, shape, nthreads=nthreads), SaraDictionary(shape, nthreads=nthreads),
                  image,
                  offsets)


def reference(case, wavelets):
    """The same on PyWavelets and finufft in double precision."""
    uv, cell, image, offsets = visibilities(case)
    return solver(DefaultFinufft(uv, cell, image.shape, case[4]), PyWaveletsDictionary(image.shape, wavelets, case[4]),
                  image.astype(float), offsets)


def floor_seconds(ppd, nthreads, repeat):
    """Least time for the bytes and for the filters' arithmetic of one iteration."""
    pixels, samples = ppd.model.size, ppd.vis.size
    moved = 3 * 4 * ppd.dictionary.n_coefs  # dual read and written, weights read
    # x, z, x̄ read and written; gradients and lower bound; images of the operators
    moved += 4 * pixels * (3 * 2 + 4 + 3)
    moved += 2 * ppd.measurement._nufft.grid.nbytes
    moved += samples * (8 * (2 + 4 + 1) + 4 + 2 * 28)  # Φx̄, Φz, v, y; U; places, scales, order of both ways
    return max(moved / bandwidth(nthreads, repeat),
               filter_flops(ppd.model.shape, ppd.dictionary.wavelets) / peak(nthreads, repeat))


def time_case(case, repeat, slow_repeat):
    """Print a line of the table."""
    nx, ny, size, blocks, nthreads = case
    ppd = ours(case)
    slow = reference(case, ppd.dictionary.wavelets)
    for _ in range(3):
        ppd.step()
    slow.step()
    times = {name: [] for name in ("step", "forward", "adjoint", "dictionary", "reference")}
    for turn in range(repeat):
        times["step"].append(seconds(ppd.step))
        times["forward"].append(seconds(ppd.measurement.forward, ppd.model_bar, ppd._phi_bar))
        times["adjoint"].append(seconds(ppd.measurement.adjoint, ppd.l2_dual, ppd._data_gradient))
        times["dictionary"].append(seconds(ppd.dictionary.dual_step, ppd.model_bar, ppd.l1_dual, THRESHOLD,
                                           ppd.l1_weights,
                                           ppd._prior_gradient, RELAXATION))
        if turn < slow_repeat:
            times["reference"].append(seconds(slow.step))
    middle = {name: np.median(found) for name, found in times.items()}
    floor = floor_seconds(ppd, nthreads, repeat)
    parts = " + ".join(f"{1e3 * middle[name]:.1f}" for name in ("forward", "adjoint", "dictionary"))
    print(f"| {nx}×{ny} | {ppd.vis.size:.3g} in {blocks} | {nthreads} | {spread(times['step'])} | "
          f"{1 / middle['step']:.1f} | {parts} | {spread(times['reference'])} | "
          f"{middle['reference'] / middle['step']:.0f} | {1e3 * floor:.1f} | {middle['step'] / floor:.1f} |",
              flush=True)


def time_calls(ppd):
    """Do one step; return the seconds of each kernel and FFT, of the rest and of all."""
    found, run = defaultdict(float), Workers.run

    def timed(workers, kernel, *arguments, **options):
        begin = time.perf_counter()
        run(workers, kernel, *arguments, **options)
        found[kernel.__name__] += time.perf_counter() - begin

    with mock.patch.object(Workers, "run", timed):
        whole = seconds(ppd.step)
    return found | {"the rest": whole - sum(found.values()), "all": whole}


def time_stages(case, repeat):
    """Print how long every stage of an iteration takes with one thread and with two."""
    ppds, times = [ours((*case[:4], threads)) for threads in (1, 2)], ([], [])
    for turn in range(repeat + 3):
        for ppd, found in zip(ppds, times):
            one = time_calls(ppd)
            if turn >= 3:
                found.append(one)
    nx, ny, size, blocks, _ = case
    print(f"\n{nx}×{ny}, {ppds[0].vis.size:.3g} in {blocks}:\n\n| stage | 1 thread, ms | 2 threads, ms | ratio |\n"
          + "|---" * 4 + "|")
    middle = [{name: 1e3 * np.median([one[name] for one in found]) for name in found[0]} for found in times]
    for name in sorted(middle[0], key=middle[0].get, reverse=True):
        one, two = middle[0][name], middle[1][name]
        print(f"| {name.strip('_')} | {one:.2f} | {two:.2f} | {one / two:.2f} |", flush=True)


def time_waking(repeat):
    """Print how long it takes to call threads that have nothing to do."""
    print("\n| threads | wake, µs |\n|---|---|")
    for threads in (1, 2, 4, 8, 16):
        run = Workers(threads).run
        found = [seconds(lambda: [run(nothing) for _ in range(50)]) / 50 for _ in range(repeat)]
        print(f"| {threads} | {1e6 * np.median(found):.0f} |", flush=True)


@kernel()
def nothing(worker, workers):
    """A kernel without work."""


def measure_memory(case, iterations):
    """Print what operators and iterations take, above a process with casatools."""
    import casatools

    assert casatools.version()
    gc.collect()
    before = resident_mb("VmRSS")
    ppd = ours(case)
    for _ in range(10):
        ppd.step()
    early = resident_mb("VmRSS")
    for _ in range(iterations - 10):
        ppd.step()
    nx, ny, size, blocks, _ = case
    print(f"| {nx}×{ny} | {ppd.vis.size:.3g} in {blocks} | {before:.0f} | {resident_mb() - before:.0f} | {iterations} "
          f"| {resident_mb('VmRSS') - early:.1f} |", flush=True)


PFB = """
import sys, time
import numpy as np
from pfb_imaging.operators.psi import psi_band_maker_nocopyt
import numba
numba.config.THREADING_LAYER = "workqueue"
nx, ny, threads, repeat = map(int, sys.argv[1:])
numba.set_num_threads(threads)
psi = psi_band_maker_nocopyt(nx, ny, ("self", *(f"db{k}" for k in range(1, 9))), 4)
image = np.random.default_rng(0).normal(size=(nx, ny))
coefs, out = np.zeros((psi.nbasis, psi.nxmax, psi.nymax)), np.zeros((nx, ny))
times = []
for _ in range(repeat + 1):
    begin = time.perf_counter()
    psi.dot(image, coefs)
    psi.hdot(coefs, out)
    times.append(time.perf_counter() - begin)
print(np.median(times[1:]))
"""


def compare_with_pfb(cases, repeat):
    """Print how long pfb-imaging's dictionary takes for analysis and synthesis,
    and ours for those and the dual update."""
    print("\n| size | threads | this prior step, ms | pfb-imaging's analysis + synthesis, ms | ratio |\n" + "|---" * 5
          + "|")
    for nx, ny, nthreads in sorted({(*case[:2], case[4]) for case in cases}):
        command = [sys.executable, "-c", PFB, *map(str, (nx, ny, nthreads, repeat))]
        theirs = float(subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()[-1])
        dictionary = SaraDictionary((nx, ny), nthreads=nthreads)
        image, dual = np.ones((nx, ny), np.float32), dictionary.allocate()
        out = np.empty_like(image)
        dictionary.dual_step(image, dual, THRESHOLD, None, out)
        step = np.median([seconds(dictionary.dual_step, image, dual, THRESHOLD, None, out) for _ in range(repeat)])
        print(f"| {nx}×{ny} | {nthreads} | {1e3 * step:.1f} | {1e3 * theirs:.0f} | {theirs / step:.0f} |", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cases", type=int, nargs="+", default=list(range(len(CASES))),
                        help="numbers of the table's lines")
    parser.add_argument("--repeat", type=int, default=15)
    parser.add_argument("--slow-repeat", type=int, default=3, help="repetitions of PyWavelets and finufft")
    parser.add_argument("--pfb", action="store_true",
                        help="time pfb-imaging's dictionary too, which has to be installed")
    parser.add_argument("--stages", action="store_true", help="only time the stages of some sizes")
    parser.add_argument("--memory", type=int, metavar="CASE",
                        help="only measure the memory of this case, in this process")
    parser.add_argument("--iterations", type=int, default=1000, help="for the growth of the memory")
    options = parser.parse_args()
    if options.memory is not None:
        measure_memory(CASES[options.memory], options.iterations)
        return
    if options.stages:
        print(machine())
        for case in STAGED:
            time_stages(case, options.repeat)
        time_waking(options.repeat)
        return
    cases = [CASES[number] for number in options.cases]
    print(f"{machine()}; PyWavelets {pywt.__version__}, finufft {finufft.__version__}\n")
    print("| image | visibilities, blocks | threads | iteration, ms | per second | forward + adjoint + dictionary, ms "
          "| PyWavelets + finufft, ms | ratio | floor, ms | iteration / floor |\n" + "|---" * 10 + "|")
    for case in cases:
        time_case(case, options.repeat, options.slow_repeat)
    if options.pfb:
        compare_with_pfb(cases, options.slow_repeat)
    print("\n| image | visibilities, blocks | casatools, MB | more at the peak, MB | iterations | growth, MB |\n"
          + "|---" * 6 + "|",
          flush=True)
    for number in options.cases:
        subprocess.run([sys.executable, __file__, "--memory", str(number), "--iterations", str(options.iterations)],
                       check=True)


if __name__ == "__main__":
    main()
