"""Visibilities on the disk: all that is made of them piece by piece is what is made of them in memory."""

import errno
import gc
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from simulated_ms import pixels, simulate
from test_averaging import GRID, OPTIONS, SOURCES, fourier, observed, sky_of, tracks

from casa_sara import tsara
from casa_sara.casa.ms.data_volume import DataVolume
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.casa.ms.weights import dirty_image, imaging_weights, sampling_density
from casa_sara.data.averaging import Averaged
from casa_sara.data.blocks import snapshot_blocks
from casa_sara.data.noise import noise_from_differences
from casa_sara.data.outliers import find_wild
from casa_sara.data.visibilities import sort_into_blocks
from casa_sara.imaging import dry_run
from casa_sara.imaging.memory_forecast import Workload, forecast
from casa_sara.operators.piecewise import operator_on_disk
from casa_sara.operators.sky import sky_operator
from casa_sara.options import ImageGrid, Limits, Selection, SolverOptions, Weighting
from casa_sara.parallel.serial import SERIAL
from casa_sara.reconstruction import problem
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.problem import averaging_cell
from casa_sara.reconstruction.reconstruct import Control, reconstruct
from casa_sara.runtime.scratch import Scratch

PIECE = 997  # does not divide blocks, nor rows
SKY = [(1.0, 0.0, 0.0), (0.5, 2e-5, -1e-5), (0.3, -5e-5, 4e-5)]


def to_disk(data, folder):
    """The same samples, in files without a name."""
    scratch, columns = Scratch(str(folder), PIECE), {}
    for name, column in data._columns().items():
        columns[name] = scratch.empty(column.shape, column.dtype)
        columns[name][...] = column
    scratch.let_go()
    return replace(data, **columns, scratch=scratch)


# scratch

def test_arrays_on_the_disk_have_no_name_and_free_it_when_they_go(tmp_path):
    scratch = Scratch(str(tmp_path))
    array = scratch.empty((3, 1_000_000), np.float64)
    array[...] = np.arange(3_000_000).reshape(3, -1)
    view = array[1]
    scratch.let_go()
    assert not os.listdir(tmp_path) and view[5] == 1_000_005 and array[2, -1] == 2_999_999
    assert _mapped_in(tmp_path) == 1
    del array
    gc.collect()
    assert view[7] == 1_000_007  # as long as a view is left
    del view
    gc.collect()
    assert _mapped_in(tmp_path) == 0


def _mapped_in(folder):
    """How many files without a name of this folder are mapped."""
    return sum("(deleted)" in line and str(folder) in line for line in Path("/proc/self/maps").read_text().splitlines())


def test_a_disk_without_room_is_refused_by_name(tmp_path):
    with pytest.raises(OSError, match=r"GB left: should have 4e\+06 GB") as error:
        Scratch(str(tmp_path)).empty(10**15, np.float32)
    assert error.value.errno == errno.ENOSPC


# samples

@pytest.mark.parametrize("blocks", [0, 3, 7])
def test_blocks_and_noise_are_those_of_samples_in_memory(tmp_path, blocks):
    data, _ = tracks(integrations=60)
    data = data.part(np.random.default_rng(1).permutation(data.size))
    there = to_disk(data, tmp_path)
    (number, infos), (number_there, infos_there) = (snapshot_blocks(one, blocks) for one in (data, there))
    np.testing.assert_array_equal(number_there, number)
    assert infos_there == infos
    (here, offsets), (there, _) = (sort_into_blocks(one, number, len(infos)) for one in (data, there))
    assert there.scratch.on_disk and there.reach == here.reach and there.max_uv == here.max_uv
    for name, column in here._columns().items():
        np.testing.assert_array_equal(there._columns()[name], column)
    np.testing.assert_array_equal(*(noise_from_differences(one, offsets) for one in (here, there)))


def test_noise_of_large_blocks_is_that_of_some_baselines(tmp_path, monkeypatch):
    samples, _ = observed(20)
    monkeypatch.setattr("casa_sara.data.noise.MOST_SAMPLES", 3000)  # of 12,000
    there = to_disk(samples.data, tmp_path)
    every, some = (noise_from_differences(one, samples.offsets) for one in (samples.data, there))
    assert np.all(some != every)
    np.testing.assert_allclose(some, every, rtol=0.05)


