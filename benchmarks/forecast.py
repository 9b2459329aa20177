"""The forecast of memory against the measured peak, and of time against the clock.

    python benchmarks/forecast.py [FOLDER] [--all]

Simulates MeasurementSets of 1e5 and 1e6 visibilities in FOLDER (default: a temporary one) and images each in a process
of its own with 256², 1024² and 2048² pixels, through the re-weightings that need most; --all adds 4096 × 2048 pixels
with two million visibilities in 22 blocks. The peak is VmHWM of the process; the forecast is what the run says before
it reads.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SETS = {"1e5": (4, 90.0), "1e6": (8, 450.0), "2e6": (22, 324.0)}  # scans, and seconds of each
RUNS = [(name, n, n) for name in ("1e5", "1e6") for n in (256, 1024, 2048)]
LARGEST = ("2e6", 4096, 2048)
RUN = """
import json, sys, time
from casa_sara import tsara

vis, nx, ny = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
common = dict(vis=vis, imagename=vis + ".image", imsize=[nx, ny], cell="0.04arcsec", datacolumn="data", nthreads=1,
              reweightdecay=0.3, niter=125)
if len(sys.argv) > 4:
    print(json.dumps(tsara(dryrun=True, **common)["forecast"]))
else:
    start = time.perf_counter()
    made = tsara(overwrite=True, **common)
    with open("/proc/self/status") as status:
        peak = next(int(line.split()[1]) * 1024 for line in status if line.startswith("VmHWM"))
    said = made["sara"]["forecast"]
    print(json.dumps(dict(peak=peak, said=said["peak_bytes"], held=said["held_before_bytes"], phase=said["peak_phase"],
                          visibilities=made["sara"]["visibilities"], seconds=time.perf_counter() - start)))
"""


def main(folder, runs):
    print("| pixels | visibilities | held before | forecast | peak | forecast/peak | forecast time | time |")
    print("|---|---|---|---|---|---|---|---|")
    for name, nx, ny in runs:
        vis = Path(folder) / f"{name}.ms"
        if not vis.exists():
            _simulate(vis, *SETS[name])
        ran, dry = (_last_line([str(vis), str(nx), str(ny), *more]) for more in ((), ("dry",)))
        held, said, peak = (ran[key] / 1e6 for key in ("held", "said", "peak"))
        print(f"| {nx} × {ny} | {ran['visibilities']} | {held:.0f} MB | {said:.0f} MB | {peak:.0f} MB | "
              f"{said / peak:.2f} | {dry['seconds']['total']:.0f} s | {ran['seconds']:.0f} s |", flush=True)


def _simulate(vis, scans, seconds):
    from simulated_ms import simulate

    sky = [(1.0, 0.0, 0.0), (0.5, 2e-5, -1e-5), (0.3, -5e-5, 4e-5)]
    simulate(vis, configuration="a", antennas=27, spws=(("8.4GHz", "2MHz", 8),), scans=scans, scan_seconds=seconds,
             spacing_seconds=seconds + 300, noise=0.05, hour_angle=-3, columns=("DATA",), sky=sky)


def _last_line(arguments):
    done = subprocess.run([sys.executable, "-c", RUN, *arguments], check=True, capture_output=True, text=True)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    chosen = RUNS + [LARGEST] * ("--all" in sys.argv)
    folders = [argument for argument in sys.argv[1:] if not argument.startswith("--")]
    if folders:
        main(folders[0], chosen)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(temporary, chosen)
