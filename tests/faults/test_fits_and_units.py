"""FITS files as startmodel, mask and the images of saracompare, in the forms of other software,
and the spellings of units."""

import gzip
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

casatools = pytest.importorskip("casatools")

sys.path.insert(0, str(Path(__file__).parents[1]))
from simulated_ms import pixels, simulate

from casa_sara import saracompare, tsara
from casa_sara.casa.images.sky_image import read_sky_image
from casa_sara.casa.images.units import brightness_unit

ARCSEC = np.radians(1 / 3600)
SIDE, CELL = 64, 0.5
GRID = dict(imsize=SIDE, cell=f"{CELL}arcsec", datacolumn="data", nthreads=1)


@pytest.fixture(scope="module")
def vis(tmp_path_factory):
    return simulate(tmp_path_factory.mktemp("ms") / "c.ms", configuration="c", antennas=8, noise=0.02,
                    sky=((1.0, -5 * ARCSEC, 7 * ARCSEC),))


def header(side=SIDE, cell=CELL, **more):
    """Return the coordinates of an image of the field, two axes."""
    return fits.Header(dict(CTYPE1="RA---SIN", CRVAL1=299.86875, CRPIX1=side // 2 + 1.0, CDELT1=-cell / 3600,
                            CUNIT1="deg",
                            CTYPE2="DEC--SIN", CRVAL2=40 + 44 / 60 + 2 / 3600, CRPIX2=side // 2 + 1.0,
                            CDELT2=cell / 3600,
                            CUNIT2="deg", RADESYS="FK5", EQUINOX=2000.0, BUNIT="Jy/pixel") | more)


FREQUENCY = dict(CTYPE="FREQ", CRVAL=8.4e9, CDELT=6e6, CRPIX=1.0, CUNIT="Hz")
STOKES = dict(CTYPE="STOKES", CRVAL=1.0, CDELT=1.0, CRPIX=1.0)


def with_axes(*axes):
    return header(**{f"{key}{number}": value for number, axis in enumerate(axes, 3) for key, value in axis.items()})


def block(side=SIDE, finer=1, value=1.0):
    """Return 7 × 5 pixels of a value around the source, `finer` times as many, as FITS has them."""
    image = np.zeros((side, side), np.float32)
    x, y = side // 2 + 10 * finer, side // 2 + 14 * finer
    image[x - 3 * finer : x + 3 * finer + 1, y - 2 * finer : y + 2 * finer + 1] = value
    return image.T


def in_extension(path, hdu):
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path)


def packed(path, data, about):
    fits.writeto("plain.fits", data, about, overwrite=True)
    with open("plain.fits", "rb") as plain, gzip.open(path, "wb") as file:
        shutil.copyfileobj(plain, file)


def scaled(path, data, about):
    hdu = fits.PrimaryHDU(data, about)
    hdu.scale("int16", bscale=0.01)
    hdu.writeto(path)


def mirrored(path, data, about):
    fits.writeto(path, data[:, ::-1].copy(), fits.Header({**about, "CDELT1": -about["CDELT1"],
                                                          "CRPIX1": SIDE + 1 - about["CRPIX1"]}))


FORMS = {
    "two axes": lambda path, data: fits.writeto(path, data, header()),
    "with frequency": lambda path, data: fits.writeto(path, data[None], with_axes(FREQUENCY)),
    "with Stokes and frequency": lambda path, data: fits.writeto(path, data[None, None], with_axes(STOKES, FREQUENCY)),
    "with frequency and Stokes": lambda path, data: fits.writeto(path, data[None, None], with_axes(FREQUENCY, STOKES)),
    "in double precision": lambda path, data: fits.writeto(path, data.astype(float), header()),
    "scaled integers": lambda path, data: scaled(path, data, header()),
    "in an extension": lambda path, data: in_extension(path, fits.ImageHDU(data, header())),
    "tiles": lambda path, data: in_extension(path, fits.CompImageHDU(data, header())),
    "gzip": lambda path, data: packed(path, data, header()),
    "mirrored": lambda path, data: mirrored(path, data, header()),
}


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_any_form_of_fits_is_start_model_and_mask(vis, form):
    data = block()
    FORMS[form]("x.fits", data)
    tsara(vis=vis, imagename="t", niter=0, startmodel="x.fits", mask="x.fits", **GRID)
    lost = 5e-3 if form == "tiles" else 3e-4 if form == "mirrored" else 1e-6  # by compression; about another centre
    np.testing.assert_allclose(pixels("t.model"), data.T, rtol=0, atol=lost)
    tsara(vis=vis, imagename="m", niter=5, mask="x.fits", **GRID)
    mask = pixels("m.mask") > 0
    assert mask[data.T > 0].all()
    # a rim: what is interpolated counts where it is not zero, as in tclean
    assert mask.sum() <= 35 + 13 * (form == "mirrored")


