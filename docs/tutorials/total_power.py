"""A mosaic with total power: seven pointings of the ACA and the image of a single dish, imaged together.

    python docs/tutorials/total_power.py [folder]

Prints the numbers and draws the picture of total_power.md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from casa_sara import tsara
from casa_sara.analysis.metrics import snr_at_scale
from casa_sara.demo.imagers import quiet, read_image
from casa_sara.demo.mosaic import ACA, observe_mosaic
from casa_sara.demo.single_dish import observe_with_dish
from casa_sara.demo.sky import ARCSEC, Sky

SEED = 5
CELL_ARCSEC, SIZE = 3.0, 144
BEAM_ARCSEC = 14.0  # of the ACA: the scale at which the model is held against the truth
CENTRE, DISH_ARCSEC, DISH_NOISE = (150.0, -30.0), 58.0, 0.02  # degrees; the beam of a dish of 12 m; Jy/beam
POINTINGS = [(0, 0), (16, 0), (-16, 0), (8, 14), (-8, 14), (8, -14), (-8, -14)]  # pixels; 48 arcsec, half a beam
CLUMPS = [(20, 15, 20, 0.5), (-35, 30, 16, 0.3), (10, -40, 24, 0.6), (-20, -15, 14, 0.2)]  # west, north, FWHM; Jy
CLOUD = (0, 0, 90, 6.0)


def draw_sky():
    """Return a cloud of 6 Jy and 90 arcsec, larger than the shortest baseline measures, with four clumps in it."""
    along = (np.arange(SIZE) - SIZE // 2) * CELL_ARCSEC
    image = np.zeros((SIZE, SIZE))
    for west, north, fwhm, flux in [CLOUD, *CLUMPS]:
        radius_sq = (along[:, None] - west) ** 2 + (along[None, :] - north) ** 2
        part = np.exp(-4 * np.log(2) * radius_sq / fwhm**2)
        image += flux * part / part.sum()
    return Sky(image, CELL_ARCSEC * ARCSEC)


def main(folder):
    """Do it all; return the truth (nx, ny), the models without and with the dish, and what tsara returned of both."""
    with quiet(folder / "casa.txt"):
        sky = draw_sky()
        vis = observe_mosaic(folder, sky, POINTINGS, seed=SEED)
        dish = observe_with_dish(folder / "dish.image", sky.image, CELL_ARCSEC, CENTRE, DISH_ARCSEC, ACA.freq_hz,
                                 DISH_NOISE, width=500.0, seed=SEED)
        results = make_images(vis, dish, str(folder / "cloud"))
    models = [read_image(folder / f"cloud{name}.model")[0] for name in ("", "_tp")]
    return sky.image, models, results


def make_images(vis, dish, name):
    """The tutorial: the mosaic alone, and with the single dish."""
    common = dict(vis=vis, gridder="mosaic", phasecenter="J2000 150.0deg -30.0deg", imsize=144, cell="3arcsec")
    alone = tsara(imagename=name, **common)
    both = tsara(imagename=name + "_tp", sdimage=dish, **common)
    return alone, both


def as_text(truth, models, results):
    """Return the numbers of both runs."""
    lines = [f"truth               {truth.sum():.2f} Jy"]
    for label, model in zip(("mosaic alone", "with total power"), models):
        fidelity = snr_at_scale(truth, model, BEAM_ARCSEC / CELL_ARCSEC)
        lines.append(f"{label:<20}{model.sum():.2f} Jy, SNR of the model {fidelity:.1f} dB at the beam, 14 arcsec")
    power = results[1]["sara"]["total_power"]
    return "\n".join([*lines, f"noise of the dish   {power['noise_jy_per_beam']:.3f} Jy/beam, found at "
                              f"{power['points']} points"])


def draw(path, truth, models):
    """Draw the truth and both models at the resolution of the beam."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from casa_sara.analysis.metrics import smooth

    figure, axes = pyplot.subplots(1, 3, figsize=(9.5, 3.2), layout="constrained")
    images = [smooth(image, BEAM_ARCSEC / CELL_ARCSEC) for image in (truth, *models)]
    half = SIZE * CELL_ARCSEC / 2
    for axis, image, title in zip(axes, images, ("the sky", "mosaic alone", "with total power")):
        shown = axis.imshow(1e3 * image.T, origin="lower", cmap="inferno", vmin=0, vmax=1e3 * images[0].max(),
                            extent=[half, -half, -half, half])
        axis.set(title=title, xlim=(110, -110), ylim=(-110, 110))
        axis.set_xlabel("arcsec")
    figure.colorbar(shown, ax=axes, label="mJy/pixel", shrink=0.9)
    figure.savefig(path, dpi=75)


if __name__ == "__main__":
    home = Path(sys.argv[1] if len(sys.argv) > 1 else tempfile.mkdtemp(prefix="total_power-"))
    home.mkdir(parents=True, exist_ok=True)
    made = main(home)
    print(as_text(*made))
    draw(home / "total_power.png", *made[:2])
    print(f"{home}/total_power.png")