def test_outliers_are_those_of_samples_in_memory(tmp_path):
    samples, _ = observed(40)
    data, offsets = samples.data, samples.offsets
    residual = data.vis * np.sqrt(data.weight)
    residual -= fourier(data.uvw, sky_of(SOURCES), GRID) * np.sqrt(data.weight)
    residual = residual.astype(np.complex64)
    for number in (3, 5000, 23_000):
        residual[number] += 500
        data.vis[number] += 500 / np.sqrt(data.weight[number])
    here, there = (find_wild(one, offsets, residual, 3.6) for one in (data, to_disk(data, tmp_path)))
    assert here.index.tolist() == there.index.tolist() == [3, 5000, 23_000]
    np.testing.assert_array_equal(there.predicted_jy, here.predicted_jy)


# averages

@pytest.mark.parametrize("finer", [[0, 0], [-2, 1]])
def test_averages_are_those_of_samples_in_memory(tmp_path, finer):
    data, offsets = observed(40)[0].data, np.array([0, 12_000, 24_000])
    model, multipliers, made = sky_of(SOURCES).astype(np.float32) * np.float32(0.9), np.array([0.3, 2.0]), []
    for one in (data, to_disk(data, tmp_path)):
        scale = np.sqrt(data.weight)
        if one.scratch.on_disk:
            whole = operator_on_disk(one.uvw, GRID, None, 1e-6, 1, one.scratch)
            operator, vis = whole.scaled(lambda piece, scale=scale: scale[piece]), None
        else:
            operator, vis = sky_operator(one.uvw, GRID, row_scale=scale), one.vis * scale
        found, uvw, _ = Averaged.of(one, offsets, averaging_cell(GRID), np.array(finer), vis, operator)
        predicted = np.zeros(found.cells.size, np.complex64)
        scatter, gradient = found.renew(model, predicted, multipliers)
        made.append((found, uvw, predicted, scatter, gradient, found.whitened_mean(found.whitened)))
    (here, *wanted), (there, *got) = made
    assert there.enlarged == here.enlarged == (min(finer) < 0) and there.costly and not here.costly
    np.testing.assert_array_equal(there.cells.offsets, here.cells.offsets)
    for one, other, tolerance in zip(got, wanted, (1e-12, 2e-5, 1e-5, 2e-5, 1e-6)):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=tolerance * np.abs(other).max())
    left = data.vis * scale - sky_operator(data.uvw, GRID, row_scale=scale).forward(model)
    explicit = sky_operator(data.uvw, GRID, row_scale=scale).adjoint(
        (left * np.repeat(multipliers, np.diff(offsets))).astype(np.complex64))
    np.testing.assert_allclose(wanted[3], explicit, atol=2e-5 * np.abs(explicit).max())


def enlarged(monkeypatch, doublings):
    """Enlarge the cells of every problem from now on."""
    averages = problem._averages
    monkeypatch.setattr(problem, "_averages", lambda average, samples, finer, *others: averages(
        average, samples, np.full(2, -doublings) if finer is None else finer, *others))


@pytest.mark.slow
@pytest.mark.parametrize("doublings", [1, 2])
def test_the_solution_of_enlarged_cells_is_that_of_all_samples_within_a_tenth_of_the_noise(monkeypatch, doublings):
    """Points in the centre and in the corners, of which averages alone have other noise: by up to 0.4 of itself."""
    support, different = sky_of(SOURCES) > 0, []
    enlarged(monkeypatch, doublings)
    for seed in range(2):
        samples, noise = observed(20, seed)
        every = reconstruct(samples, GRID, replace(OPTIONS, averaging=False), support=support)
        few = reconstruct(samples, GRID, OPTIONS, support=support)
        assert few.averaging["averages"] < 0.045 * samples.data.size and few.averaging["halvings"] == [0, 0]
        assert few.averaging["cell_wavelengths"][0] == 2**doublings * averaging_cell(GRID)[1]
        different.append([(few.model - every.model)[place] / noise for place in SOURCES])
        np.testing.assert_allclose(few.residual_norms, every.residual_norms, rtol=1e-4)
    assert np.sqrt(np.mean(np.square(different), axis=0)).max() < 0.1


