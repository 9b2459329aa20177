"""The primary beam, what is divided by it and what is masked, against tclean and against the pattern of a dish."""

import os

import numpy as np
import pytest
from scipy.special import j1
from simulated_ms import CYGNUS_A, edit, simulate

casatools = pytest.importorskip("casatools")

from casa_sara import tsara

ARCSEC = np.pi / 180 / 3600
SPEED_OF_LIGHT = 299792458.0
SOUTH = "J2000 10h00m00.0s -30d00m00s"
ALMA = np.array([2225142.18, -5440307.37, -2481029.85])  # metres, ITRF
CENTRES = {"vla": "J2000 19h59m40.0s +40d46m02s", "alma": "J2000 10h00m00.7s -29d59m55s"}
GRIDS = {"vla": dict(imsize=[160, 150], cell="3.6arcsec"), "alma": dict(imsize=[100, 108], cell="0.5arcsec")}


@pytest.fixture(scope="module")
def observations(tmp_path_factory):
    """A VLA observation at 8.4 GHz and one like ALMA's at 230 GHz, each of one bright source beside the centre."""
    folder = tmp_path_factory.mktemp("ms")
    vla = simulate(folder / "vla.ms", antennas=10, noise=0.02, scans=1, fields=(CYGNUS_A,), integration=20.0,
                   spws=(("8.4GHz", "2MHz", 1),), sky=[(1.0, 100 * ARCSEC, -60 * ARCSEC)])
    places = ALMA[:, None] + 40 * np.random.default_rng(1).standard_normal((3, 10))
    alma = simulate(folder / "alma.ms", configuration=places, telescope="ALMA", correlations="XX YY", fields=(SOUTH,),
                    spws=(("230GHz", "10MHz", 2),), scans=1, integration=20.0, noise=0.02,
                    sky=[(1.0, 5 * ARCSEC, 3 * ARCSEC)])
    edit(alma + "/ANTENNA", "DISH_DIAMETER", lambda old: np.full_like(old, 12.0))
    return {"vla": vla, "alma": alma}


def contents(name):
    """Return the pixels, the mask, the names of the masks, unit and beam of an image."""
    ia = casatools.image()
    ia.open(name)
    try:
        return (ia.getchunk()[:, :, 0, 0], ia.getchunk(getmask=True)[:, :, 0, 0], ia.maskhandler("get"),
                ia.brightnessunit(),
                ia.restoringbeam())
    finally:
        ia.close()


@pytest.mark.parametrize(
    "telescope, centre, pblimit", [("vla", False, -0.1), ("vla", True, 0.2), ("alma", False, 0.0), ("alma", True, 0.5)])
def test_beam_masks_and_correction_are_tcleans(observations, telescope, centre, pblimit):
    """Of the same images, with the centre of the image at the field's, or elsewhere."""
    import casatasks

    common = dict(vis=observations[telescope], niter=0, datacolumn="data", pbcor=True, pblimit=pblimit,
                  **GRIDS[telescope])
    if centre:
        common["phasecenter"] = CENTRES[telescope]
    tsara(imagename="ours", **common)
    casatasks.tclean(imagename="theirs", **common)
    for product in ("pb", "residual", "image", "image.pbcor"):
        ours, theirs = contents(f"ours.{product}"), contents(f"theirs.{product}")
        for what, one, other in zip(("mask", "masks", "unit"), ours[1:], theirs[1:]):
            np.testing.assert_array_equal(one, other, err_msg=f"{product}: {what}")
        if product == "pb":
            assert np.abs(ours[0] - theirs[0]).max() < 1e-4
            assert 0.5 < ours[0].max() <= 1
            # away from the field's centre the beam is there, not in the middle of the image
            place = np.unravel_index(np.argmax(ours[0]), ours[0].shape)
            assert (place != (ours[0].shape[0] // 2, ours[0].shape[1] // 2)) == centre
    assert os.path.isdir("ours.model.pbcor") and not os.path.exists("ours.image.pbcor.pbcor")


def test_corrected_images_are_what_was_seen_over_the_beam(observations):
    tsara(vis=observations["vla"], imagename="x", niter=20, datacolumn="data", pbcor=True, pblimit=-0.1,
          restoringbeam="30arcsec", wavelets=["dirac"], **GRIDS["vla"])
    beam, good, *_ = contents("x.pb")
    for product, unit in (("image", "Jy/beam"), ("model", "Jy/pixel")):
        seen, corrected = contents(f"x.{product}"), contents(f"x.{product}.pbcor")
        np.testing.assert_allclose(corrected[0][good], seen[0][good] / beam[good], rtol=1e-6)
        assert not corrected[0][~good].any() and (corrected[1] == good).all() and corrected[3] == seen[3] == unit
        assert corrected[4] == seen[4]
    assert contents("x.image.pbcor")[4]["major"]["value"] == pytest.approx(30)
    # the source is 117 arcsec from the pointing centre, where the antennas see less of it
    model, corrected = (contents(f"x.model{suffix}")[0] for suffix in ("", ".pbcor"))
    assert corrected.sum() > 1.2 * model.sum() > 1.0
    # a run without pbcor leaves none of the older run's
    tsara(vis=observations["vla"], imagename="x", niter=0, datacolumn="data", overwrite=True, **GRIDS["vla"])
    assert not os.path.exists("x.image.pbcor") and not os.path.exists("x.model.pbcor")


def test_beam_is_that_of_a_dish(observations):
    """ALMA's beam is the Airy pattern of 10.7 m with a blockage of 0.75 m,
    to the percent that CASA's table of it is."""
    tsara(vis=observations["alma"], imagename="x", niter=0, datacolumn="data", pblimit=0.05, **GRIDS["alma"])
    beam, good, *_ = contents("x.pb")
    x, y = np.indices(beam.shape)
    angle = 0.5 * ARCSEC * np.hypot(x - beam.shape[0] // 2, y - beam.shape[1] // 2)
    phase = np.maximum(np.pi * 10.7 / (SPEED_OF_LIGHT / 230.005e9) * np.sin(angle), 1e-9)
    hole = 0.75 / 10.7
    voltage = (2 * j1(phase) / phase - hole**2 * 2 * j1(hole * phase) / (hole * phase)) / (1 - hole**2)
    assert np.abs(beam - voltage**2)[good].max() < 0.015
    assert 500 < good.sum() < good.size


def test_wrong_limits_are_refused(observations):
    for value in (1.5, -2, float("nan"), "0.2"):
        with pytest.raises(ValueError, match="pblimit = .*: should be a number, at least -1, at most 1"):
            tsara(vis=observations["vla"], imagename="x", niter=0, pblimit=value, **GRIDS["vla"])
    with pytest.raises(ValueError, match="pbcor = True has no effect with restoration = False"):
        tsara(vis=observations["vla"], imagename="x", niter=0, pbcor=True, restoration=False, **GRIDS["vla"])
