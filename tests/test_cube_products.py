"""What a cube has besides its channels: masks, restoring beams, Stokes, and its model in MODEL_DATA; against tclean."""

import shutil

import numpy as np
import pytest
from simulated_ms import column, edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara
from casa_sara.solver.record import CONVERGED, EMPTY_MASK

ARCSEC = np.pi / 180 / 3600
GRID = dict(imsize=[64, 60], cell="10arcsec", datacolumn="data", specmode="cube")
FAST = dict(nthreads=1, wavelets=["dirac", "db1", "db4"])
LINE = np.array([0.0, 0.5, 1.0, 0.3])  # Jy in each channel, at pixel (30, 27): 20 arcsec east, 30 south of (32, 30)


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A point source with a line, in four channels."""
    name = simulate(tmp_path_factory.mktemp("cube") / "line.ms", frame="LSRK", spws=(("1.42GHz", "50kHz", 4),), scans=2,
                    antennas=10, noise=0.02, sky=((1.0, 20 * ARCSEC, -30 * ARCSEC),), columns=("DATA", "MODEL_DATA"))
    model = column(name, "MODEL_DATA")
    edit(name, "DATA", lambda data: data + (LINE[:, None] - 1) * model)
    return name


def image(name):
    """Pixels (nx, ny, nchan) and beams of an image."""
    ia = casatools.image()
    ia.open(name)
    try:
        beams = [one["*0"] for one in ia.restoringbeam().get("beams", {}).values()] or [ia.restoringbeam()]
        return ia.getchunk()[:, :, 0], [(one["major"]["value"], one["minor"]["value"]) for one in beams if one]
    finally:
        ia.close()


def tclean(vis, name, niter=0, **options):
    import casatasks

    casatasks.tclean(vis=vis, imagename=name, imsize=GRID["imsize"], cell=GRID["cell"], datacolumn="data", niter=niter,
                     specmode="cube", interpolation="nearest", **options)


def mask_image(name, planes, like, fits=False):
    """Write planes (nx, ny, nchan) of ones and zeros on the axes of a cube."""
    shutil.copytree(like, name)
    ia = casatools.image()
    ia.open(name)
    ia.putchunk(planes[:, :, None].astype(np.float32))
    if fits:
        ia.tofits(name + ".fits")
    ia.close()
    return name + ".fits" * fits


@pytest.fixture(scope="module")
def dirty(line, tmp_path_factory):
    root = str(tmp_path_factory.mktemp("dirty") / "dirty")
    tsara(vis=line, imagename=root, niter=0, **GRID, **FAST)
    return root


MASKS = {
    "region": dict(mask="circle[[30pix,27pix],4pix]"),
    "region of some channels": dict(mask="circle[[30pix,27pix],4pix], range=[1chan,2chan]"),
    "primary beam": dict(usemask="pb", pbmask=0.9),
    "cube": dict(mask="cube"),
    "plane": dict(mask="plane"),
    "cube, as FITS": dict(mask="cube.fits"),
}


@pytest.mark.parametrize("name", [name if name == "cube" else pytest.param(name, marks=pytest.mark.slow)
                                  for name in MASKS])
def test_mask_is_tcleans(line, dirty, name):
    options = dict(MASKS[name])
    planes = np.zeros((64, 60, 4))
    for k in range(1, 4):
        planes[30 - k : 31 + k, 25:30, k] = 1
    if "mask" in options and options["mask"].startswith("cube"):
        options["mask"] = mask_image("given", planes, dirty + ".residual", fits="fits" in options["mask"])
    if options.get("mask") == "plane":
        tsara(vis=line, imagename="one", niter=0, mask="box[[20pix,20pix],[33pix,31pix]]",
              **GRID | dict(specmode="mfs"))
        options["mask"] = "one.mask"
    tsara(vis=line, imagename="ours", niter=0, **options, **GRID, **FAST)
    ours = image("ours.mask")[0]
    if "fits" not in options.get("mask", ""):  # which tclean does not read
        tclean(line, "clean", niter=1, **options)
        np.testing.assert_array_equal(ours, image("clean.mask")[0])
    assert ours.shape == (64, 60, 4) and 0 < ours.sum() < ours.size
    if name.startswith("cube"):
        np.testing.assert_array_equal(ours, planes)
    if name == "plane":
        assert (ours == ours[:, :, :1]).all()


def test_a_model_is_within_the_mask_of_its_channel(line, dirty):
    """No mask in one channel; in another one the mask is elsewhere, which is said."""
    planes = np.zeros((64, 60, 4))
    planes[27:34, 24:31, 1:3] = 1
    planes[45:50, 45:50, 3] = 1
    mask = mask_image("given", planes, dirty + ".residual")
    result = tsara(vis=line, imagename="run", mask=mask, **GRID, **FAST)
    model = image("run.model")[0]
    np.testing.assert_array_equal(image("run.mask")[0], planes)
    assert not model[planes == 0].any()
    assert model.sum(axis=(0, 1))[1:3] == pytest.approx(LINE[1:3], abs=0.02)
    notes = " ".join(result["sara"]["notes"])
    assert "the mask is empty in channels 0: their models are zero" in notes
    assert "channel 3: mask: the residual outside the mask reaches" in notes and "channel 1:" not in notes
    codes = [channel["stopcode"] for channel in result["sara"]["channels"]]
    assert codes[0] == EMPTY_MASK and codes[1:3] == [CONVERGED] * 2
    assert np.abs(image("run.residual")[0][:, :, 0]).max() > 0  # its dirty image


def test_masks_of_other_channels_are_refused(line, dirty):
    ia = casatools.image()
    ia.open(dirty + ".psf")
    ia.tofits("four.fits")
    ia.close()
    with pytest.raises(ValueError, match="mask = 'four.fits' has the shape .*: should be .* one channel, or 3"):
        tsara(vis=line, imagename="no", niter=0, mask="four.fits", nchan=3, **GRID, **FAST)


@pytest.mark.slow
@pytest.mark.parametrize("beam", ["common", "90arcsec", ["100arcsec", "80arcsec", "20deg"]], ids=str)
def test_restored_with_one_beam_as_tclean(line, dirty, beam):
    """The same model is restored as tclean restores it."""
    edge = dict(width=-1, start=3) if beam == "common" else {}
    tsara(vis=line, imagename="ours", niter=3, restoringbeam=beam, **edge, **GRID, **FAST)
    tclean(line, "clean", startmodel="ours.model", restoringbeam=beam, **edge)
    ours, theirs = image("ours.image"), image("clean.image")
    assert len(ours[1]) == 1 and ours[1][0] == pytest.approx(theirs[1][0], rel=1e-3)
    inner = (slice(16, 48), slice(15, 45))
    assert np.abs(ours[0] - theirs[0])[inner].max() < 5e-3 * theirs[0].max()


@pytest.mark.parametrize("stokes", ["Q", pytest.param("V", marks=pytest.mark.slow)])
def test_dirty_cube_of_another_stokes_is_tcleans(tmp_path, stokes):
    vis = simulate(tmp_path / "p.ms", spws=(("1.42GHz", "50kHz", 2),), correlations="XX XY YX YY", antennas=8, scans=1,
                   noise=0.5)
    tsara(vis=vis, imagename="ours", niter=0, stokes=stokes, positivity=False, **GRID, **FAST)
    tclean(vis, "clean", stokes=stokes)
    ours, theirs = image("ours.residual")[0], image("clean.residual")[0]
    assert ours.shape == (64, 60, 2) and theirs.std() > 0
    assert (ours - theirs)[16:48, 15:45].std() < 5e-3 * theirs.std()  # tclean rounds u and v
    np.testing.assert_allclose(image("ours.sumwt")[0], image("clean.sumwt")[0], rtol=1e-5)


@pytest.mark.slow
def test_model_column_holds_each_channel_of_its_own(line, tmp_path):
    """Against an explicit sum over the pixels of each channel; what is in no channel of the image is 0."""
    vis = str(tmp_path / "copy.ms")
    shutil.copytree(line, vis)
    options = dict(vis=vis, imagename="run", start=1, nchan=2, **GRID, **FAST)
    tsara(niter=60, savemodel="modelcolumn", **options)
    models = image("run.model")[0]
    written, uvw = column(vis, "MODEL_DATA"), column(vis, "UVW")
    freqs = column(vis + "/SPECTRAL_WINDOW", "CHAN_FREQ")[:, 0]
    for channel, freq in enumerate(freqs):
        expected = np.zeros(uvw.shape[1], complex)
        for x, y in np.argwhere(models[:, :, channel - 1]) if channel in (1, 2) else ():
            l, m = -(x - 32) * 10 * ARCSEC, (y - 30) * 10 * ARCSEC
            expected += models[x, y, channel - 1] * np.exp(2j * np.pi * (uvw[0] * l + uvw[1] * m) * freq / 299792458.0)
        assert np.abs(written[:, channel] - expected).max() < 1e-4 * max(np.abs(expected).max(), 1e-3)
        assert (np.abs(expected).max() > 0.2) == (channel in (1, 2))
    edit(vis, "MODEL_DATA", lambda data: 0 * data + 7)
    before = image("run.residual")[0]
    tsara(niter=0, restart=True, savemodel="modelcolumn", **options)
    np.testing.assert_array_equal(column(vis, "MODEL_DATA"), written)
    np.testing.assert_array_equal(image("run.residual")[0], before)