def test_fits_on_another_grid_are_regridded_as_images_of_casa(vis):
    """Of another size and finer: the flux is kept, and the mask is what CASA makes of the same image of its own."""
    from casatasks import importfits

    fits.writeto("x.fits", block(200, 2), header(200, CELL / 2))
    importfits("x.fits", "x.im", defaultaxes=True, defaultaxesvalues=["", "", "8.4GHz", "I"])
    for name in ("x.fits", "x.im"):
        tsara(vis=vis, imagename="t", niter=5, mask=name, overwrite=True, **GRID)
        shutil.move("t.mask", f"{name}.mask")
    np.testing.assert_array_equal(pixels("x.fits.mask"), pixels("x.im.mask"))
    assert 20 <= pixels("x.fits.mask").sum() <= 48
    tsara(vis=vis, imagename="s", niter=0, startmodel="x.fits", **GRID)
    assert pixels("s.model").sum() == pytest.approx(block(200, 2).sum(), rel=1e-5)
    fits.writeto("cube.fits", np.zeros((3, SIDE, SIDE), np.float32), with_axes(FREQUENCY))
    with pytest.raises(ValueError, match="startmodel = 'cube.fits' has the shape .* one channel"):
        tsara(vis=vis, imagename="n", niter=0, startmodel="cube.fits", **GRID)


def test_fits_serve_cubes_and_spectral_indices(vis):
    fits.writeto("x.fits", block(value=0.02), header())
    tsara(vis=vis, imagename="q", niter=0, specmode="cube", startmodel="x.fits", **GRID)
    np.testing.assert_allclose(pixels("q.model"), block(value=0.02).T, atol=1e-7)
    packed("alpha.fits.gz", block(value=-0.7), header(BUNIT=""))
    tsara(vis=vis, imagename="a", niter=3, spectralindex="alpha.fits.gz", **GRID)
    packed("b.model.fits.gz", block(value=0.02), header())
    packed("support.gz", block(), header())
    assert set(saracompare(models=["a", "b"], support="support.gz", vis=vis, datacolumn="data")["products"]) == {"a",
                                                                                                                 "b"}


NOT_IMAGES = {
    "empty": b"",
    "cut off": b"SIMPLE  =                    T",
    "packed text": gzip.compress(b"#CRTFv0"),
    "text": b"this is no image",
}


@pytest.mark.parametrize("content", NOT_IMAGES.values(), ids=NOT_IMAGES)
def test_what_is_no_image_is_refused_by_name(vis, content):
    Path("x.fits").write_bytes(content)
    with pytest.raises(ValueError, match="startmodel = 'x.fits' cannot be read as an image"):
        tsara(vis=vis, imagename="t", niter=0, startmodel="x.fits", **GRID)
    with pytest.raises(ValueError, match="mask = 'x.fits'"):
        tsara(vis=vis, imagename="t", niter=5, mask="x.fits", **GRID)
    with pytest.raises(ValueError, match="models = 'x.fits' cannot be read as an image"):
        saracompare(models=["x.fits", "x.fits"])


def test_fits_without_the_sky_are_refused(vis):
    fits.writeto("x.fits", block())
    for parameter in ("startmodel", "mask"):
        with pytest.raises(ValueError,
                           match=f"{parameter} = 'x.fits' has the axes .*: should begin with right ascension"):
            tsara(vis=vis, imagename="t", niter=5, **{parameter: "x.fits"}, **GRID)


# Units ------------------------------------------------------------------------------------------

