"""What the repository holds: no large files, no tables of CASA, and a licence for all of it."""

import configparser
import re
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
LARGEST = 2**20  # bytes
OF_TABLES = re.compile(r"(^|/)(table\.(dat|info|lock)|table\.f\d+\w*|TempLattice\w*|TempImage\w*)(/|$)"
                       r"|\.(ms|image|model|psf)(/|$)")


def looks_wrong(name, size):
    """What is wrong with a tracked file, '' if nothing."""
    if size > LARGEST:
        return f"{name}: {size} bytes, more than {LARGEST}"
    return f"{name}: a table of CASA" if OF_TABLES.search(name) else ""


def test_tracked_files_are_small_and_no_tables():
    if not shutil.which("git") or not (ROOT / ".git").exists():
        pytest.skip("no git checkout")
    names = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True,
                           check=True).stdout.split("\0")
    names = [name for name in names if name and (ROOT / name).exists()]
    assert len(names) > 100
    assert not [wrong for name in names if (wrong := looks_wrong(name, (ROOT / name).stat().st_size))]


@pytest.mark.parametrize("name, size, wrong", [
    ("docs/images/a.png", 2**20 + 1, True), ("TempLattice17100_184/table.f0", 100, True),
    ("x/y.ms/table.dat", 10, True),
    ("benchmarks/a.image/table.info", 10, True), ("benchmarks/tables.py", 100, False),
    ("casa_sara/casa/images/image_files.py", 100, False),
])
def test_what_looks_wrong_is_seen(name, size, wrong):
    assert bool(looks_wrong(name, size)) == wrong


def test_every_dependency_has_its_licence_in_the_docs():
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    tables = [config["options"]["install_requires"], *config["options.extras_require"].values()]
    required = {re.match(r"[\w-]+", line)[0] for table in tables for line in table.split("\n")
                if line.strip() and not line.startswith("#")}
    named = (ROOT / "docs/installation.md").read_text().split("### Licences")[1]
    assert len(required) > 20 and not [name for name in required if not re.search(rf"\b{name}\b", named)]


def test_licence_is_that_of_the_metadata():
    assert "BSD 3-Clause" in (ROOT / "LICENSE").read_text() and "the casa_sara authors" in (ROOT
                                                                                            / "LICENSE").read_text()
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    assert config["metadata"]["license"] == "BSD-3-Clause" and "the casa_sara authors" == config["metadata"]["author"]
