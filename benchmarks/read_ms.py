"""Time and memory to read two million Stokes I visibilities.

    python benchmarks/read_ms.py [FOLDER]

Simulates a MeasurementSet of 2.0 million samples × 2 correlations in FOLDER (default: a
temporary one), then reads it in a fresh process. The bounds are 3 s and 600 MB of resident
memory, CASA's own share (named apart) included; importing CASA is not in the time.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
READ = """
import sys, time

def peak_mb():
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) / 1024 for line in status if line.startswith("VmHWM"))

import casatools
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.options import Selection

casatools.logsink().setglobal(False)
before = peak_mb()
start = time.perf_counter()
vis = read_visibilities(Selection(vis=(sys.argv[1],), datacolumn="data"))
seconds = time.perf_counter() - start
print(f"{vis.size} visibilities in {seconds:.2f} s, peak {peak_mb():.0f} MB ({before:.0f} MB before reading)")
"""


def main(folder):
    name = Path(folder) / "read_benchmark.ms"
    if not name.exists():
        from simulated_ms import simulate

        simulate(name, antennas=27, spws=(("8.4GHz", "2MHz", 8),), scans=8, scan_seconds=890.0, noise=0.1, frame="TOPO")
    for _ in range(3):
        subprocess.run([sys.executable, "-c", READ, str(name)], check=True, cwd=folder)


if __name__ == "__main__":
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with tempfile.TemporaryDirectory() as temporary:
            main(temporary)
