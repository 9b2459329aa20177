"""Total power: tsara with and without a single-dish image, beside feather and sdintimaging.

    python benchmarks/total_power.py FOLDER                 # a Gaussian of 1 Jy and 30 arcsec
    python benchmarks/total_power.py FOLDER --noise         # its flux in ten realisations of the noise of the dish
    python benchmarks/total_power.py FOLDER --scene M31     # the mosaic of benchmarks/mosaic.py, 12 m, 7 m, and a dish

The Gaussian is seen by the VLA in C configuration at 8.4 GHz on baselines above 6.5 klambda, where it has 5 % of its
flux or less (0.6 of the longest fringe is 19 arcsec), and by dishes with beams of 45 and of 88 arcsec (100 m), the
second of which leaves a gap to the baselines.  The visibilities are computed from its transform, primary beam included.

Flux is that of the sky within 60 arcsec, the FWHM that of a Gaussian of the same second moments there; SNR = 20
log10(‖truth‖/‖truth − image‖), both smoothed to the beam of tclean and to 10 arcsec.  tclean is multiscale, the best at
10 arcsec of SETTINGS, all with a mask of 60 arcsec around the source, without which tclean and sdintimaging diverge;
its restored image is divided by the primary beam before it is feathered.  sdintimaging runs with the same settings; its
model is looked at.  tsara has no mask.
"""

from __future__ import annotations

import argparse
import itertools
import os
import sys
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "tests"), str(ROOT)]

import numpy as np

FWHM, UVRANGE, FREQ = 30.0, ">6.5klambda", 8.4e9
CELL, SIZE, RADIUS = 0.7, 512, 60.0  # arcsec, pixels, arcsec
CENTRE = (299.86875, 40 + 44 / 60 + 2 / 3600)
VLA_BEAM = 324.0  # arcsec, of CASA's primary beam near its top
DISHES = (45.0, 88.0)
NOISE = (0.002, 0.02)  # Jy/beam
SCALES = (0, 15, 40)  # pixels; 10 and 28 arcsec
SETTINGS = {f"{niter} iterations, gain {gain}": (niter, gain) for niter, gain in ((300, 0.1), (1000, 0.1))}


