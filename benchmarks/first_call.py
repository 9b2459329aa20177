"""The first call of a new installation, the second one, and what the fixed cost of a small run is made of.

    python benchmarks/first_call.py [--repeat 3] [--folder FOLDER]

Images 64² pixels of the demo's smallest simulation, in a fresh process each time: with no compiled code on the disk,
with what the first call left there, and `import casa_sara` alone. Wall-clock time, and processor time of the process
and those that it starts; the least of `--repeat` runs, as other work on the machine only adds. The parts are of the
fastest second call; they overlap where threads and the writing process work beside the rest, so that only wall-clock
time is told.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CALL = """
import json, sys, time
start = time.perf_counter()
from casa_sara import tsara
parts, mark = {"import casa_sara": time.perf_counter() - start}, time.perf_counter()
import casatools
parts["import casatools"] = time.perf_counter() - mark
mark = time.perf_counter()
import casa_sara.private.task_tsara
from casa_sara.imaging import continuum, plane_images
parts["import the other modules"] = time.perf_counter() - mark

def timed(name, label, module=continuum):
    function = getattr(module, name)
    def replacement(*arguments, **options):
        begin = time.perf_counter()
        try:
            return function(*arguments, **options)
        finally:
            parts[label] = parts.get(label, 0.0) + time.perf_counter() - begin
    setattr(module, name, replacement)

for name, label in (("forecast_run", "look at the data, forecast"), ("read_data", "read, primary beam"),
                    ("point_spread", "weights, PSF, beam; twice"), ("solve_image", "solve"),
                    ("write_products", "write")):
    timed(name, label)
timed("point_spread", "weights, PSF, beam; twice", plane_images)
tsara(vis=sys.argv[1], imagename="image", datacolumn="data", imsize=64, cell="0.2arcsec", overwrite=True)
parts["all"] = time.perf_counter() - start
print(json.dumps(parts))
"""
SIMULATE = """
import sys
from pathlib import Path
from casa_sara.demo.simulate import simulate_observation
from casa_sara.demo.smoke import OBSERVATION, _sky
simulate_observation(Path(sys.argv[1]), _sky(), "B", noise_db=30.0, seed=1, observation=OBSERVATION)
"""


def run(code, folder, cache, *arguments):
    """Return wall-clock seconds, processor seconds and the last line of the output of a fresh process."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "NUMBA_CACHE_DIR": str(cache)}
    begin, before = time.perf_counter(), os.times()
    done = subprocess.run([sys.executable, "-c", code, *map(str, arguments)], cwd=folder, env=environment, check=True,
                          capture_output=True, text=True)
    after = os.times()
    processor = after.children_user + after.children_system - before.children_user - before.children_system
    return time.perf_counter() - begin, processor, done.stdout.strip().rpartition("\n")[2]


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--folder", type=Path, help="for the simulation and the images; a temporary one unless given")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        vis = folder / "B.ms"
        if not vis.exists():
            run(SIMULATE, folder, folder / "simulation", folder)
        first, second, importing = [], [], []
        for number in range(options.repeat):
            cache = Path(temporary) / f"cache{number}"
            first.append(run(CALL, folder, cache, vis))
            second.append(run(CALL, folder, cache, vis))
            importing.append(run("import casa_sara", folder, cache))
        nothing = min(run("pass", folder, cache)[0] for _ in range(options.repeat))
    print(f"{'':<28}{'wall':>8}{'processor':>11}   s, least of {options.repeat}")
    for name, runs in (("first call", first), ("second call", second), ("import casa_sara", importing)):
        print(f"{name:<28}{min(wall for wall, *_ in runs):8.2f}{min(processor for _, processor, _ in runs):11.2f}")
    print(f"{'first less second call':<28}{min(f[0] - s[0] for f, s in zip(first, second)):8.2f}"
          f"{min(f[1] - s[1] for f, s in zip(first, second)):11.2f}")
    print("\nparts of the fastest second call, s")
    wall, _, told = min(second)
    parts = json.loads(told)
    print(f"  {'Python itself':<28}{nothing:8.2f}")
    for label, seconds in parts.items():
        if label != "all":
            print(f"  {label:<28}{seconds:8.2f}")
    # waiting for the compiled code, what stands between the parts, the end of the process
    rest = wall - nothing - sum(seconds for label, seconds in parts.items() if label != "all")
    print(f"  {'the rest':<28}{rest:8.2f}\n  {'all':<28}{wall:8.2f}, of which the fixed cost "
          f"{wall - parts['solve']:.2f}")


if __name__ == "__main__":
    main()
