"""A small comparison made up for the tests of the report: Gaussians and noise, and the record of a run."""

import numpy as np

from casa_sara.analysis import metrics
from casa_sara.analysis.comparison import Comparison, Product

SHAPE, CELL = (96, 64), 0.1
BEAMS = {"natural": (0.9, 0.7, 30.0), "briggs": (0.5, 0.4, 30.0)}
WEIGHTINGS = tuple(BEAMS)


def truth():
    """Return two round sources, a ridge and a point, Jy/pixel."""
    x, y = np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij")

    def gaussian(x0, y0, wide, high):
        return np.exp(-(((x - x0) / wide) ** 2 + ((y - y0) / high) ** 2) / 2)

    image = 2e-3 * gaussian(25, 20, 3, 3) + 1e-3 * gaussian(70, 45, 5, 4) + 2e-4 * gaussian(48, 32, 25, 6)
    image[60, 20] += 3e-3
    return np.where(image > 1e-5, image, 0)


def record(configurations=("A", "D"), per_configuration=8, iterations=300, seed=3):
    """Return what tsara records of a run, as in its return dictionary."""
    rng = np.random.default_rng(seed)
    blocks = []
    for number, name in enumerate(configurations):
        for scan in range(per_configuration):
            start = 4.8e9 + number * 1e7 + scan * 2400.0 + (8 * 3600 if scan >= 5 else 0)
            measured = 1 + 0.03 * rng.standard_normal()
            found = measured * (1 + 0.4 * rng.random() * (number + 1))
            blocks.append({
                "ms": f"{name}.ms", "observations": [0], "scans": [10 * number + scan + 1], "start_mjd_s": start,
                "end_mjd_s": start + 1800, "samples": 4000 + 10 * scan, "noise_measured": measured,
                "noise_found": found, "l2_bound": found * np.sqrt(8000.0), "residual_norm": found * np.sqrt(8000.0),
                "nnls_residual_norm": 2 * found * np.sqrt(8000.0),
            })  # fmt: skip
    final = np.array([block["l2_bound"] for block in blocks])
    iteration = np.arange(1, iterations + 1)
    updates = [80, 140, 190, 235, 270]
    change = 0.3 * np.exp(-iteration / 60) * (1 + 0.3 * rng.random(iterations))
    for update in updates:
        change[update:] += 0.02 * np.exp(-(iteration[update:] - update) / 12)
    bounds = [{"iteration": at, "l2_bounds": final * (1 + 1.5 * np.exp(-at / 40))} for at in (0, 20, 45, 90, 160, 240)]
    norm = np.linalg.norm(final)
    return {
        "blocks": blocks,
        "bounds": bounds,
        "reweightings": [{"iteration": at, "scale": 1 / (k + 1), "model_change": 0.1, "released": 0}
                         for k, at in enumerate(updates)],
        "history": {"iteration": iteration, "reweighting": np.searchsorted(updates, iteration), "rel_change": change,
                    "residual_norm": norm * (1 + 5 * np.exp(-iteration / 25)), "model_flux": iteration * 0.0 + 1,
                    "model_max": iteration * 0.0 + 1},
    }


def product(name, seed, blur, noise=2e-4, **parts):
    """Return what an imager might make of the truth: blurred, with noise in the residuals."""
    rng = np.random.default_rng(seed)
    model = np.maximum(metrics.smooth(truth(), blur), 0)
    residual, restored = {}, {}
    for weighting, (major, minor, angle) in BEAMS.items():
        grain = metrics.smooth(rng.standard_normal(SHAPE), (major / CELL, minor / CELL), angle)
        left = metrics.smooth(truth() - model, (major / CELL, minor / CELL), angle)
        area = np.pi * major * minor / (4 * np.log(2)) / CELL**2
        residual[weighting] = noise * grain / grain.std() + area * left
        restored[weighting] = area * metrics.smooth(model, (major / CELL, minor / CELL), angle) + residual[weighting]
    return Product(name, model, residual, restored, **parts)


def measures(products, sky, regions):
    """Return numbers of the kind that a comparison has."""
    found = {}
    for made in products:
        entry = {
            "flux_jy": float(made.model.sum()), "peak_jy_per_pixel": float(made.model.max()),
            "negative_jy": float(made.model.clip(max=0).sum()), "mdr": 1234.5, "fwhm_recovered_arcsec": 0.21,
            "regions": {name: {"flux_jy": float(made.model[mask].sum()), "error_jy": 1.3e-3,
                                   "model_flux_jy": float(made.model[mask].sum())}
                        for name, mask in regions.items()},
        }  # fmt: skip
        for weighting, residual in made.residual.items():
            entry[weighting] = {
                "sigma": float(residual.std()), "peak": float(made.restored[weighting].max()),
                "dr": metrics.dynamic_range(made.restored[weighting], residual),
                "max_abs": float(np.abs(residual).max()), "skewness": 0.12, "kurtosis": -0.03, "whiteness": 0.9,
                "chi_square": [1.0, 1.1, 1.4],
            }  # fmt: skip
        if sky is not None:
            entry["truth"] = {"snr": metrics.snr(sky, made.model), "log_snr": metrics.log_snr(sky, made.model),
                              "ssim": 0.97, "ssim_range_jy_per_pixel": float(sky.max()),
                              "snr_at_scale": {"0.4": 30.0, "1.0": 40.0}}
        found[made.name] = entry
    found[products[0].name]["injected"] = {"19h59m28.3s +40d44m12s": {
        "injected_jy": 0.02, "flux_jy": 0.019, "offset_arcsec": 0.02, "fwhm_arcsec": 0.25,
        "fwhm_in_beams": {name: 0.25 / np.sqrt(beam[0] * beam[1]) for name, beam in BEAMS.items()},
    }}  # fmt: skip
    pairs = {f"{a.name}|{b.name}": metrics.snr(a.model, b.model)
             for number, a in enumerate(products) for b in products[number + 1 :]}
    return {"products": found, "similarity": {weighting: dict(pairs) for weighting in WEIGHTINGS}}


def comparison(names=("tsara", "tclean briggs", "tclean natural"), with_truth=True, with_regions=True, frames=()):
    """Return a comparison with everything in it."""
    parameters = {"vis": "['A.ms', 'D.ms']", "imsize": "[96, 64]", "cell": "0.1arcsec"}
    products = tuple(
        product(name, number, 0.5 + 3 * number, parameters={**parameters, "niter": str(100 * number)},
                record=record() if number == 0 else {})
        for number, name in enumerate(names)
    )
    masks = {}
    if with_regions:
        masks = {name: np.zeros(SHAPE, bool) for name in ("core", "lobe")}
        masks["core"][18:33, 14:28] = True
        masks["lobe"][60:82, 36:56] = True
    sky = truth() if with_truth else None
    return Comparison(products, (CELL, CELL), (299.868, 40.734), dict(BEAMS), sky, truth() > 0, masks,
                      measures(products, sky, masks), {"casa_sara": "1.2.3", "numpy": "2.0"},
                      ("one sample was wild & left out",), frames)
