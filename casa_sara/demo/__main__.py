"""Command line of the demo: ``python -m casa_sara.demo [--out FOLDER] [--only cyga|3c273] [--smoke]``."""

from __future__ import annotations

import argparse
import shutil
import sys
import time
from pathlib import Path

MARKER = ".casa_sara_demo"


def main(arguments=None) -> int:
    """Run the demo and return its exit code."""
    parser = argparse.ArgumentParser(prog="python -m casa_sara.demo",
                                     description="Compare tsara with tclean multiscale")
    parser.add_argument("--out", type=Path, default=Path("demo-output"), help="folder for all output")
    parser.add_argument("--only", choices=("cyga", "3c273"), help="run one of the two parts")
    parser.add_argument("--smoke", action="store_true", help="a few seconds on a tiny simulated observation instead")
    options = parser.parse_args(arguments)
    sys.argv = sys.argv[:1]  # CASA reads the command line, too

    parts = ["smoke"] if options.smoke else [options.only] if options.only else ["cyga", "3c273"]
    started = time.perf_counter()
    for part in parts:
        run = _part(part)
        run(prepare(options.out, part).resolve())
    print(f"\nDone in {time.perf_counter() - started:.0f} s. Pictures and CASA images are in {options.out.resolve()}")
    return 0


def _part(name):
    """Import one part of the demo (and CASA with it) and return its function."""
    if name == "cyga":
        from casa_sara.demo.cyga import run
    elif name == "3c273":
        from casa_sara.demo.threec273 import run
    else:
        from casa_sara.demo.smoke import run
    return run


def prepare(out: Path, part: str) -> Path:
    """Return an empty folder `out`/`part`; what an earlier demo left there is removed.

    Raises
    ------
    FileExistsError
        If `out` holds files and is not the folder of an earlier demo.
    """
    marker = out / MARKER
    if out.exists() and any(out.iterdir()) and not marker.exists():
        raise FileExistsError(f"--out={out} holds files that are not the demo's: name a new or an empty folder")
    out.mkdir(parents=True, exist_ok=True)
    marker.touch()
    folder = out / part
    if folder.exists():
        shutil.rmtree(folder)
    folder.mkdir()
    return folder


if __name__ == "__main__":
    sys.exit(main())
