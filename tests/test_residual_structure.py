"""The last problem goes on while the residual holds structure that changes."""

from dataclasses import replace

import numpy as np
import pytest
from test_averaging import fourier
from test_gain_errors import GRID, snapshots

from casa_sara.options import SolverOptions
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.solver import reweighting
from casa_sara.solver.reweighting import Schedule

INTERVAL = Schedule().interval


def observed(integrations=4, noise=0.03):
    """Two sources and noise."""
    data, offsets = snapshots(integrations=integrations)
    image = np.zeros(GRID.shape)
    image[30:34, 28:33], image[44, 20] = 0.1, 0.5
    drawn = noise * (np.random.default_rng(1).standard_normal((data.size, 2)) @ [1, 1j])
    vis = (fourier(data.uvw, image, GRID) + drawn).astype(np.complex64)
    data = replace(data, vis=vis, weight=np.full(data.size, noise**-2, np.float32))
    return Samples(data, offsets, np.ones(data.size, np.float32))


@pytest.mark.parametrize(("structures", "intervals"), [
    ([4.9], 0),  # noise
    ([20.0, 19.6], 1),  # structure that the data leave
    ([20.0, 15.0, 10.0, 9.9], 3),
    ([20.0, 15.0, 4.0], 2),
    ([8.0, 9.0, 9.1], 2),  # more before it is less
    ([20.0, 25.0, 15.0, 4.0], 3),
])
def test_it_goes_on_an_interval_at_a_time(structures, intervals, monkeypatch):
    samples, options = observed(), SolverOptions(nthreads=1)
    asked, values = [], iter([0.0])
    monkeypatch.setattr(reweighting, "structure_of",
                        lambda ppd, bounds: asked.append(ppd.iteration) or next(values))
    before = reconstruct(samples, GRID, options).record.iteration[-1]
    assert asked == [before]
    asked.clear()
    values = iter(structures)
    after = reconstruct(samples, GRID, options).record.iteration[-1]
    assert asked[0] == before and asked[-1] == after and len(asked) == len(structures) == intervals + 1
    assert all(INTERVAL <= gap <= INTERVAL + 5 for gap in np.diff(asked))


def test_it_does_not_go_on_for_ever(monkeypatch):
    value = [1e9]

    def falling(ppd, bounds):
        value[0] *= 0.5
        return 10 + value[0]

    monkeypatch.setattr(reweighting, "LONGEST", 8)
    monkeypatch.setattr(reweighting, "structure_of", falling)
    record = reconstruct(observed(), GRID, SolverOptions(nthreads=1)).record
    last = record.iteration[-1] - record.reweightings[-1]["iteration"]
    assert 8 * INTERVAL <= last <= 10 * INTERVAL + 5
    monkeypatch.setattr(reweighting, "structure_of", lambda ppd, bounds: pytest.fail("nothing confines the model"))
    reconstruct(observed(), GRID, SolverOptions(nthreads=1, significance=0))


@pytest.mark.parametrize("averaging", [True, False])
def test_a_last_problem_that_went_on_is_continued_to_the_same_image(averaging, monkeypatch, tmp_path):
    monkeypatch.setattr(reweighting, "LONGEST", 8)
    monkeypatch.setattr(reweighting, "structure_of", lambda ppd, bounds: 1e3 * 0.99**ppd.iteration)
    samples, options = observed(integrations=40), SolverOptions(nthreads=1, averaging=averaging)
    path, reached = str(tmp_path / "c"), [0]

    def run(stop_at=None):
        checkpoint = Checkpoint(path, "1", {})
        if stop_at is None:
            checkpoint.open()
        return reconstruct(samples, GRID, options, control=Control(
            lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))

    wanted = reconstruct(samples, GRID, options)
    assert bool(wanted.averaging) is averaging
    end = wanted.record.iteration[-1]
    run(end - 40)
    found = run()
    assert found.record.resumed == [end - 40] and found.record.iteration[-1] == end
    np.testing.assert_array_equal(found.model, wanted.model)