SPELLINGS = {
    "Jy/pixel": ("Jy/pixel", "pixel-1 Jy", "Jy pixel-1", "pix-1 Jy", "JY/PIX", "JY/PIXEL", "Jy/pix", "jy/Pixel",
                 "Jy pixel**-1", "Jy*pixel^-1", "Jy.pixel-1", "Jansky/pixel", "JY PIXEL-1", "Jy per pixel",
                 "Jy / (pixel)",
                 " Jy/pixel ", '"JY/PIX"'),
    "Jy/beam": ("Jy/beam", "Jy beam-1", "JY/BEAM", "Jy/bm", "bm-1 Jy", "Jy.beam-1", "JY BEAM-1"),
}
FACTORS = {"mJy/pixel": ("Jy/pixel", 1e-3), "uJy/PIX": ("Jy/pixel", 1e-6), "µJy/pix": ("Jy/pixel", 1e-6),
           "nJy pix-1": ("Jy/pixel", 1e-9), "kJy/pixel": ("Jy/pixel", 1e3), "10**-3 Jy/beam": ("Jy/beam", 1e-3),
           "mjy/beam": ("Jy/beam", 1e-3), "W m-2 Hz-1 pixel-1": ("Jy/pixel", 1e26), "MJy/sr": ("Jy/sr", 1e6),
           "Jy/arcsec2": ("Jy/sr", (180 * 3600 / np.pi) ** 2), "JY/SR": ("Jy/sr", 1.0), "": ("", 1.0)}
REFUSED = ("K", "Jy", "counts", "Jy/beam km/s", "MJY/BEAM", "mag", "%$#@", "Jy/beam/pixel", "pixel", "Jy_per_pixel")


def test_units_are_understood_in_all_spellings():
    for unit, texts in SPELLINGS.items():
        for text in texts:
            assert brightness_unit(text) == (unit, 1.0), text
    for text, (unit, factor) in FACTORS.items():
        assert brightness_unit(text) == (unit, pytest.approx(factor, rel=1e-12)), text
    for text in REFUSED:
        assert brightness_unit(text) == (text, 1.0), text


IN_FILES = {"pixel-1 Jy": 1.0, "JY/PIX": 1.0, "Jy pixel**-1": 1.0, "mJy/pixel": 1e-3, "uJy pixel-1": 1e-6,
            "MJy/sr": 1e6 * (CELL * ARCSEC) ** 2, "Jy/arcsec^2": CELL**2}


@pytest.mark.parametrize("unit", IN_FILES)
def test_images_in_files_are_converted(vis, unit):
    """As startmodel, and as a model of saracompare: in FITS files, and in images of CASA."""
    factor = IN_FILES[unit]
    fits.writeto("x.fits", block(value=0.02 / factor), header(BUNIT=unit))
    ia = casatools.image()
    ia.fromfits("x.im", "x.fits")
    ia.done()
    for name in ("x.fits", "x.im"):
        tsara(vis=vis, imagename="t", niter=0, startmodel=name, overwrite=True, **GRID)
        np.testing.assert_allclose(pixels("t.model"), block(value=0.02).T, rtol=1e-6, atol=1e-9)
        image = read_sky_image(name, "models", ("Jy/pixel",))
        assert image.unit == "Jy/pixel" and image.pixels.sum() == pytest.approx(0.02 * 35, rel=1e-5)


@pytest.mark.parametrize("unit", ["K", "Jy", "Jy/beam", "Jy/beam km/s"])
def test_what_cannot_be_converted_is_refused_with_its_unit(vis, unit):
    fits.writeto("x.fits", block(), header(BUNIT=unit))
    word = unit.split()[0].replace("/", ".")
    with pytest.raises(ValueError, match=f"startmodel = 'x.fits' is in '.*{word}.*': it takes 'Jy/pixel'"):
        tsara(vis=vis, imagename="t", niter=0, startmodel="x.fits", **GRID)
    with pytest.raises(ValueError, match=f"models = 'x.fits' is in '.*{word}.*': should be in 'Jy/pixel'"):
        saracompare(models=["x.fits", "x.fits"])


def test_a_residual_in_thousandths_is_that_in_jansky():
    """Beside the models, with a beam: what is measured does not depend on the spelling of the unit."""
    noise = np.random.default_rng(0).standard_normal((SIDE, SIDE)).astype(np.float32)
    beam = dict(BMAJ=2 / 3600, BMIN=1.5 / 3600, BPA=20.0)
    for name, unit, factor in (("a", "Jy/beam", 1.0), ("b", "mJy beam-1", 1e3)):
        fits.writeto(f"{name}.model.fits", block(), header())
        fits.writeto(f"{name}.residual.fits", noise * factor, header(BUNIT=unit, **beam))
    found = saracompare(models=["a", "b"])["products"]
    assert found["b"]["natural"]["sigma"] == pytest.approx(found["a"]["natural"]["sigma"], rel=1e-6)
