"""Spectral cubes: tclean's axis and dirty cube, lines recovered, channels kept through a stop, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from simulated_ms import column, edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.casa.images.image_plane import define_image_plane
from casa_sara.casa.images.spectral_axis import (
    SpectralAxis,
    channel_number,
    channels_of,
    samples_of_channels,
    spectral_axis,
)
from casa_sara.casa.ms.read import read_visibilities
from casa_sara.imaging import cube_planes
from casa_sara.imaging.time_forecast import STARTING, Timing
from casa_sara.options import ImageGrid, Selection
from casa_sara.solver.record import CONVERGED, TIME_LIMIT

ARCSEC = np.pi / 180 / 3600
GRID = dict(imsize=[64, 60], cell="10arcsec", datacolumn="data", specmode="cube")
FAST = dict(nthreads=1, wavelets=["dirac", "db1", "db4"])
LINE = np.array([0.1, 0.4, 1.0, 0.7, 0.2, 0.1])  # Jy of the source in each channel
BLANK = 3
AXES = {
    "default": {},
    "channels": dict(start=2, width=2, nchan=3),
    "falling channels": dict(start=5, width=-1, nchan=4),
    "frequency": dict(start="1.4199GHz", width="70kHz", nchan=6, outframe="BARY"),
    "falling frequency": dict(start="1.4202GHz", width="-50kHz", nchan=3, outframe="TOPO"),
    "radio velocity": dict(start="0km/s", width="12km/s", nchan=4, restfreq="1.4201GHz"),
    "optical velocity": dict(start="0km/s", width="11km/s", nchan=5, restfreq="1.4201GHz", veltype="optical"),
    "beyond the data": dict(start="1.4197GHz", nchan=12, outframe="LSRD"),
}


@pytest.fixture(scope="module")
def drifting(tmp_path_factory):
    """Scans hours apart in channels so narrow that they move by several in LSRK; two fields."""
    fields = ("J2000 19h59m28.5s +40d44m02s", "J2000 19h59m58.5s +40d44m02s")
    path = tmp_path_factory.mktemp("cube") / "drifting.ms"
    return simulate(path, frame="TOPO", spws=(("1.42GHz", "0.3kHz", 8),), scans=4, scan_seconds=20.0,
                    spacing_seconds=7200.0, hour_angle=-3.0, antennas=6, fields=fields)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """Channels of 50 kHz in the frame of the telescope; a source with a line, and one channel all flagged."""
    name = simulate(tmp_path_factory.mktemp("cube") / "line.ms", frame="TOPO", spws=(("1.42GHz", "50kHz", 6),), scans=3,
                    antennas=12, noise=0.02, sky=((1.0, 20 * ARCSEC, -30 * ARCSEC),), columns=("DATA", "MODEL_DATA"))
    model = column(name, "MODEL_DATA")
    edit(name, "DATA", lambda data: data + (LINE[:, None] - 1) * model)
    edit(name, "FLAG", lambda flag: flag | (np.arange(6) == BLANK)[:, None])
    return name


def image(name):
    """Pixels and mask (nx, ny, nchan), the spectral axis, unit and beams of an image."""
    ia = casatools.image()
    ia.open(name)
    try:
        beams = [one["*0"] for one in ia.restoringbeam().get("beams", {}).values()]
        return (ia.getchunk()[:, :, 0], ia.getchunk(getmask=True)[:, :, 0], ia.coordsys().torecord()["spectral2"],
                ia.brightnessunit(), [(one["major"]["value"], one["minor"]["value"]) for one in beams])
    finally:
        ia.close()


def clean_dirty(vis, name, **options):
    """Dirty images of tclean."""
    import casatasks

    casatasks.tclean(vis=vis, imagename=name, imsize=GRID["imsize"], cell=GRID["cell"], datacolumn="data", niter=0,
                     specmode="cube", interpolation="nearest", **options)


def grid_of(**options):
    restfreq = tuple(filter(None, [options.pop("restfreq", "")]))
    return ImageGrid(tuple(GRID["imsize"]), (10 * ARCSEC,) * 2, specmode="cube", restfreq=restfreq, **options)


@pytest.mark.parametrize("name", AXES)
def test_axis_is_tcleans(line, name):
    """To the last bit, and each channel holds the samples that tclean has in it."""
    clean_dirty(line, "clean", restoration=False, **AXES[name])
    sumwt, _, theirs = image("clean.sumwt")[:3]
    selection = Selection((line,), datacolumn="data")
    data = read_visibilities(selection)
    plane = define_image_plane(data, selection, grid_of(**AXES[name]))
    assert str(plane.csys["spectral2"]) == str(theirs)
    channel = channels_of(data, selection, SpectralAxis.of(plane))
    weights = np.bincount(channel[channel >= 0], data.imaging_weight[channel >= 0], plane.channels)
    assert np.allclose(2 * weights, sumwt.ravel(), rtol=1e-6) and weights.any()


@pytest.mark.parametrize("outframe, width", [("LSRK", 1), ("TOPO", 1), ("BARY", 2), ("CMB", 3)])
def test_samples_follow_the_earth(drifting, outframe, width):
    clean_dirty(drifting, "clean", restoration=False, outframe=outframe, width=width)
    selection = Selection((drifting,))
    axis = spectral_axis(selection, grid_of(outframe=outframe, width=width))
    data = read_visibilities(selection)
    channel = channels_of(data, selection, axis)
    assert axis.frame == outframe
    counts = 2 * np.bincount(channel[channel >= 0], minlength=axis.size)
    assert np.array_equal(counts, image("clean.sumwt")[0].ravel())
    assert counts.min() < counts.max()  # the drift is seen
    assert samples_of_channels(selection, axis).sum() == data.size * axis.size * width // 8  # before it is


def test_nearest_channel_on_a_falling_axis():
    centres = np.array([105.0, 104.0, 103.0, 102.0, 101.0])
    axis = SpectralAxis(centres[1:-1], centres, "LSRK")
    lsrk_hz = np.array([104.6, 104.5, 104.4, 102.6, 102.4, 101.6, 101.4, 90.0])
    assert axis.nearest(lsrk_hz).tolist() == [-1, 0, 0, 1, 2, 2, -1, -1]


@pytest.mark.parametrize("options", [
    {}, dict(weighting="uniform", width=2, outframe="BARY"),
    dict(weighting="briggs", robust=0.0, start="1.4202GHz", width="-50kHz", nchan=6, restoringbeam="common"),
], ids=["natural", "uniform", "briggs"])  # fmt: skip
def test_dirty_cube_is_tcleans(line, options):
    clean_dirty(line, "clean", **options)
    tsara(vis=line, imagename="ours", niter=0, **GRID, **options)
    sumwt, theirs = image("ours.sumwt")[0].ravel(), image("clean.sumwt")[0].ravel()
    assert np.allclose(sumwt, theirs, rtol=1e-5)
    filled = sumwt > 0
    inner = (slice(16, 48), slice(15, 45), filled)
    for product in ("psf", "residual", "image", "pb"):
        ours, clean = image(f"ours.{product}"), image(f"clean.{product}")
        error, level = (np.mean(pixels[inner] ** 2, axis=(0, 1)) for pixels in (ours[0] - clean[0], clean[0]))
        rms = np.sqrt(error / level)
        assert rms.max() < 1.5e-3, product  # tclean rounds u and v
        assert ours[3] == clean[3]
        assert len(ours[4]) == len(clean[4])
        if clean[4]:
            one_or_all = filled if len(clean[4]) == filled.size else slice(None)
            assert np.allclose(np.array(ours[4])[one_or_all], np.array(clean[4])[one_or_all], rtol=1e-3)
        assert ours[1][:, :, filled].all()
    for product in ("residual", "image"):
        pixels, mask = image(f"ours.{product}")[:2]
        assert not mask[:, :, ~filled].any() and not pixels[:, :, ~filled].any()


@pytest.fixture(scope="module")
def solved(line, tmp_path_factory):
    """A whole run, for what it finds and for those that are stopped."""
    root = str(tmp_path_factory.mktemp("solved") / "run")
    return root, tsara(vis=line, imagename=root, width=1, start=1, nchan=4, fullsummary=True, **GRID, **FAST)


def test_line_is_recovered(solved):
    root, result = solved
    model, mask = image(root + ".model")[0], image(root + ".image")[1]
    flux = model.sum(axis=(0, 1))
    expected = np.where(np.arange(1, 5) == BLANK, 0.0, LINE[1:5])
    assert np.abs(flux - expected).max() < 0.02
    assert flux[2] == 0 and not mask[:, :, 2].any() and mask[:, :, 1].all()
    assert "blank" in " ".join(result["sara"]["notes"])
    assert result["stopcode"] == CONVERGED
    minor, channels = result["summaryminor"][0], result["sara"]["channels"]
    assert sorted(minor) == [0, 1, 3]
    assert sum(minor[k][0]["iterDone"][-1] for k in minor) == result["iterdone"] == result["summarymajor"][-1]
    assert np.allclose([minor[k][0]["modelFlux"][0] for k in minor], flux[[0, 1, 3]])
    assert [channel["blank"] for channel in channels] == [False, False, True, False]
    for k in minor:
        assert channels[k]["stopcode"] == minor[k][0]["stopCode"]
        assert all(0.7 < block["noise_found"] < 1.3 and block["l2_bound"] > 0 for block in channels[k]["blocks"])
        assert len(channels[k]["history"]["iteration"]) == minor[k][0]["iterDone"][-1]
    with open(root + ".sara.json") as file:
        record = json.load(file)
    assert [one["frequency_hz"] for one in record["channels"]] == [one["frequency_hz"] for one in channels]
    assert record["outframe"] == "LSRK"


@pytest.mark.slow
@pytest.mark.parametrize("asked", [1, 140])
def test_stopped_cube_goes_on_to_the_same_images(line, solved, monkeypatch, asked):
    """Stopped in the fit that comes first (at most 80 steps), or in the iterations of the second channel."""
    solve, calls = cube_planes.solve_image, []

    class Deadline:
        def __init__(self, last):
            self.asked, self.last = 0, last

        def near(self):
            self.asked += 1
            return self.asked > self.last

    def stopping(*args):
        *others, watch, support = args
        calls.append(1)
        return solve(*others, replace(watch, deadline=Deadline(asked if len(calls) == 2 else 10**9)), support)

    options = dict(vis=line, imagename="run", width=1, start=1, nchan=4, **GRID, **FAST)
    with monkeypatch.context() as patch:
        patch.setattr(cube_planes, "solve_image", stopping)
        result = tsara(**options)
    assert len(calls) == 2 and result["stopcode"] == TIME_LIMIT
    codes = {k: one[0]["stopCode"] for k, one in result["summaryminor"][0].items()}
    assert codes == {0: CONVERGED, 1: TIME_LIMIT, 3: TIME_LIMIT}
    flux = image("run.model")[0].sum(axis=(0, 1))
    assert flux[0] > 0 and flux[3] == 0
    assert image("run.residual")[0][:, :, 3].any()  # dirty
    goes_on = []
    monkeypatch.setattr(cube_planes, "solve_image",
                        lambda *args: goes_on.append(args[-2].checkpoint.state is not None) or solve(*args))
    again = tsara(restart=True, **options)
    assert goes_on == [asked > 100, False]
    for product in ("model", "residual", "image", "psf"):
        assert np.array_equal(image(f"run.{product}")[0], image(f"{solved[0]}.{product}")[0]), product
    assert again["iterdone"] == solved[1]["iterdone"]
    with pytest.raises(FileExistsError, match="exist"):
        tsara(**options)


def test_model_cube_to_start_from(line, solved):
    options = dict(vis=line, width=1, start=1, nchan=4, **GRID, **FAST)
    tsara(imagename="from", startmodel=solved[0] + ".model", niter=0, **options)
    model = image(solved[0] + ".model")[0]
    assert np.array_equal(image("from.model")[0], model)
    assert np.array_equal(image("from.residual")[0], image(solved[0] + ".residual")[0])
    with pytest.raises(ValueError, match=r"startmodel = .* has the shape .*: it takes one Stokes, one channel, or 3"):
        tsara(imagename="other", startmodel=solved[0] + ".model", niter=0, **options | dict(nchan=3))


def test_channels_take_their_time_each():
    timing = Timing(1.0, 2.0, 0.1, 0.2, 0.3, 4.0, iterations=100, reweightings=5)
    assert replace(timing, channels=4).total - STARTING - 1 == pytest.approx(4 * (timing.total - STARTING - 1))


def test_dry_run_counts_the_channels(line):
    options = dict(vis=line, imagename="dry", dryrun=True, maxmem=3.0, **FAST)
    one = tsara(nchan=1, **GRID, **options)["forecast"]
    many = tsara(nchan=4, start=0, **GRID, **options)["forecast"]
    assert many["nchan"] == 4 and many["fits"]
    seconds = many["seconds"]
    assert seconds["total"] - seconds["reading"] > 4 * (seconds["building"] + seconds["writing"])
    assert many["memory_bytes"]["writing"]["cubes"] == 4 * one["memory_bytes"]["writing"]["cubes"]
    huge = tsara(**GRID | dict(imsize=2048), nchan=100, start="1.42GHz", **options)["forecast"]
    assert not huge["fits"] and "nchan up to" in huge["reason"]


@pytest.mark.parametrize("options, words", [
    (dict(start="2GHz", nchan=2), "start = '2GHz'.*no data are in these channels"),
    (dict(start=77), "start = 77: the last channel that is selected is 5"),
    (dict(start=-1), "start = -1: channels"),
    (dict(start="fast"), "start = 'fast' is neither a channel number, a frequency nor a velocity"),
    (dict(start="1.42GHz", width="2km/s"), "start = '1.42GHz' and width = '2km/s': should both"),
    (dict(start="1.42GHz", width=2), "should both"),
    (dict(width=0), "width = 0"),
    (dict(nchan=0), "nchan = 0"),
    (dict(restfreq="fast"), "restfreq = 'fast' is not a frequency"),
    (dict(outframe="MOON"), "outframe = 'MOON'"),
    (dict(interpolation="linear"), "interpolation = 'linear': should be .*'nearest'"),
    (dict(perchanweightdensity=False), "perchanweightdensity = False"),
    (dict(reffreq="1.42GHz"), "reffreq = '1.42GHz' has no effect with specmode = 'cube'"),
    (dict(specmode="mfs", nchan=3), "nchan = 3 has no effect with specmode = 'mfs'"),
    (dict(weighting="briggs", npixels=4), "npixels = 4 with specmode = 'cube'"),
    (dict(databound="fixed", l2bound=[1.0, 1.1, 1.2, 1.3]), r"channel 0, .*l2bound = .*there are 1 blocks"),
])  # fmt: skip
def test_refusals(line, options, words):
    with pytest.raises(ValueError, match=words):
        tsara(**dict(vis=line, imagename="no", **GRID) | options)


def test_channel_numbers_may_be_text():
    assert [channel_number(value, "start") for value in ("", 3, "3", "-2", "1.4GHz")] == ["", 3, 3, -2, "1.4GHz"]
