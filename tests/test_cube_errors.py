"""Errors of cubes: those of each channel by itself, units and beams, an end within the draws, and the forecast."""

import json
import os

import numpy as np
import pytest
from simulated_ms import pixels
from test_cube import BLANK, FAST, GRID, image, line

from casa_sara import tsara
from casa_sara.reconstruction.draws import Draws
from casa_sara.runtime.deadline import Deadline
from casa_sara.solver.record import CONVERGED, TIME_LIMIT

__all__ = ["line"]  # a fixture

ASKED = dict(start=1, nchan=3, ndraws=2, jackknife=True, blocks=4)
KINDS = (".model.error", ".image.error", ".image.jackknife")


@pytest.fixture(scope="module")
def drawn(line, tmp_path_factory):
    name = str(tmp_path_factory.mktemp("cube") / "drawn")
    return name, tsara(vis=line, imagename=name, **GRID, **FAST, **ASKED)


def test_errors_are_those_of_each_channel(drawn, line, tmp_path):
    name, result = drawn
    beams = image(name + ".image")[4]
    for kind, unit in zip(KINDS, ("Jy/pixel", "Jy/beam", "Jy/beam")):
        found = image(name + kind)
        assert found[3] == unit and found[0].shape[2] == 3
        assert found[4] == ([] if kind == ".model.error" else beams) and found[2] == image(name + ".image")[2]
        assert not found[0][..., BLANK - 1].any() and found[0][..., :2].any(axis=(0, 1)).all()
        assert np.array_equal(found[1], image(name + (".model" if kind == ".model.error" else ".image"))[1])
    made = [channel["draws"] for channel in result["sara"]["channels"] if "draws" in channel]
    assert made == [dict(asked=2, made=2)] * 2
    # the data of the channel of the peak as a continuum image
    alone = dict(ASKED, spw="0:2", specmode="mfs")
    del alone["start"], alone["nchan"]
    tsara(vis=line, imagename=str(tmp_path / "one"), **GRID | FAST | alone)
    for kind in KINDS:
        one, channel = pixels(str(tmp_path / "one") + kind), image(name + kind)[0][..., 1]
        assert np.abs(one - channel).max() < 0.02 * one.max() > 0


@pytest.mark.slow
def test_a_run_stopped_within_the_draws_goes_on(drawn, line, tmp_path, monkeypatch):
    """The first channel is complete, the second has some of its draws."""
    name, made, add = str(tmp_path / "stopped"), [], Draws.add
    monkeypatch.setattr(Draws, "add", lambda self, difference: made.append(add(self, difference)))
    monkeypatch.setattr(Deadline, "near", lambda self: len(made) > 6)  # those of the first channel, and one more
    result = tsara(vis=line, imagename=name, **GRID, **FAST, **ASKED)
    monkeypatch.undo()
    assert result["stopcode"] == TIME_LIMIT and os.path.exists(name + ".checkpoint")
    channels = result["sara"]["channels"]
    assert channels[0]["draws"] == dict(asked=2, made=2) and channels[0]["jackknife"] == dict(groups=4, made=4)
    assert channels[1]["stopcode"] == CONVERGED and channels[1]["jackknife"] == dict(groups=4, made=1)
    result = tsara(vis=line, imagename=name, restart=True, **GRID, **FAST, **ASKED)
    assert result["stopcode"] == CONVERGED and not os.path.exists(name + ".checkpoint")
    for kind in (".model", *KINDS):
        assert np.array_equal(image(name + kind)[0], image(drawn[0] + kind)[0])


@pytest.mark.slow
def test_forecast_counts_the_draws(line):
    said = [tsara(vis=line, imagename="dry", dryrun=True, **GRID, **FAST, **ASKED | changes)["forecast"]
            for changes in (dict(), dict(ndraws=0, jackknife=False))]
    drawing = said[0]["seconds"]["drawing"]
    assert said[1]["seconds"]["drawing"] == 0 < drawing
    assert said[0]["seconds"]["total"] > 3 * drawing
    assert said[0]["memory_bytes"]["writing"]["cubes"] > said[1]["memory_bytes"]["writing"]["cubes"]


@pytest.mark.parametrize("options, words", [
    (dict(restoringbeam="common"), "ndraws = 2 with restoringbeam = 'common'.*; should be '', or the beam itself"),
    (dict(blocks=2), "channel 0, .*jackknife = True: there are 2 blocks"),
    (dict(niter=0), "ndraws = 2 with niter = 0")])
def test_what_errors_of_cubes_do_not_have(line, tmp_path, options, words):
    with pytest.raises(ValueError, match=words):
        tsara(**dict(vis=line, imagename=str(tmp_path / "no"), **GRID, **ASKED) | options)
    assert not json.dumps(os.listdir(tmp_path)).count("no.")
