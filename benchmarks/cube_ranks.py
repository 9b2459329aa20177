"""A cube on one rank and on two: wall clock and CPU time, and whether the images are the same.

    python benchmarks/cube_ranks.py [--out cube-ranks] [--channels 128] [--size 256] [--niter 100000] [--rounds 1]

A simulated line in half of the channels. The layouts take turns, each an MPI job of its own with one thread per rank.
CPU time is that of the slowest rank, which tells what ranks share when other programs take part of the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

ARCSEC = np.pi / 180 / 3600


def observation(channels):
    """Simulate the data, once."""
    from simulated_ms import column, edit, simulate

    if Path("line.ms").exists():
        return
    rng = np.random.default_rng(1)
    places = rng.normal(0, 60, (30, 2)) * ARCSEC
    sky = [(flux, x, y) for flux, (x, y) in zip(rng.uniform(0.02, 0.2, 30), places)]
    simulate("line.ms", frame="LSRK", spws=(("1.42GHz", "20kHz", channels),), scans=4, antennas=14, noise=0.05, sky=sky,
             spacing_seconds=3600.0, hour_angle=-2.0, columns=("DATA", "MODEL_DATA"))
    line = np.exp(-((np.arange(channels) / channels - 0.5) / 0.12) ** 2)
    model = column("line.ms", "MODEL_DATA")
    edit("line.ms", "DATA", lambda data: data + (line[:, None] - 1) * model)


def image(ranks, size, niter):
    """Image it, on each rank; print the time of the slowest."""
    from casa_sara import tsara
    from casa_sara.parallel.mpi import world

    comm, begun = world(), time.monotonic()
    tsara(vis="line.ms", imagename=f"ranks{ranks}", imsize=size, cell="5arcsec", specmode="cube", datacolumn="data",
          niter=niter, nthreads=1, parallel=True, overwrite=True)
    usage = resource.getrusage(resource.RUSAGE_SELF)
    cpu = comm.allgather(usage.ru_utime + usage.ru_stime)
    if comm.rank == 0:
        print("\n" + json.dumps(dict(wall=time.monotonic() - begun, cpu=cpu)), flush=True)


def job(ranks, size, niter):
    """Run an MPI job and return its times."""
    environment = dict(os.environ, OMPI_ALLOW_RUN_AS_ROOT="1", OMPI_ALLOW_RUN_AS_ROOT_CONFIRM="1", OMP_NUM_THREADS="1")
    command = ["mpirun", "--oversubscribe", "--bind-to", "none", "-n", str(ranks), sys.executable, __file__, "--rank",
               json.dumps([ranks, size, niter])]
    found = subprocess.run(command, env=environment, capture_output=True, text=True)
    lines = [line for line in found.stdout.split("\n") if line.startswith('{"wall"')]
    if not lines:
        raise RuntimeError(found.stderr)
    return json.loads(lines[0])


def same():
    """Tell whether all pixels are the same."""
    import casatools

    pixels = []
    for ranks in (1, 2):
        for product in ("model", "residual"):
            ia = casatools.image()
            ia.open(f"ranks{ranks}.{product}")
            pixels.append(ia.getchunk())
            ia.close()
    return np.array_equal(pixels[0], pixels[2]) and np.array_equal(pixels[1], pixels[3])


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--out", default="cube-ranks")
    options.add_argument("--channels", type=int, default=128)
    options.add_argument("--size", type=int, default=256)
    options.add_argument("--niter", type=int, default=100_000)
    options.add_argument("--rounds", type=int, default=1)
    options.add_argument("--rank", default="")
    chosen = options.parse_args()
    if chosen.rank:
        image(*json.loads(chosen.rank))
        return
    Path(chosen.out).mkdir(parents=True, exist_ok=True)
    os.chdir(chosen.out)
    observation(chosen.channels)
    for _ in range(chosen.rounds):
        one, two = (job(ranks, chosen.size, chosen.niter) for ranks in (1, 2))
        print(f"1 rank: {one['wall']:.0f} s, CPU {one['cpu'][0]:.0f} s; 2 ranks: {two['wall']:.0f} s, CPU "
              f"{', '.join(f'{cpu:.0f}' for cpu in two['cpu'])} s; ratio {two['wall'] / one['wall']:.3f}, of CPU "
              f"{max(two['cpu']) / one['cpu'][0]:.3f}; images the same: {same()}", flush=True)


if __name__ == "__main__":
    main()
