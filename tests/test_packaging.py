"""The dependency table of setup.cfg against the imports, and the house's rules on who imports what."""

import ast
import configparser
import re
import sys
from pathlib import Path

import pytest

import casa_sara

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "casa_sara"
MODULES = sorted(path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))

DISTRIBUTIONS = {"pywt": "PyWavelets", "PIL": "Pillow", "jinja2": "Jinja2"}  # where it is not the name of the import
NOT_IMPORTED = {
    "casadata": "the data that CASA needs to be imported at all",
    "six": "casatasks imports it and does not require it",
}
CASA = {"casaconfig", "casatools", "casatasks"}
OF_USERS = {"casampi"}  # CASA's own, used where it is in charge

# What each room may import beside itself and the standard library: other rooms and packages.
ROOMS = {
    "__init__": {"casa_sara.tasks"},
    "tasks": {"casa_sara.private"},
    "gotasks": {"casa_sara.private", "casa_sara.tasks"},
    "private": {
        "casa_sara", "casa_sara.cube", "casa_sara.imaging", "casa_sara.options", "casa_sara.rehearsal", "casa_sara.resources",
        "casa_sara.solver",
        "casa_sara.tasks", "casa_sara.analysis", "casa_sara.casa", "casa_sara.compare", "casa_sara.jsonfile",
        "casa_sara.mpi", "casa_sara.parallel", "numpy", "casashell", "mpi4py", *OF_USERS, *CASA,
    },
    "interrupt": set(),
    "jit": {"numba"},
    "deadline": set(),
    "parallel": {"numpy"},
    "mpi": {"casa_sara.parallel", "numpy", "mpi4py"},
    "sharing": {"casa_sara.parallel", "casa_sara.visibilities", "numpy"},
    "balance": {"casa_sara.operators", "casa_sara.sharing", "numpy"},
    "averaging": {"casa_sara.parallel", "casa_sara.visibilities", "numpy"},
    "problem": {
        "casa_sara.averaging", "casa_sara.operators", "casa_sara.options", "casa_sara.outliers", "casa_sara.parallel",
        "casa_sara.sharing", "casa_sara.solver", "casa_sara.visibilities", "numpy",
    },
    "papermethod": {"casa_sara.operators", "casa_sara.options", "casa_sara.problem", "casa_sara.solver", "numpy"},
    "resources": set(),
    "options": set(),
    "visibilities": {"numpy"},
    "snapshots": {"casa_sara.parallel", "casa_sara.visibilities", "numpy"},
    "levels": {"casa_sara.parallel", "numpy"},
    "noise": {"casa_sara.levels", "casa_sara.parallel", "casa_sara.sharing", "numpy"},
    "cautions": {"casa_sara.parallel", "casa_sara.visibilities", "numpy", "scipy"},
    "outliers": {"casa_sara.levels", "casa_sara.noise", "casa_sara.parallel", "casa_sara.sharing", "numpy"},
    "casa": {
        "casa_sara", "casa_sara.interrupt", "casa_sara.jsonfile", "casa_sara.levels", "casa_sara.options", "casa_sara.parallel",
        "casa_sara.sharing", "casa_sara.snapshots", "casa_sara.visibilities", "numpy", "scipy", "astropy", *CASA,
    },
    "operators": {
        "casa_sara.jit", "casa_sara.options", "casa_sara.parallel", "casa_sara.visibilities", "numpy", "scipy", "finufft",
        "ducc0", "numba", "llvmlite", "pywt",
    },
    "solver": {"casa_sara.jit", "casa_sara.options", "casa_sara.parallel", "numpy", "scipy"},
    "analysis": {"casa_sara.jsonfile", "numpy", "scipy", "astropy", "regions", "matplotlib", "jinja2", "PIL"},
    "jsonfile": set(),
}
LIBRARY = (
    "jit", "options", "parallel", "visibilities", "snapshots", "sharing", "balance", "levels", "noise", "cautions",
    "outliers", "averaging", "problem", "papermethod", "operators", "solver", "analysis",
)
ROOMS["reconstruction"] = {"numpy", *(f"casa_sara.{name}" for name in LIBRARY)}
NUMERICS = {f"casa_sara.{name}" for name in (*LIBRARY, "reconstruction")}
ROOMS["warmup"] = {"casa_sara.operators", "casa_sara.solver", "llvmlite", "numba", "numpy"}
ROOMS["forecast"] = {"casa_sara.averaging", "casa_sara.operators", "casa_sara.sharing"}
ROOMS["timing"] = {"casa_sara.reconstruction", *ROOMS["reconstruction"]}
ROOMS["rehearsal"] = {
    "casa_sara.casa", "casa_sara.forecast", "casa_sara.resources", "casa_sara.timing", "casa_sara.warmup", "numpy", *NUMERICS,
}
ROOMS["solving"] = {
    "casa_sara", "casa_sara.casa", "casa_sara.deadline", "casa_sara.interrupt", "casa_sara.timing", "numpy", *NUMERICS,
}
ROOMS["cubestate"] = {"casa_sara.reconstruction", "casa_sara.solver", "numpy"}
ROOMS["cube"] = {
    "casa_sara.casa", "casa_sara.cubestate", "casa_sara.deadline", "casa_sara.imaging", "casa_sara.interrupt",
    "casa_sara.rehearsal", "casa_sara.solving", "casa_sara.timing", "casa_sara.warmup", "numpy", *NUMERICS,
}
ROOMS["imaging"] = {
    "casa_sara.casa", "casa_sara.deadline", "casa_sara.forecast", "casa_sara.rehearsal", "casa_sara.solving",
    "casa_sara.timing", "casa_sara.warmup", "numpy", *NUMERICS,
}
ROOMS["injection"] = {"casa_sara.casa", "casa_sara.solving", "numpy", *NUMERICS}
ROOMS["compare"] = {"casa_sara", "casa_sara.casa", "casa_sara.injection", "casa_sara.jsonfile", "casa_sara.warmup", "numpy", *NUMERICS}
ROOMS["demo"] = {
    "casa_sara", "casa_sara.casa", "casa_sara.compare", "casa_sara.imaging", "casa_sara.resources", "numpy", "finufft",
    "matplotlib", *NUMERICS,
    *CASA,
}


