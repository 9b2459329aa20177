"""What the w-term costs and how accurate it is, by the largest phase that it turns.

    OMP_NUM_THREADS=1 python benchmarks/widefield.py [--size 1024] [--samples 300000] [--eps 1e-5]

One line for each largest phase in the image: the way taken; the time of a pair (forward and adjoint) and of a whole
iteration of the solver relative to gridder='standard', in CPU time of one thread; and the errors of the visibilities of
a random image, of 200 of them, relative to their rms: with the w-term, and without it.
"""

import argparse
import time

import numpy as np

from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.operators.modulated import terms_needed
from casa_sara.operators.widefield import WGridder, WTerm, w_operator
from casa_sara.solver.adaptive_ppd import AdaptivePPD

PHASES = (0.1, 1.0, 3.0, 10.0, 30.0, 100.0)
CELL = 1e-5  # rad
CHECKED = 200


def seconds(call, repeats=3):
    """Least CPU time of a call that has been made before."""
    call()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return min(times)


def exact(uvw, image):
    """Visibilities of an image by the explicit sum."""
    l, m = (sign * (np.arange(n) - n // 2) * CELL for sign, n in zip((-1, 1), image.shape))
    depth = np.sqrt(1 - l[:, None] ** 2 - m[None, :] ** 2) - 1
    turn = 2j * np.pi
    return np.array([np.exp(turn * u * l) @ (image * np.exp(turn * w * depth)) @ np.exp(turn * v * m)
                     for u, v, w in uvw.T])


def step(operator):
    """Return the iteration of a solver with this operator."""
    vis, ones = np.ones(operator.size, np.complex64), np.ones(operator.size, np.float32)
    dictionary = SaraDictionary(operator.shape)
    ppd = AdaptivePPD(operator, dictionary, vis, [0, operator.size], ones,
                      float(operator.size) * np.prod(operator.shape))
    ppd.threshold = 1.0
    return ppd.step


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--samples", type=int, default=300_000)
    parser.add_argument("--eps", type=float, default=1e-5)
    args = parser.parse_args()
    rng, shape = np.random.default_rng(0), (args.size, args.size)
    uv = np.clip(rng.standard_normal((2, args.samples)) * 0.08, -0.25, 0.25) / CELL
    image = (rng.uniform(0, 1, shape) ** 8).astype(np.float32)
    plain = MeasurementOperator(uv, CELL, shape, eps=args.eps)
    pair, whole = seconds(lambda: plain.adjoint(plain.forward(image))), seconds(step(plain))
    print(f"{args.size}² pixels, {args.samples} visibilities, eps {args.eps:g}: standard {1e3 * pair:.0f} ms a pair, "
          f"{1e3 * whole:.0f} ms an iteration")
    for phase in PHASES:
        w = np.append(rng.uniform(-1, 1, args.samples - 1), 1) * phase / WTerm.of(1.0, shape, (CELL, CELL),
                                                                                  args.eps).phase
        uvw = np.stack([*uv, w])
        operators = [w_operator(uvw, CELL, shape, eps=args.eps)]
        if not isinstance(operators[0], WGridder):
            operators.append(WGridder(uvw, (CELL, CELL), shape, None, args.eps, np.float32, 1))
        some = rng.choice(args.samples, CHECKED, replace=False)
        right = exact(uvw[:, some], image)
        wrong = [np.sqrt(np.mean(abs(one.forward(image)[some] - right) ** 2) / np.mean(abs(right) ** 2))
                 for one in (operators[0], plain)]
        times = [seconds(lambda: one.adjoint(one.forward(image)), 2) / pair for one in operators]
        terms = WTerm.of(w.max(), shape, (CELL, CELL), args.eps).terms
        way = f"{terms} terms" if terms else f"w-gridder ({terms_needed(phase / 2, args.eps / 4)} terms)"
        other = f", w-gridder {times[1]:.0f}" if terms else ""
        print(f"{phase:6g} rad: {way}, pair {times[0]:.1f}{other}, iteration "
              f"{seconds(step(operators[0]), 2) / whole:.1f}, error {wrong[0]:.1e}, without the w-term {wrong[1]:.1e}",
              flush=True)


if __name__ == "__main__":
    main()