def the_sky():
    """Return the Gaussian, Jy/pixel."""
    along = (np.arange(SIZE) - SIZE // 2) * CELL
    sky = np.exp(-4 * np.log(2) * (along[:, None] ** 2 + along[None, :] ** 2) / FWHM**2)
    return sky / sky.sum()


def observe(folder):
    """Write the MeasurementSet unless it is there; return its name."""
    from simulated_ms import SPEED_OF_LIGHT, column, edit, simulate

    from casa_sara.demo.single_dish import ARCSEC

    path, noise = folder / "c.ms", 0.01
    if path.exists():
        return str(path)
    name = simulate(path, configuration="c", antennas=27, spws=(("8.4GHz", "50MHz", 1),), scans=6, scan_seconds=60,
                    integration=20.0, spacing_seconds=3600.0, hour_angle=-3.0, noise=noise)
    width = 1 / np.sqrt(1 / FWHM**2 + 1 / VLA_BEAM**2)  # of Gaussian times primary beam
    uv_sq = np.square(column(name, "UVW")[:2] * FREQ / SPEED_OF_LIGHT).sum(axis=0)
    vis = (width / FWHM) ** 2 * np.exp(-((np.pi * width * ARCSEC) ** 2) / (4 * np.log(2)) * uv_sq)
    rng = np.random.default_rng(1)
    edit(name, "DATA", lambda old: vis + noise * (rng.standard_normal(old.shape) + 1j * rng.standard_normal(old.shape)))
    return name


def scores(image, beam, truth, restored=0.0):
    """Flux, FWHM and SNR at the beam and at 10 arcsec of an image in Jy/pixel, smoothed to `restored` already."""
    from casa_sara.analysis.metrics import smooth, snr

    along = (np.arange(SIZE) - SIZE // 2) * CELL
    near = np.where(along[:, None] ** 2 + along[None, :] ** 2 < RADIUS**2, image, 0)
    flux = near.sum()
    spread = (near * (along[:, None] ** 2 + along[None, :] ** 2)).sum() / flux / 2
    width = np.sqrt(max(8 * np.log(2) * spread - restored**2, 0))
    found = []
    for wanted in (beam, 10.0):
        more = np.sqrt(max(wanted**2 - restored**2, 0))
        found.append(snr(smooth(truth, wanted / CELL), smooth(image, more / CELL) if more else image))
    return flux, width, *found


def over_beam(name, pb):
    """A model, or an image, divided by the primary beam where that is above 0.2."""
    return np.divide(name, pb, out=np.zeros_like(name), where=pb > 0.2)


def gaussian(folder):
    """Image the Gaussian in all ways, and print one table; keep pictures of the first noise and dish."""
    from casa_sara.demo.single_dish import observe_with_dish

    name, truth, rows = observe(folder), the_sky(), []
    cleans = [cleaned(folder, name, setting) for setting in SETTINGS]
    beam = cleans[0][1]
    rows.append(("tsara, visibilities alone", *scores(ours(folder, name, ""), beam, truth)))
    rows += [(f"tclean {setting}", *scores(model, beam, truth)) for setting, (model, *_) in zip(SETTINGS, cleans)]
    for dish, noise in itertools.product(DISHES, NOISE):
        sd = observe_with_dish(folder / f"dish{dish:g}_{noise:g}.im", truth, CELL, CENTRE, dish, FREQ, noise,
                               width=500.0, seed=3)
        label = f"dish of {dish:g} arcsec, {1e3 * noise:g} mJy/beam"
        rows.append((f"{label}: tsara", *scores(ours(folder, name, sd), beam, truth)))
        feathers = [feathered(folder, root, sd, beam) for _, _, root in cleans]
        rows.append((f"{label}: feather", *best(scores(image, beam, truth, beam) for image in feathers)))
        rows.append((f"{label}: sdintimaging", *best(scores(image, beam, truth)
                                                     for image in joined(folder, name, sd, dish))))
    print("| image | flux, Jy | FWHM, arcsec | SNR at one beam, dB | at 10 arcsec |\n|---|---|---|---|---|")
    for label, flux, width, one, ten in rows:
        print(f"| {label} | {flux:.3f} | {width:.1f} | {one:.1f} | {ten:.1f} |", flush=True)
    picture(folder, truth, beam, cleans[-1][2])


def realisations(folder, dish=DISHES[1], noise=NOISE[1], seeds=(3, *range(20, 29))):
    """Print the flux of the Gaussian, beside that of the map of the dish alone for a source of known place and shape.

    The latter weights all pixels of the map alike: it is as good as the dish can know the flux.
    """
    import casatools

    from casa_sara.demo.single_dish import observe_with_dish

    name, truth, found = observe(folder), the_sky(), []
    along = (np.arange(SIZE) - SIZE // 2) * CELL
    near, width = np.hypot(along[:, None], along[None, :]) < RADIUS, np.hypot(dish, FWHM)
    for seed in seeds:
        sd = observe_with_dish(folder / f"dish_{seed}.im", truth, CELL, CENTRE, dish, FREQ, noise, width=500.0,
                               seed=seed)
        ia = casatools.image()
        ia.open(sd)
        pixels, step = ia.getchunk()[:, :, 0, 0], np.degrees(abs(ia.coordsys().increment()["numeric"][0])) * 3600
        ia.close()
        x = (np.arange(pixels.shape[0]) - pixels.shape[0] // 2) * step
        shape = (dish / width) ** 2 * np.exp(-4 * np.log(2) * (x[:, None] ** 2 + x[None, :] ** 2) / width**2)
        found.append(((pixels * shape).sum() / (shape**2).sum(), ours(folder, name, sd)[near].sum()))
        print("seed {}: known shape {:.3f} Jy, tsara {:.3f} Jy".format(seed, *found[-1]), flush=True)
    for label, fluxes in zip(("known shape", "tsara"), np.transpose(found)):
        print(f"{label}: mean {fluxes.mean():.3f}, standard deviation {fluxes.std(ddof=1):.3f} Jy")


def picture(folder, truth, beam, clean):
    """Draw the sky, and what was made of it with the first dish and its lower noise, all at tclean's beam."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    from casa_sara.analysis.metrics import smooth
    from casa_sara.demo.imagers import read_image

    name = f"dish{DISHES[0]:g}_{NOISE[0]:g}"
    sdint = f"sdint_{name}_{list(SETTINGS.values())[-1][0]}_{list(SETTINGS.values())[-1][1]}"
    models = {"truth": truth} | {label: over_beam(read_image(folder / f"{root}.model")[0],
                                                  read_image(folder / f"{pb}.pb")[0])
                                 for label, root, pb in (("tsara, visibilities alone", "tsara_", "tsara_"),
                                                         ("tsara with the dish", f"tsara_{name}", f"tsara_{name}"),
                                                         ("sdintimaging", f"{sdint}.joint.cube", f"{sdint}.int.cube"))}
    images = {label: smooth(model, beam / CELL) for label, model in models.items()}
    images["feather"] = feathered(folder, clean, str(folder / f"{name}.im"), beam)
    figure, axes = pyplot.subplots(1, len(images), figsize=(3 * len(images), 3.4), layout="constrained")
    half, peak = SIZE // 8, images["truth"].max()
    box = (slice(SIZE // 2 - half, SIZE // 2 + half),) * 2
    for axis, (label, image) in zip(axes, images.items()):
        shown = axis.imshow(image[box].T / peak, origin="lower", vmin=-0.1, vmax=1.1, cmap="inferno",
                            extent=np.array([-1, 1, -1, 1]) * half * CELL)
        axis.set_title(label, fontsize=10)
    axes[0].set_ylabel("arcsec")
    figure.colorbar(shown, ax=axes, label="of the true peak", shrink=0.8)
    figure.savefig(folder / "total_power.png", dpi=80)


def best(found):
    """The best at 10 arcsec."""
    return max(found, key=lambda one: one[-1], default=(np.nan,) * 4)


def ours(folder, name, sd):
    """Return tsara's sky."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    root, begin = str(folder / f"tsara_{Path(sd).stem}"), time.perf_counter()
    with quiet(folder / "tsara.txt"):
        made = tsara(vis=name, imagename=root, imsize=SIZE, cell=f"{CELL}arcsec", datacolumn="data", uvrange=UVRANGE,
                     sdimage=sd, overwrite=True, nthreads=1)
    print(f"{Path(root).name}: {made['iterdone']} iterations, {time.perf_counter() - begin:.0f} s, "
          f"{made['stopDescription']}, {made['sara'].get('total_power')}", flush=True)
    return over_beam(read_image(root + ".model")[0], read_image(root + ".pb")[0])


def cleaned(folder, name, setting):
    """Return tclean's sky, the beam, and the name of the images."""
    from casatasks import tclean

    from casa_sara.demo.imagers import quiet, read_image

    (niter, gain), root = SETTINGS[setting], folder / "clean_{}_{}".format(*SETTINGS[setting])
    if not Path(f"{root}.image").exists():
        with quiet(folder / "tclean.txt"):
            tclean(vis=name, imagename=str(root), imsize=SIZE, cell=f"{CELL}arcsec", datacolumn="data",
                   uvrange=UVRANGE, weighting="natural", **_multiscale(niter, gain))
    axes = read_image(f"{root}.image")[1]
    model, pb = read_image(f"{root}.model")[0], read_image(f"{root}.pb")[0]
    return over_beam(model, pb), float(np.sqrt(axes[0] * axes[1])), root


def _multiscale(niter, gain):
    """The parameters of the deconvolution."""
    return dict(deconvolver="multiscale", scales=list(SCALES), niter=niter, gain=gain, cycleniter=100, usemask="user",
                mask=f"circle[[{SIZE // 2}pix,{SIZE // 2}pix],{round(RADIUS / CELL)}pix]")


def feathered(folder, root, sd, beam):
    """Return tclean's image with the dish's feathered in, Jy/pixel at tclean's beam."""
    from casatasks import feather, imregrid

    from casa_sara.demo.imagers import quiet, read_image
    from casa_sara.demo.single_dish import dish_image

    image, axes = read_image(f"{root}.image")
    sky, out, low = over_beam(image, read_image(f"{root}.pb")[0]), folder / "feathered.im", folder / "low.im"
    high = dish_image(folder / "high.im", sky, CELL, CENTRE, 0, FREQ)
    os.system(f"rm -rf {out} {low}")
    with quiet(folder / "feather.txt"):
        _set_beam(high, axes)
        imregrid(sd, template=high, output=str(low), overwrite=True)
        feather(imagename=str(out), highres=high, lowres=str(low))
    return read_image(out)[0] / (np.pi / (4 * np.log(2)) * axes[0] * axes[1] / CELL**2)


def _set_beam(name, axes):
    import casatools

    ia = casatools.image()
    ia.open(name)
    ia.setrestoringbeam(f"{axes[0]}arcsec", f"{axes[1]}arcsec", f"{axes[2]}deg", log=False)
    ia.close()


def joined(folder, name, sd, dish):
    """Yield sdintimaging's sky for each of the settings."""
    from casatasks import sdintimaging

    from casa_sara.demo.imagers import quiet, read_image

    for niter, gain in SETTINGS.values():
        root = folder / f"sdint_{Path(sd).stem}_{niter}_{gain}"
        try:
            if not Path(f"{root}.joint.cube.model").exists():
                with quiet(folder / "sdint.txt"):
                    sdintimaging(usedata="sdint", sdimage=sd, sdpsf="", sdgain=1.0, dishdia=1.2 * 3e8 / FREQ / dish
                                 * 206265, vis=name, imagename=str(root), imsize=SIZE, cell=f"{CELL}arcsec",
                                 datacolumn="data", uvrange=UVRANGE, specmode="cube", nchan=1, gridder="standard",
                                 weighting="natural", interpolation="nearest", **_multiscale(niter, gain))
        except Exception as error:
            print(f"sdintimaging: {error}", flush=True)
            continue
        model, pb = (read_image(f"{root}.{part}")[0] for part in ("joint.cube.model", "int.cube.pb"))
        yield over_beam(model, pb)


def mosaic(folder, scene):
    """Image the mosaic with and without a dish of 12 m, and print one table."""
    import mosaic as of_mosaics

    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image
    from casa_sara.demo.single_dish import observe_with_dish

    folder = folder / scene.replace(" ", "_")
    folder.mkdir(parents=True, exist_ok=True)
    names, sky = of_mosaics.observe(folder, scene), of_mosaics.the_sky(scene)[0]
    finer = of_mosaics.CELL / of_mosaics.FINER
    total = sky.image.sum()
    sd = observe_with_dish(folder / "dish.im", sky.image, finer, (150.0, -30.0), 58.0, 1e11, 2e-3 * total, width=300.0)
    print("| image | SNR at half a beam, dB | at one beam | flux / true | noise of the dish, found / true |\n"
          "|---|---|---|---|---|")
    for label, options in (("without", {}), ("with total power", dict(sdimage=sd)),
                           ("with 20 % too much", dict(sdimage=sd, sdgain=1.2))):
        root = str(folder / f"tsara_{len(label)}")
        with quiet(folder / "tsara.txt"):
            made = tsara(**of_mosaics.common(names), imagename=root, overwrite=True, nthreads=1, **options)
        model, pb = read_image(root + ".model")[0], read_image(root + ".pb")[0]
        found, power = of_mosaics.scored(sky, model, pb, (3.4, 3.0, 0.0)), made["sara"].get("total_power")
        noise = power["noise_jy_per_beam"] / (2e-3 * total) if power else np.nan
        print(f"| {label} | {found[0.5]:.1f} | {found[1.0]:.1f} | {found['flux']:.4f} | {noise:.2f} | "
              f"{made['stopDescription']}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--scene")
    parser.add_argument("--noise", action="store_true")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    if args.scene:
        mosaic(args.folder.resolve(), args.scene)
    elif args.noise:
        realisations(args.folder.resolve())
    else:
        gaussian(args.folder.resolve())


if __name__ == "__main__":
    main()
