"""Time the prior step of the solver against the same step on PyWavelets: python benchmarks/dictionary.py [--help].

The step is analysis, dual update and synthesis with Dirac and Db1–Db8 on four levels in single precision.  The table
gives medians over repetitions with the quartiles, the ratio to PyWavelets on as many threads and on one, and two floors
measured in the same run: the bytes that any implementation has to move (dual read and written, image read, image
written) over the copy bandwidth, and the multiplications and additions of the filters over the peak rate.
"""

import argparse
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pywt

sys.path.insert(0, str(Path(__file__).resolve().parent))

from machine import bandwidth, machine, peak, seconds, spread

from casa_sara.operators.dictionary import SaraDictionary

LEVELS = 4
THRESHOLD = np.float32(0.1)
MODE = {"mode": "periodization"}


class PyWaveletsStep:
    """The prior step on PyWavelets, the bases shared out to threads: dual ← dual + ρ(clip(dual + Ψ†x, ±κ) − dual)."""

    def __init__(self, shape, wavelets, nthreads, dtype=np.float32, threshold=THRESHOLD, relaxation=1.0):
        self.gain, self.threshold, self.relaxation = (dtype(x) for x in (len(wavelets) ** -0.5, threshold, relaxation))
        self.wavelets = wavelets
        zero = np.zeros(shape, dtype)
        self.dual = [zero.copy() if name == "dirac" else pywt.wavedec2(zero, name, level=LEVELS, **MODE)
                     for name in wavelets]
        self.pool = ThreadPoolExecutor(nthreads)

    def __call__(self, image):
        return sum(self.pool.map(self.one_basis, range(len(self.wavelets)), [image] * len(self.wavelets)))

    def one_basis(self, b, image):
        name, dual = self.wavelets[b], self.dual[b]
        if name == "dirac":
            self.update(dual, image.copy())
            return self.gain * dual
        fresh = pywt.wavedec2(image, name, level=LEVELS, **MODE)
        self.update(dual[0], fresh[0])
        for old_bands, bands in zip(dual[1:], fresh[1:]):
            for old, band in zip(old_bands, bands):
                self.update(old, band)
        return self.gain * pywt.waverec2(dual, name, **MODE)

    def update(self, dual, fresh):
        fresh *= self.gain
        fresh += dual
        np.clip(fresh, -self.threshold, self.threshold, out=fresh)
        if self.relaxation == 1:
            dual[...] = fresh
        else:
            fresh -= dual
            fresh *= self.relaxation
            dual += fresh


def filter_flops(shape, wavelets):
    """Both directions: two filters of F taps on half the samples, along two axes, on every level."""
    taps = sum(pywt.Wavelet(name).dec_len for name in wavelets if name != "dirac")
    return 2 * 2 * 2 * taps * shape[0] * shape[1] * sum(4.0 ** -level for level in range(LEVELS))


def time_size(shape, threads, repeat, slow_repeat):
    """Seconds of every repetition for each number of threads: ours, with weights, PyWavelets."""
    image = np.random.default_rng(0).normal(size=shape).astype(np.float32)
    out = np.empty_like(image)
    ours = {n: SaraDictionary(shape, levels=LEVELS, nthreads=n) for n in threads}
    theirs = {n: PyWaveletsStep(shape, ours[n].wavelets, n) for n in threads}
    dual, weights = ours[threads[0]].allocate(), ours[threads[0]].allocate()
    weights.fill(1)
    first = threads[0]
    ours[first].dual_step(image, dual, THRESHOLD, None, out)
    assert np.allclose(theirs[first](image), out, atol=1e-5), "the two steps differ"
    times = {(kind, n): [] for kind in ("plain", "weighted", "pywt") for n in threads}
    for turn in range(repeat):
        for n in threads:
            times["plain", n].append(seconds(ours[n].dual_step, image, dual, THRESHOLD, None, out))
            times["weighted", n].append(seconds(ours[n].dual_step, image, dual, THRESHOLD, weights, out))
            if turn < slow_repeat:
                times["pywt", n].append(seconds(theirs[n], image))
    return times, ours[first]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sizes", nargs="*", default=["512x256", "1024x1024", "2048x2048", "4096x2048"])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--repeat", type=int, default=25)
    parser.add_argument("--slow-repeat", type=int, default=5, help="repetitions of PyWavelets")
    options = parser.parse_args()
    rates = {n: (bandwidth(n, options.repeat), peak(n, options.repeat)) for n in options.threads}
    print(f"{machine()}; PyWavelets {pywt.__version__}")
    for n, (bytes_per_s, flops_per_s) in rates.items():
        print(f"{n} threads: copy {bytes_per_s / 1e9:.1f} GB/s, peak {flops_per_s / 1e9:.0f} Gflop/s")
    print("\n| size | threads | step, ms (quartiles) | with weights | PyWavelets, ms (quartiles) | ratio "
          "| ratio to 1 thread | bandwidth floor | flop floor | step / larger floor |")
    print("|---|---|---|---|---|---|---|---|---|---|")
    for size in options.sizes:
        shape = tuple(int(n) for n in size.split("x"))
        times, dictionary = time_size(shape, options.threads, options.repeat, options.slow_repeat)
        moved = 4 * (2 * dictionary.n_coefs + 2 * shape[0] * shape[1])
        for n in options.threads:
            step, theirs = times["plain", n], times["pywt", n]
            floors = 1e3 * moved / rates[n][0], 1e3 * filter_flops(shape, dictionary.wavelets) / rates[n][1]
            words = [spread(t) for t in (step, times["weighted", n], theirs)]
            ours, same, one = (np.median(t) for t in (step, theirs, times["pywt", options.threads[0]]))
            print(f"| {size} | {n} | {' | '.join(words)} | {same / ours:.0f} | {one / ours:.0f} "
                  f"| {floors[0]:.1f} ms | {floors[1]:.1f} ms | {1e3 * ours / max(floors):.1f} |", flush=True)


if __name__ == "__main__":
    main()
