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

# The libraries that each package may use. Who imports whom within casa_sara is held by import-linter: pyproject.toml.
PACKAGES = {
    "__init__": set(),
    "version": set(),
    "options": set(),
    "tasks": set(),
    "gotasks": set(),
    "private": {"numpy", "casashell", "mpi4py", *OF_USERS, *CASA},
    "demo": {"numpy", "scipy", "finufft", "matplotlib", *CASA},
    "comparison": {"numpy"},
    "imaging": {"numpy", "scipy"},
    "casa": set(),
    "casa.images": {"numpy", "scipy", "astropy", *CASA},
    "casa.ms": {"numpy", "scipy", "astropy", *CASA},
    "casa.runtime": {"numpy", *CASA},
    "reconstruction": {"numpy", "scipy", "numba", "llvmlite"},
    "solver": {"numpy", "scipy"},
    "operators": {"numpy", "scipy", "finufft", "ducc0", "numba", "llvmlite", "pywt"},
    "data": {"numpy"},
    "parallel": {"numpy", "mpi4py"},
    "runtime": {"numba", "numpy"},
    "analysis": {"numpy", "scipy", "astropy", "regions", "matplotlib", "jinja2", "PIL"},
}


def imports(module):
    """Return what a module of the package imports: packages of casa_sara as in PACKAGES, others by their name."""
    names = set()
    for node in ast.walk(ast.parse((PACKAGE / module).read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{module}: relative import"
            names |= {f"{node.module}.{alias.name}" for alias in node.names}
    return {package_of(name) for name in names} - sys.stdlib_module_names


def package_of(name):
    """Return the package of PACKAGES that an imported name belongs to, or the library."""
    first, *rest = name.split(".")
    if first != "casa_sara":
        return first
    within = [package for package in (".".join(rest[:2]), *rest[:1]) if package in PACKAGES]
    return within[0] if within else "__init__"


def package(module):
    return package_of("casa_sara." + module.removesuffix(".py").replace("/", "."))


def required(section, option):
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg")
    return {re.match(r"[\w-]+", line)[0] for line in config[section][option].split("\n") if line.strip()}


def test_dependency_table_is_what_is_imported():
    imported = {DISTRIBUTIONS.get(name, name) for module in MODULES for name in imports(module)}
    imported -= PACKAGES.keys()
    table = required("options", "install_requires")
    missing = imported - table - OF_USERS
    for extra in ("shell", "mpi"):
        missing -= required("options.extras_require", extra)
    idle = table - imported - NOT_IMPORTED.keys()
    assert not missing and not idle, f"not in setup.cfg: {missing}; in setup.cfg and not imported: {idle}"


@pytest.mark.parametrize("module", MODULES)
def test_module_uses_the_libraries_of_its_package(module):
    assert package(module) in PACKAGES, "a new package: enter it in PACKAGES, and among the layers of import-linter"
    assert imports(module) - PACKAGES.keys() <= PACKAGES[package(module)]


def test_few_loose_modules():
    """At the top there are packages; what is loose is imported by all of them."""
    assert {path.name for path in PACKAGE.glob("*.py")} == {"__init__.py", "options.py", "version.py"}


def test_packages_say_what_lives_there():
    """Each begins with a paragraph on what lives there, and what does not."""
    for path in PACKAGE.rglob("__init__.py"):
        assert len(ast.get_docstring(ast.parse(path.read_text())) or "") > 40, path


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
