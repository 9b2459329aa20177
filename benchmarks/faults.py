"""What tclean makes of the faults that tests/faults/spoiled.py lists: the middle column of docs/reliability.md.

    python benchmarks/faults.py [WORDS]

runs tclean on a spoiled copy of a small MeasurementSet for each fault whose name holds WORDS, each in a process of its
own that is ended after a minute, and prints what came of it.
"""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path[:0] = [str(Path(__file__).resolve().parents[1] / "tests" / folder) for folder in ("", "faults")]

from spoiled import BROKEN, CORRELATION, FAULTS, GRID, HOPELESS, observe, put

LONGEST_S = 60
SPOILING = {name: spoil for name, (spoil, _) in FAULTS.items()} | HOPELESS | BROKEN
SPOILING["one visibility 1e4"] = put("DATA", CORRELATION, 1e4)
CALLS = {  # of a whole MeasurementSet
    "cell far too large": dict(cell="100arcsec"),
    "cell far too small": dict(cell="1e-9arcsec"),
    "image 1 pixel wide": dict(imsize=[1, 64]),
    "image of one pixel": dict(imsize=1),
    "image elsewhere on the sky": dict(phasecenter="J2000 07h59m28.5s -40d44m02s"),
    "autocorrelations only": dict(antenna="*&&&"),
    "one MeasurementSet twice": dict(vis=["spoiled.ms", "spoiled.ms"]),
    "odd size": dict(imsize=[61, 67]),
    "one baseline": dict(antenna="0&1"),
    "one visibility": dict(vis="one.ms"),
    "other hands": dict(vis=["spoiled.ms", "linear.ms"]),
    "other frame": dict(vis=["spoiled.ms", "topo.ms"]),
    "other part of the sky": dict(vis=["spoiled.ms", "far.ms"]),
    "nothing in one of several": dict(vis=["spoiled.ms", "linear.ms"], scan=["", "7"]),
    "no fault": {},
}
OTHERS = {
    "one.ms": dict(antennas=2, scans=1, scan_seconds=10.0, spws=(("8.4GHz", "2MHz", 1),)),
    "linear.ms": dict(correlations="XX YY"),
    "topo.ms": dict(frame="TOPO"),
    "far.ms": dict(fields=("J2000 03h00m00s +40d44m10s",), hour_angle=0),
}


def clean(arguments):
    """Run tclean in this process and print what it made."""
    import casatools
    from casatasks import casalog, tclean

    casalog.setlogfile(os.devnull)
    tclean(**(dict(vis="spoiled.ms", imagename="out", niter=20, **GRID) | arguments))
    ia = casatools.image()
    ia.open("out.residual")
    pixels = ia.getchunk()
    ia.close()
    kind = "NaN in the" if not np.isfinite(pixels).all() else "an empty" if not pixels.any() else "an"
    print(f"RESULT success, {kind} image, peak {np.abs(pixels).max():.3g}")


def attempt(name, folder):
    """Return what tclean makes of one fault."""
    shutil.rmtree(folder / "spoiled.ms", ignore_errors=True)
    for product in folder.glob("out.*"):
        shutil.rmtree(product)
    shutil.copytree(folder / "whole.ms", folder / "spoiled.ms")
    SPOILING.get(name, lambda path: None)(str(folder / "spoiled.ms"))
    try:
        run = subprocess.run([sys.executable, os.path.abspath(__file__), "--clean", name], cwd=folder, text=True,
                             capture_output=True, timeout=LONGEST_S, errors="replace")
    except subprocess.TimeoutExpired:
        return f"hangs (ended after {LONGEST_S} s)"
    if run.returncode < 0:
        return f"the Python session dies of signal {-run.returncode}"
    results = [line for line in run.stdout.splitlines() if line.startswith("RESULT ")]
    errors = [line
              for line in run.stderr.splitlines() if "Error" in line or "\tSEVERE\t" in line and "TAI_UTC" not in line]
    return results[-1].removeprefix("RESULT ") if results else "error: " + (errors or ["?"])[-1][:160]


def main():
    words = " ".join(sys.argv[1:])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with contextlib.redirect_stdout(io.StringIO()):
            observe(folder / "whole.ms")
            for other, changes in OTHERS.items():
                observe(folder / other, **changes)
        for fault in (*SPOILING, *CALLS):
            if words in fault:
                print(f"{fault}: {attempt(fault, folder)}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--clean"]:
        clean(CALLS.get(sys.argv[2], {}))
    else:
        main()