def test_the_correction_follows_the_multipliers(monkeypatch):
    """It is a part of Σ_j λ_j Φ_j†(y_j − Φ_j x): twice as large with twice the multipliers, and with twice κ."""
    enlarged(monkeypatch, 1)
    seen = []

    def then(ppd, bounds, record):
        for change in (lambda: None, lambda: ppd.penalise(2 * ppd.multipliers), lambda: ppd.rescale(2 * ppd.threshold)):
            change()
            seen.append((ppd.correction.copy(), ppd.multipliers.copy()))

    reconstruct(observed(20)[0], GRID, replace(OPTIONS, niter=20), control=Control(then=then))
    (first, multipliers), *others = seen
    assert np.abs(first).max() > 0
    for factor, (correction, now) in zip((2, 4), others):
        np.testing.assert_allclose(now, factor * multipliers, rtol=1e-12)
        np.testing.assert_allclose(correction, factor * first, rtol=1e-6)


def test_cells_are_enlarged_where_there_are_more_averages_than_pixels(monkeypatch):
    samples, _ = observed(20)
    told = []
    monkeypatch.setattr("casa_sara.reconstruction.problem.prod", lambda shape: 1000)
    found = reconstruct(samples, GRID, replace(OPTIONS, niter=2), control=Control(tell=told.append))
    side = 2 * averaging_cell(GRID)[1]
    assert found.averaging["averages"] == 924 and found.averaging["cell_wavelengths"][0] == side
    assert f"uv cells of {side:.4g} x" in told[0]
    monkeypatch.setattr("casa_sara.reconstruction.reconstruct.jackknife_groups", lambda blocks: 2)
    monkeypatch.setattr("casa_sara.reconstruction.solution.jackknife_groups", lambda blocks: 2)
    reconstruct(samples, GRID, replace(OPTIONS, niter=2, jackknife=True), control=Control(tell=told.append))
    assert f"averaged to 1722 for the solver, within each block and uv cells of {side / 2:.4g} x" in told[1]


def test_a_solution_on_the_disk_goes_on_and_is_that_of_all_samples(monkeypatch, tmp_path):
    """Stopped in the midst of a problem, it ends at the same image, bit by bit; no file is left."""
    samples, noise = observed(20)
    there = replace(samples, data=to_disk(samples.data, tmp_path))
    support, path, reached = sky_of(SOURCES) > 0, str(tmp_path / "c"), [0]

    def run(stop_at=None):
        checkpoint = Checkpoint(path, "1", {})
        if stop_at is None:
            checkpoint.open()
        return reconstruct(there, GRID, OPTIONS, support=support, control=Control(
            lambda ppd, record: reached.__setitem__(0, ppd.iteration), lambda: reached[0] == stop_at, checkpoint))

    every = reconstruct(samples, GRID, replace(OPTIONS, averaging=False), support=support)
    wanted = reconstruct(there, GRID, OPTIONS, support=support)
    assert wanted.averaging["averages"] == 505 and len(wanted.record.reweightings) > 4
    different = [(wanted.model - every.model)[place] / noise for place in SOURCES]
    assert np.abs(different).max() < 0.1
    np.testing.assert_allclose(wanted.residual_norms, every.residual_norms, rtol=1e-3)
    run(50)
    assert os.listdir(tmp_path) == ["c"]
    found = run()
    np.testing.assert_array_equal(found.model, wanted.model)
    assert found.record.resumed == [50]


# MeasurementSets and the task

@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    return str(simulate(folder / "a.ms", sky=SKY, noise=0.02, antennas=12, scans=2, scan_seconds=240.0,
                        spws=(("8.4GHz", "2MHz", 4),)))


def test_reading_weights_and_images_are_those_of_samples_in_memory(vis, tmp_path):
    selection = Selection(vis=(vis,), datacolumn="data")
    here = read_visibilities(selection)
    there = read_visibilities(selection, scratch=Scratch(str(tmp_path), PIECE))
    assert there.scratch.on_disk and not os.listdir(tmp_path)
    for name, column in here._columns().items():
        np.testing.assert_array_equal(there._columns()[name], column)
    cell = 0.2 / here.max_uv
    grid = ImageGrid((64, 48), (cell, cell))
    np.testing.assert_allclose(sampling_density(there, selection, grid), sampling_density(here, None, grid), rtol=1e-6)
    for weighting in (Weighting(), Weighting("uniform"), Weighting("briggs", uvtaper=("5klambda",))):
        weights = [imaging_weights(one, grid, weighting) for one in (here, there)]
        np.testing.assert_allclose(*weights, rtol=1e-6)
    operator = operator_on_disk(there.uvw, grid, None, 1e-6, 1, there.scratch)
    assert operator is operator_on_disk(there.uvw, grid, None, 1e-6, 1, there.scratch)
    wanted = dirty_image(sky_operator(here.uvw, grid), here.vis, weights[0])
    for _ in range(2):  # made, and kept
        image = dirty_image(operator, lambda piece, _: there.vis[piece], weights[1])
        np.testing.assert_allclose(image, wanted, atol=1e-5 * np.abs(wanted).max())


