"""What all tests share: few threads, no windows, repeatable examples, and a scratch folder to run in."""

import os
import tempfile

# Before anything starts OpenMP: the same on every machine, and one for each of several processes of tests.
os.environ.setdefault("OMP_NUM_THREADS", "1" if "PYTEST_XDIST_WORKER" in os.environ else "2")
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("HYPOTHESIS_STORAGE_DIRECTORY", os.path.join(tempfile.gettempdir(), "casa_sara-hypothesis"))

import hypothesis
import pytest

hypothesis.settings.register_profile("repeatable", derandomize=True, database=None, deadline=None)
hypothesis.settings.load_profile("repeatable")


@pytest.fixture(autouse=True, scope="session")
def _session_folder(tmp_path_factory):
    """Run in a scratch folder, so that fixtures leave nothing in the tree."""
    os.chdir(tmp_path_factory.mktemp("session"))


@pytest.fixture
def every_thread(monkeypatch):
    """Use all threads, however little there is to do."""
    monkeypatch.setattr("casa_sara.operators._workers.LEAST_NS", 1e-9)


@pytest.fixture(autouse=True)
def _test_folder(tmp_path, monkeypatch):
    """Run every test in a folder of its own."""
    monkeypatch.chdir(tmp_path)
