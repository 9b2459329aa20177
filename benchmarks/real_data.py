"""tsara beside tclean multiscale on the real observations of ../shared/data: a table and a picture of each.

    python benchmarks/real_data.py [NAME ...] [--out real-data] [--only clean|tsara|table] [--twice]

All with the same data, cell, image size and natural weights: tsara with defaults, tclean in the masks that
usemask='auto-multithresh' finds, and tclean without a mask, deep. The runs of tclean are kept in the output folder
and not repeated where they are there; tsara is run anew. `--twice` images also twice the width with tsara: its flux,
and that within the original field. For M87, each of its two bands beside the published image of that band: χ²/N,
Σ w|y − Φx|²/(2N).

The table: σ is the standard deviation of the residual image; DR the peak over σ; χ² that of the residual visibilities
with the noise measured from successive integrations, in eighths of the samples from the shortest baselines to the
longest, 1 where noise is left; and the largest |residual| of the image smoothed to 1, 2, 4 and 8 beams over the noise
expected there.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tarfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

DATA = Path(__file__).resolve().parents[2] / "shared/data/ms"
# MeasurementSet, image size, cell in arcsec, scales of tclean, its iterations, spw
SETS = {
    "3C273": ("VLA_3C273_X", 256, 0.5, [0, 3, 9, 18], 10_000, ""),
    "HD142527": ("ALMA_HD142527_B9cont", 256, 0.03, [0, 5, 15, 30], 10_000, ""),
    "Sgr A": ("VLA_SgrA_L", 720, 3.0, [0, 5, 15, 45], 5_000, ""),
    "M87 low": ("EHT_M87_2017_101_selfcal", 128, 2e-6, [0, 5, 10], 10_000, "0"),
    "M87 high": ("EHT_M87_2017_101_selfcal", 128, 2e-6, [0, 5, 10], 10_000, "1"),
    "NGC5921 continuum": ("VLA_NGC5921_cont", 128, 10.0, [0, 4, 12], 10_000, ""),
    "NGC5921 HI": ("VLA_NGC5921_HI_ch16-45", 128, 10.0, [0, 4, 12], 10_000, ""),
    "DM Tau": ("SMA_DMTau_CO21", 128, 0.2, [0, 5, 15], 10_000, ""),
}
# the masks with the parameters of ALMA's pipeline; nsigma as without them
CLEAN = {
    "tclean masked": dict(usemask="auto-multithresh", noisethreshold=4.25, nsigma=2.0),
    "tclean deep": dict(nsigma=2.0),
}
SIDELOBES = (2.0, 1.25, 0.6)  # sidelobethreshold: the pipeline's, or the first of the lower ones that finds a mask
# no mask is found where the shortest baselines outweigh all others: 40 µas around the centre of the ring
RING = {"tclean masked": dict(usemask="user", mask="circle[[64pix, 64pix], 20pix]")}
CAREFUL = dict(gain=0.1, cyclefactor=3.0)  # or it diverges: a bright source larger than most scales, three snapshots
CHANGED = {"M87 low": RING, "M87 high": RING, "Sgr A": {imager: CAREFUL for imager in CLEAN}}
IMAGERS = ("tsara", *CLEAN)
EMPTY = 7  # tclean's stopcode for a mask without a pixel
STOPS = {1: "limit", 2: "threshold", 4: "no change", 5: "diverged", 6: "diverged", EMPTY: "empty mask", 8: "nsigma"}
PUBLISHED = {"M87 low": "M87_original_lowfreq.fits", "M87 high": "M87_original_highfreq.fits"}
HEADS = ("data", "imager", "flux Jy", "peak Jy/beam", "σ residual", "DR", "χ², short to long baselines",
         "largest residual, 1, 2, 4, 8 beams", "noise found (measured)", "s", "iterations")


class Case:
    """One observation: where it is, how it is imaged, and what was made of it."""

    def __init__(self, name, out):
        file, self.size, self.cell, self.scales, self.niter, self.spw = SETS[name]
        self.name, self.folder = name, out / name.replace(" ", "_")
        self.folder.mkdir(parents=True, exist_ok=True)
        if not list(self.folder.glob("*.ms")):
            with tarfile.open(DATA / f"{file}.ms.tgz") as archive:
                archive.extractall(self.folder, filter="data")
        self.vis = next(self.folder.glob("*.ms"))

    def common(self, imager, size=None):
        """Return the parameters that all imagers share."""
        return dict(vis=str(self.vis), imagename=str(self.folder / imager.replace(" ", "_")), spw=self.spw,
                    imsize=size or self.size, cell=f"{self.cell}arcsec", datacolumn="data")

    def keep(self, imager, record):
        """Keep images and numbers of a run."""
        from casa_sara.demo.imagers import read_image

        root = self.folder / imager.replace(" ", "_")
        images = {kind: read_image(f"{root}.{kind}")[0] for kind in ("model", "image", "residual")}
        np.savez_compressed(f"{root}.npz", **images, beam=read_image(f"{root}.image")[1])
        Path(f"{root}.json").write_text(json.dumps(record, indent=1))

    def kept(self, imager):
        """Return the images and numbers of a run, None where there are none."""
        root = self.folder / imager.replace(" ", "_")
        if not Path(f"{root}.json").exists():
            return None
        return dict(np.load(f"{root}.npz")), json.loads(Path(f"{root}.json").read_text())


def run_clean(case, imager):
    """tclean multiscale, unless it was run before."""
    if case.kept(imager) is not None:
        return
    from casa_sara.demo.imagers import quiet

    name, chosen = imager.replace(" ", "_"), CLEAN[imager] | CHANGED.get(case.name, {}).get(imager, {})
    for sidelobes in SIDELOBES if chosen.get("usemask") == "auto-multithresh" else (None,):
        for left in case.folder.glob(f"{name}.*"):  # of an empty mask, or of a run that was cut off
            shutil.rmtree(left) if left.is_dir() else left.unlink()
        if sidelobes:
            chosen["sidelobethreshold"] = sidelobes
        with quiet(case.folder / f"{name}.txt"):
            from casatasks import tclean

            begin = time.perf_counter()
            made = tclean(**case.common(imager), deconvolver="multiscale", scales=case.scales, niter=case.niter,
                          **{"gain": 0.2, **chosen})
            seconds = time.perf_counter() - begin
        if made["stopcode"] != EMPTY or made["iterdone"]:
            break
    stop = STOPS.get(made["stopcode"], f"code {made['stopcode']}")
    case.keep(imager, {"seconds": seconds, "iterations": int(made["iterdone"]), "stop": stop,
                       "sidelobethreshold": sidelobes})


def run_tsara(case, twice):
    """tsara with defaults, and on an image of twice the width if asked for."""
    from casa_sara import tsara
    from casa_sara.demo.imagers import quiet, read_image

    with quiet(case.folder / "tsara.txt"):
        begin = time.perf_counter()
        made = tsara(**case.common("tsara"), overwrite=True)
        seconds = time.perf_counter() - begin
        wider = tsara(**case.common("tsara_twice", 2 * case.size), overwrite=True) if twice else None
    blocks = made["sara"]["blocks"]
    measured = np.array([block["noise_measured"] for block in blocks], float)
    record = {"seconds": seconds, "iterations": int(made["iterdone"]), "stop": made["stopDescription"],
              "noise_found": float(np.median([block["noise_found"] for block in blocks])),
              "noise_measured": float(np.nanmedian(measured)) if np.isfinite(measured).any() else None}
    if twice:
        model = read_image(case.folder / "tsara_twice.model")[0]
        first = case.size - case.size // 2
        inner = model[first:first + case.size, first:first + case.size]
        record["twice"] = {"flux": float(model.sum()), "inside": float(inner.sum()),
                           "iterations": int(wider["iterdone"]), "stop": wider["stopDescription"]}
    case.keep("tsara", record)


def lines(case):
    """Return the lines of the table, one for each imager that has been run; draw the picture of them."""
    from residual_checks import Observed

    from casa_sara.options import Selection

    runs = {imager: case.kept(imager) for imager in IMAGERS}
    runs = {imager: run for imager, run in runs.items() if run is not None}
    observed = Observed(Selection((str(case.vis),), spw=case.spw, datacolumn="data"), case.size, case.cell)
    rows, misfits, measures = [], {}, {}
    for imager, (images, record) in runs.items():
        left = observed.left(images["model"])
        chi, largest = observed.chi_square(left), observed.largest(images["residual"], images["beam"])
        misfits[imager], peak, sigma = observed.misfit(left), images["image"].max(), images["residual"].std()
        measures[imager] = {"flux": float(images["model"].sum()), "peak": float(peak), "sigma": float(sigma),
                            "sigma_one_operator": float(observed.natural(left).std()), "chi_square": chi,
                            "largest": largest, "noise_measured": observed.noise, **record}
        noise = f"{record['noise_found']:.3g} ({observed.noise:.3g})" if "noise_found" in record else ""
        rows.append(f"| {case.name} | {imager} | {images['model'].sum():.4g} | {peak:.4g} | {sigma:.3g} | "
                    f"{peak / sigma:.3g} | {' '.join(f'{value:.3g}' for value in chi)} | "
                    f"{', '.join(f'{value:.3g}' for value in largest)} | {noise} | "
                    f"{record['seconds']:.0f} | {record['iterations']}, {record['stop']} |")
    (case.folder / "measures.json").write_text(json.dumps(measures, indent=1))
    picture(case.folder / "comparison.png", case.name, {imager: images for imager, (images, _) in runs.items()})
    return rows, _notes(case, observed, runs, misfits)


def _notes(case, observed, runs, misfits):
    """Return what stands below the table: χ²/N beside that of a published image, and images of twice the width."""
    notes = []
    if case.name in PUBLISHED:
        image, cell, centre = _published(case.name)
        misfits = misfits | {"the published image": observed.misfit(observed.left(image, cell, centre))}
        notes.append(f"{case.name}: χ²/N of " + ", ".join(f"{key} {value:.2f}" for key, value in misfits.items()))
    for imager, (images, record) in runs.items():
        if "twice" in record:
            wider = record["twice"]
            notes.append(f"{case.name}, {imager} on twice the width: {wider['flux']:.4g} Jy, {wider['inside']:.4g} of "
                         f"them in the original field ({images['model'].sum():.4g} Jy alone); {wider['iterations']} "
                         f"iterations, {wider['stop']}")
    return notes


def _published(name):
    """The published image, its cell in arcsec, and the pixel of its centre."""
    from astropy.io import fits

    with fits.open(DATA.parent / "reference" / PUBLISHED[name]) as hdus:
        header, image = hdus[0].header, hdus[0].data.squeeze().T.astype(float)
    return image, abs(header["CDELT2"]) * 3600, (header["CRPIX1"] - 1, header["CRPIX2"] - 1)


def picture(path, name, runs):
    """Draw model, restored image and residual of each imager, each kind on one scale."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(runs), 3, figsize=(13, 4 * len(runs)), constrained_layout=True, squeeze=False)
    spread = 8 * min(images["residual"].std() for images in runs.values())
    first = next(iter(runs.values()))
    for row, (imager, images) in zip(axes, runs.items()):
        for axis, kind in zip(row, ("model", "image", "residual")):
            scale = dict(cmap="RdBu_r", vmin=-spread, vmax=spread)
            shown, title = images[kind], f"{name}: {imager}, {kind}"
            if kind != "residual":
                top = np.log10(first[kind].max() or 1.0)
                shown = np.log10(np.maximum(shown, 10 ** (top - 4)))
                scale = dict(cmap="inferno", vmin=top - 4, vmax=top)
                title += ", log10"
            else:
                title += f", σ {images[kind].std():.3g} Jy/beam"
            drawn = axis.imshow(shown.T, origin="lower", interpolation="nearest", **scale)
            axis.set_title(title, fontsize=9)
            axis.tick_params(labelsize=7)
        figure.colorbar(drawn, ax=row[-1])
    figure.savefig(path, dpi=80)
    plt.close(figure)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", default=list(SETS))
    parser.add_argument("--out", type=Path, default=Path("real-data"), help="folder for data, images and pictures")
    parser.add_argument("--only", choices=("clean", "tsara", "table"), help="run tclean, or tsara, or neither")
    parser.add_argument("--twice", action="store_true", help="tsara also on an image of twice the width")
    options = parser.parse_args()
    sys.argv = sys.argv[:1]  # CASA reads the command line, too
    notes = []
    print(f"| {' | '.join(HEADS)} |\n" + "|---" * len(HEADS) + "|", flush=True)
    for name in options.names:
        case = Case(name, options.out.resolve())
        if options.only in (None, "clean"):
            for imager in CLEAN:
                run_clean(case, imager)
        if options.only in (None, "tsara"):
            run_tsara(case, options.twice)
        rows, more = lines(case)
        print("\n".join(rows), flush=True)
        notes += more
    print("", *notes, sep="\n\n" if notes else "")


if __name__ == "__main__":
    main()