@pytest.mark.parametrize("options", [
    {}, pytest.param(dict(gridder="wproject", spectralindex=-0.7, weighting="briggs"), marks=pytest.mark.slow)],
                         ids=["plane", "w-term and spectrum"])
def test_the_task_makes_the_same_images(vis, tmp_path, monkeypatch, options):
    common = dict(vis=vis, imsize=64, cell="0.515662arcsec", datacolumn="data", blocks=2, fullsummary=True)
    common |= options
    here = tsara(imagename=str(tmp_path / "here"), **common)
    monkeypatch.setattr(dry_run, "MANY", 1)
    monkeypatch.setattr(dry_run, "Scratch", lambda folder: Scratch(folder, PIECE))
    there = tsara(imagename=str(tmp_path / "there"), **common)
    assert there["sara"]["averaging"]["averages"] < here["sara"]["visibilities"] / 2
    assert here["sara"]["visibilities"] == there["sara"]["visibilities"]
    np.testing.assert_allclose(*([block["noise_found"] for block in one["sara"]["blocks"]] for one in (there, here)),
                               rtol=0.02)
    for name, tolerance in (("psf", 1e-5), ("residual", 1e-3), ("image", 1e-3)):
        images = [pixels(str(tmp_path / f"{one}.{name}")) for one in ("here", "there")]
        np.testing.assert_allclose(*images, atol=tolerance * max(np.abs(images[0]).max(), 1.0))
    assert {name.split(".")[0] for name in os.listdir(tmp_path)} == {"here", "there"}


def test_forecast_of_many_visibilities():
    """10⁸ of 12 blocks, as docs/validation.md has them, fit into 4 GB on the disk only."""
    grid = ImageGrid((1024, 1024), (2.9e-7, 2.9e-7))
    volume = DataVolume(100_000_000, (1.05e6, 1.05e6))
    work = Workload.of(volume, grid, SolverOptions())
    needed = [forecast(one, 400_000_000, 10**11).needed for one in (work, replace(work, on_disk=True, blocks=12))]
    assert needed[0] > 12e9 and 1.5e9 < needed[1] < 3.6e9
    assert forecast(replace(work, on_disk=True, blocks=1), 0, 0).needed > 7e9  # a block is worked on at a time


@pytest.mark.parametrize(("changed", "on_disk"), [
    ({}, True), (dict(specmode="cube"), False), (dict(gridder="mosaic"), False), (dict(nterms=3), False)])
def test_what_cannot_be_on_the_disk_is_in_memory(changed, on_disk):
    grid = replace(ImageGrid((64, 64), (1e-6, 1e-6)), **changed)
    assert dry_run._may_be_on_disk(grid, SolverOptions(), Limits(), SERIAL) is on_disk
    for options in (SolverOptions(method="dabbech2018"), SolverOptions(databound="weights"),
                    SolverOptions(gainfit=True)):
        assert not dry_run._may_be_on_disk(grid, options, Limits(), SERIAL)
    assert not dry_run._may_be_on_disk(grid, SolverOptions(), Limits(report=True), SERIAL)


def test_what_does_not_fit_into_memory_goes_to_the_disk(vis, monkeypatch):
    selection, grid = Selection(vis=(vis,), datacolumn="data"), ImageGrid((64, 64), (2.5e-6, 2.5e-6))
    monkeypatch.setattr(dry_run, "LEAST", 1)
    found, _ = dry_run.forecast_run(selection, grid, SolverOptions(), Limits())
    assert not found.workload.on_disk
    found, _ = dry_run.forecast_run(selection, grid, SolverOptions(), Limits(maxmem_gb=0.01), blocks=3)
    assert found.workload.on_disk and found.workload.blocks == 3 and not found.fits
    with pytest.raises(OSError, match="GB of disk|GB left"):
        dry_run.scratch_of("there", replace(found.workload, samples=10**14))