def imports(module):
    """Return what a module of the package imports: rooms as casa_sara.<room>, other packages by their name."""
    names = set()
    for node in ast.walk(ast.parse((PACKAGE / module).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            rooms = {f"casa_sara.{alias.name}" for alias in node.names}
            if node.module == "casa_sara" and rooms & {f"casa_sara.{name}" for name in ROOMS}:
                names |= rooms
            else:
                names.add(node.module)
    parts = [name.split(".") for name in names]
    return {".".join(part[:2]) if part[0] == "casa_sara" else part[0] for part in parts} - sys.stdlib_module_names


def room(module):
    return module.split("/")[0].removesuffix(".py")


def required(section, option):
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return {re.match(r"[\w-]+", line)[0] for line in config[section][option].split("\n") if line.strip()}


def test_dependency_table_is_what_is_imported():
    imported = {DISTRIBUTIONS.get(name, name) for module in MODULES for name in imports(module)}
    imported = {name for name in imported if not name.startswith("casa_sara")}
    table = required("options", "install_requires")
    missing = imported - table - OF_USERS
    for extra in ("shell", "mpi"):
        missing -= required("options.extras_require", extra)
    idle = table - imported - NOT_IMPORTED.keys()
    assert not missing and not idle, f"not in setup.cfg: {missing}; in setup.cfg and not imported: {idle}"


@pytest.mark.parametrize("module", MODULES)
def test_module_imports_what_its_room_may(module):
    assert room(module) in ROOMS, "a new room: enter it in ROOMS"
    assert imports(module) - {f"casa_sara.{room(module)}"} <= ROOMS[room(module)]


def test_numerics_never_reach_casa():
    """No chain of imports leads from the numerics to CASA."""
    reached, new = set(), set(NUMERICS)
    while new:
        reached |= new
        rooms = {name.removeprefix("casa_sara.") for name in new if name.startswith("casa_sara.")}
        new = {name for module in MODULES if room(module) in rooms for name in imports(module)} - reached
    assert not reached & (CASA | {"casashell", "casa_sara.casa", "casa_sara.private"})


def test_changelog_tells_this_version():
    assert f"## {casa_sara.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_package_is_complete():
    """Folders with modules are packages and templates are named, or installing the project would leave them out."""
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    named = {PACKAGE.parent.joinpath(*package.split("."), pattern)
             for package, pattern in config["options.package_data"].items()}
    for path in PACKAGE.rglob("*.j2"):
        assert any(path.match(str(pattern)) for pattern in named), path
    for module in MODULES:
        assert (PACKAGE / module).parent.joinpath("__init__.py").exists(), module
