"""Images whose axes are mirrored, turned or sheared, as other software writes them, compared with an upright one.

A function of the sky is sampled in each orientation, so the right numbers are those of the upright image.
"""

import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

casatools = pytest.importorskip("casatools")

sys.path.insert(0, str(Path(__file__).parents[1]))
from simulated_ms import simulate

from casa_sara import saracompare, tsara
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.comparison.compare_images import compare_images
from casa_sara.options import Comparing

ARCSEC = np.radians(1 / 3600)
CELL, SIDE = 0.5, 96
RA, DEC = 299.86875, 40 + 44 / 60 + 2 / 3600
SOURCES = ((1.0, 5.0, 7.0), (0.5, -8.0, -3.0))  # Jy, arcsec to the east and to the north
REGIONS = ["A = 19h59m28.9399s +40d44m09.00s 4arcsec", "B = 19h59m27.7962s +40d43m59.00s 4arcsec"]
BEAM = dict(BMAJ=3 / 3600, BMIN=2 / 3600, BPA=30.0)


def turned(degrees, mirrored=False):
    """Return the matrix that takes steps in pixels to steps to the east and to the north, in pixels."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cos, -sin], [sin, cos]]) @ np.diag([1.0 if mirrored else -1.0, 1.0])


RIGHT_ANGLES = {f"{angle} degrees{', mirrored' * mirror}": turned(angle, mirror)
                for angle in (0, 90, 180, 270) for mirror in (False, True)}
OBLIQUE = {"30 degrees": turned(30), "-75 degrees, mirrored": turned(-75, True),
           "sheared": turned(0) @ np.array([[1.0, 0.3], [0.0, 1.0]])}


def header(matrix, form, unit):
    """Return the coordinates of such an image in one of the forms of FITS."""
    found = fits.Header(dict(CTYPE1="RA---SIN", CRVAL1=RA, CUNIT1="deg", CTYPE2="DEC--SIN", CRVAL2=DEC, CUNIT2="deg",
                             CRPIX1=SIDE // 2 + 1.0, CRPIX2=SIDE // 2 + 1.0, RADESYS="FK5", EQUINOX=2000.0, BUNIT=unit))
    step = CELL / 3600
    if form == "CD":
        found.update({f"CD{i + 1}_{j + 1}": step * matrix[i, j] for i in (0, 1) for j in (0, 1)})
    elif form == "PC":
        found.update(dict(CDELT1=-step, CDELT2=step))
        found.update({f"PC{i + 1}_{j + 1}": matrix[i, j] * (-1, 1)[i] for i in (0, 1) for j in (0, 1)})
    else:  # CROTA2, for what is not sheared
        mirrored = np.linalg.det(matrix) > 0
        found.update(dict(CDELT1=step if mirrored else -step, CDELT2=step,
                          CROTA2=float(np.degrees(np.arctan2(-matrix[0, 1], matrix[1, 1])))))
    return found


def sky(east, north):
    """Return smooth sources in Jy per pixel of CELL, and a residual of a few waves in Jy/beam."""
    model = sum(flux * np.exp(-((east - e) ** 2 + (north - n) ** 2) / 2) * CELL**2 / (2 * np.pi)
                for flux, e, n in SOURCES)
    return model, 0.01 * (np.cos(1.1 * east + 0.6 * north) + np.cos(0.4 * east - 0.9 * north + 1))


def product(root, matrix, form="CD"):
    """Write model and residual of the sky in an orientation; return the root."""
    x, y = np.indices((SIDE, SIDE)) - SIDE // 2
    east, north = np.einsum("ij,jxy->ixy", CELL * matrix, [x, y])
    model, residual = sky(east, north)
    model *= abs(np.linalg.det(matrix))
    fits.writeto(f"{root}.model.fits", np.float32(model.T), header(matrix, form, "Jy/pixel"))
    about = header(matrix, form, "Jy/beam")
    about.update(BEAM)
    fits.writeto(f"{root}.residual.fits", np.float32(residual.T), about)
    return root


def measured(models):
    return saracompare(models=models, regions=REGIONS)["products"]


@pytest.mark.parametrize("form", ["CD", "PC", "CROTA2"])
@pytest.mark.parametrize("matrix", RIGHT_ANGLES.values(), ids=RIGHT_ANGLES)
def test_right_angles_change_nothing(matrix, form):
    """Fluxes, the restored image with its beam, and the pixels of the model are those of the upright image."""
    product("u", turned(0))
    product("t", matrix, form)
    for models in (["t", "u"], ["u", "t"]):
        found = measured(models)
        for region, (flux, *_) in zip("AB", SOURCES):
            for name in models:
                assert found[name]["regions"][region]["model_flux_jy"] == pytest.approx(flux, rel=2e-3)
            for key in ("flux_jy", "error_jy"):
                assert found["t"]["regions"][region][key] == pytest.approx(found["u"]["regions"][region][key], rel=1e-3)
        assert found["t"]["natural"]["peak"] == pytest.approx(found["u"]["natural"]["peak"], rel=1e-4)
    image = read_sky_image("t.model.fits", "models", ("Jy/pixel",))
    upright = image.upright().pixels
    assert upright.shape == image.pixels.shape  # east is not quite the same one pixel away
    np.testing.assert_allclose(np.sort(upright.ravel()), np.sort(image.pixels.ravel()), rtol=0, atol=1e-5)


@pytest.mark.parametrize("matrix", OBLIQUE.values(), ids=OBLIQUE)
def test_oblique_axes_keep_fluxes_and_beams(matrix):
    """The common grid is upright and has room for all of the first model, less what a residual does not reach."""
    product("u", turned(0))
    product("t", matrix)
    for models in (["t", "u"], ["u", "t"]):
        found = measured(models)
        for region, (flux, *_) in zip("AB", SOURCES):
            for name in models:
                assert found[name]["regions"][region]["model_flux_jy"] == pytest.approx(flux, rel=5e-3)
                assert found[name]["regions"][region]["flux_jy"] == pytest.approx(
                    found["u"]["regions"][region]["flux_jy"], rel=1e-2)
        assert found["t"]["natural"]["sigma"] == pytest.approx(found["u"]["natural"]["sigma"], rel=1e-2)


def test_pictures_and_frames_are_upright():
    """Each source is where right ascension and declination put it,
    whatever the axes of the first image and of a frame."""
    product("u", turned(0))
    product("t", RIGHT_ANGLES["90 degrees, mirrored"])
    comparison = compare_images(Comparing(("t", "u"), frames=("t", "u")))
    for images in ([one.model for one in comparison.products], [image for _, image, _ in comparison.frames]):
        for image in images:
            nx, ny = image.shape
            assert (nx, ny) == (SIDE, SIDE)
            assert np.unravel_index(image.argmax(), image.shape) == (nx // 2 - 10, ny // 2 + 14)
        np.testing.assert_allclose(images[0][:96, :96], images[1], rtol=0, atol=1e-5)


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    components = [(flux, east * ARCSEC, north * ARCSEC) for flux, east, north in SOURCES]
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=10, sky=components, noise=0.05)


def test_with_vis_residuals_and_injected_sources_do_not_depend_on_the_axes(vis):
    """A run of tsara, exported and mirrored, is held against the data and imaged again as the run itself."""
    from casatasks import exportfits

    tsara(vis=vis, imagename="u", niter=60, imsize=64, cell="0.5arcsec", datacolumn="data", nthreads=1)
    exportfits("u.model", "u.fits")
    data, about = fits.getdata("u.fits"), fits.getheader("u.fits")
    about["CDELT1"] *= -1
    about["CRPIX1"] = 65 - about["CRPIX1"]
    fits.writeto("t.model.fits", data[..., ::-1].copy(), about)
    place = "19h59m29.0279s +40d43m54.00s"
    found = saracompare(models=["t", "u"], vis=vis, datacolumn="data", inject=place, injectflux=0.5)["products"]
    assert found["t"]["natural"]["sigma"] == pytest.approx(found["u"]["natural"]["sigma"], rel=1e-5)
    assert found["t"]["injected"][place]["flux_jy"] == pytest.approx(found["u"]["injected"][place]["flux_jy"], rel=1e-3)
    assert found["t"]["injected"][place]["offset_arcsec"] < 0.3
