"""The tutorials run, and give what their pages say."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("casatasks")

from casa_sara.runtime.machine import resident_memory

TUTORIALS = Path(__file__).resolve().parents[1] / "docs" / "tutorials"


def tutorial(name):
    """Import docs/tutorials/NAME.py."""
    spec = importlib.util.spec_from_file_location(name, TUTORIALS / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


NUMBER = re.compile(r"\d+(?:\.\d+)?")


def page_agrees(name, text, rel=0.1):
    """Check that every line of a script's text that holds numbers is in its page, the numbers within a tolerance."""
    page = [line.strip() for line in (TUTORIALS / f"{name}.md").read_text().splitlines()]
    for line in text.splitlines():
        numbers = [float(number) for number in NUMBER.findall(line)]
        alike = [NUMBER.findall(other) for other in page if NUMBER.sub("#", other) == NUMBER.sub("#", line)]
        assert not numbers or any(numbers == pytest.approx([float(number) for number in other], rel=rel)
                                  for other in alike), line


def drawn(path):
    """Whether a picture is there that may be committed."""
    return 10_000 < path.stat().st_size < 150_000


def test_first_image(tmp_path):
    module = tutorial("first_image")
    before = resident_memory()
    truth, forecast, result, images = module.main(tmp_path)
    assert forecast["fits"] and 0.05e9 < forecast["peak_bytes"] - before < 0.5e9
    assert result["stopcode"] == 108 and 250 <= result["iterdone"] <= 400  # gain errors of 1 % leave structure
    assert images["model"].sum() == pytest.approx(12.01, abs=0.15)
    assert module.snr_at_scale(truth, images["model"], 4) == pytest.approx(20.9, abs=0.5)
    assert images["image"].max() / images["residual"].std() == pytest.approx(1555, rel=0.15)
    found = [block["noise_found"] for block in result["sara"]["blocks"]]
    assert len(found) == 6 and [min(found), max(found)] == pytest.approx([1.32, 1.65], abs=0.1)
    module.draw(tmp_path / "picture.png", truth, images)
    assert drawn(tmp_path / "picture.png")
    page_agrees("first_image", module.as_text(truth, forecast, result, images).split("\n", 1)[1])


@pytest.mark.slow
def test_cell_and_blocks(tmp_path):
    module = tutorial("cell_and_blocks")
    module.CELLS = (0.25, 0.2)
    cells, refusal, blocks, truth = module.main(tmp_path)
    assert [run.snr_beam for run in cells.values()] == pytest.approx([44.1, 44.1], abs=0.7)
    assert [run.snr_half for run in cells.values()] == pytest.approx([24.9, 25.5], abs=0.5)
    assert refusal == ("cell=0.4arcsec is too large for the longest baseline, 306.8 klambda: "
                       "use at most cell=0.3358arcsec")
    found = [block["noise_found"] for block in blocks[0].blocks]
    assert found == pytest.approx([1, 1, 1, 10, 10, 10], rel=0.06)
    assert [block["noise_found"] for block in blocks[1].blocks] == pytest.approx([7.07], rel=0.05)
    assert blocks[0].snr_beam - blocks[1].snr_beam == pytest.approx(4.8, abs=1)
    assert blocks[0].snr_half == pytest.approx(27.3, abs=0.7)
    module.draw(tmp_path / "picture.png", cells, truth)
    assert drawn(tmp_path / "picture.png")
    page_agrees("cell_and_blocks", module.as_text(cells, "", blocks, truth))


@pytest.mark.slow
def test_calibration_quality(tmp_path):
    module = tutorial("calibration_quality")
    before, after, picture = module.main(tmp_path)
    expected = np.array([1.0] * 6 + [2.0] * 6)
    assert [block["noise_measured"] for block in before] == pytest.approx(expected, rel=0.06)
    expected[3] = 1.73
    assert [block["noise_found"] for block in before] == pytest.approx(expected, rel=0.07)
    assert [block["noise_found"] for block in after] == pytest.approx(np.delete(expected, 3), rel=0.07)
    assert drawn(picture)
    page_agrees("calibration_quality", module.as_text(before, after))


@pytest.mark.slow
def test_compare_with_tclean(tmp_path):
    module = tutorial("compare_with_tclean")
    truth, measures, models = module.main(tmp_path)
    ours, theirs = measures["products"]["tsara"], measures["products"]["tclean"]
    assert [one["briggs"]["dr"] for one in (ours, theirs)] == pytest.approx([1910, 831], rel=0.15)
    assert [one["flux_jy"] for one in (ours, theirs)] == pytest.approx([12.12, 11.98], abs=0.15)
    cores = [one["regions"]["core"]["model_flux_jy"] for one in (ours, theirs)]
    assert cores == pytest.approx([0.119, 0.119], abs=0.008)
    assert measures["similarity"]["briggs"]["tsara|tclean"] == pytest.approx(32.3, abs=1.5)
    module.draw(tmp_path / "picture.png", truth, models)
    assert drawn(tmp_path / "picture.png")
    page_agrees("compare_with_tclean", module.as_text(truth, measures, models), rel=0.15)
    assert (tmp_path / "compared" / "report.html").exists()


@pytest.mark.slow
def test_line_cube(tmp_path):
    module = tutorial("line_cube")
    channels, measures = module.main(tmp_path)
    ours = [channel["products"]["tsara"]["flux_jy"] for channel in measures["channels"]]
    assert ours == pytest.approx(module.disc().sum(axis=(0, 1)), abs=0.01)
    assert [channel["velocity_km_s"] for channel in measures["channels"]] == pytest.approx(module.channel_velocities(),
                                                                                           abs=0.01)
    lines = [measures["products"][name]["line_flux"] for name in ("tsara", "tclean")]
    assert lines == pytest.approx([59.9, 58.9], abs=1.0)
    module.draw(tmp_path / "line_cube.png", tmp_path)
    assert drawn(tmp_path / "line_cube.png")
    page_agrees("line_cube", module.as_text(channels, measures), rel=0.15)


@pytest.mark.slow
def test_total_power(tmp_path):
    module = tutorial("total_power")
    truth, models, results = module.main(tmp_path)
    fluxes = [model.sum() / truth.sum() for model in models]
    assert fluxes[0] < 0.7 and fluxes[1] == pytest.approx(1, abs=0.02)
    fidelity = [module.snr_at_scale(truth, model, 14 / 3) for model in models]
    assert fidelity == pytest.approx([10.0, 34.5], abs=2)
    module.draw(tmp_path / "picture.png", truth, models)
    assert drawn(tmp_path / "picture.png")
    page_agrees("total_power", module.as_text(truth, models, results))
