"""The tutorial's round of self-calibration, small."""

import importlib.util
import sys
from pathlib import Path

import pytest

pytest.importorskip("casatasks")


@pytest.fixture(scope="module")
def tutorial():
    path = Path(__file__).resolve().parents[1] / "docs" / "tutorials" / "selfcal.py"
    spec = importlib.util.spec_from_file_location("selfcal", path)
    module = sys.modules["selfcal"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
def test_one_round_recovers_the_gains_and_improves_the_image(tutorial, tmp_path):
    truth, rounds = tutorial.main(tmp_path, scans=3)
    ours, theirs = rounds["tsara"], rounds["tclean"]
    assert ours.gain_error < 0.4 * tutorial.GAIN_RMS * 2**0.5  # of what there was
    assert ours.gain_error < 0.8 * theirs.gain_error
    assert ours.snr_db[1] > ours.snr_db[0] + 0.2
    assert ours.dynamic_range[1] > 4 * ours.dynamic_range[0] > 4 * theirs.dynamic_range[0]
    assert truth.shape == ours.models[1].shape
    tutorial.draw(tmp_path / "picture.png", truth, rounds)
    assert (tmp_path / "picture.png").stat().st_size < 150_000
    assert "| tsara | " in tutorial.as_text(rounds)
