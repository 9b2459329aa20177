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

from spoiled import BROKEN, FAULTS, GRID, HOPELESS, observe  # noqa: E402

LONGEST_S = 60
SPOILING = {name: spoil for name, (spoil, _) in FAULTS.items()} | HOPELESS | BROKEN
CALLS = {  # of a whole MeasurementSet
    "cell far too large": dict(cell="100arcsec"),
    "cell far too small": dict(cell="1e-9arcsec"),
    "image 1 pixel wide": dict(imsize=[1, 64]),
    "image of one pixel": dict(imsize=1),
    "image elsewhere on the sky": dict(phasecenter="J2000 07h59m28.5s -40d44m02s"),
    "autocorrelations only": dict(antenna="*&&&"),
    "one MeasurementSet twice": dict(vis=["spoiled.ms", "spoiled.ms"]),
    "no fault": {},
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
    errors = [line for line in run.stderr.splitlines() if "Error" in line and "\t" not in line]
    return results[-1].removeprefix("RESULT ") if results else "error: " + (errors or ["?"])[-1][:160]


def main():
    words = " ".join(sys.argv[1:])
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        with contextlib.redirect_stdout(io.StringIO()):
            observe(folder / "whole.ms")
        for fault in (*SPOILING, *CALLS):
            if words in fault:
                print(f"{fault}: {attempt(fault, folder)}", flush=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--clean"]:
        clean(CALLS.get(sys.argv[2], {}))
    else:
        main()
