"""The dictionary that tsara returns: tclean's, and what SARA knows besides."""

from __future__ import annotations

from typing import Any

import numpy as np

import casa_sara
from casa_sara.solver.record import ITERATION_LIMIT, STOP_DESCRIPTIONS

__all__ = ["summary"]

WHY = {
    "threshold_jy_per_pixel": "kappa of the last iteration: starts at 0.15 of the mean brightness of the NNLS image, "
    "shrinks with every re-weighting, is halved where the residual rises; sets the pace only",
    "noise_jy_per_beam": "of the naturally weighted dirty image, from the weights and the noise levels found",
    "data_norm_sq": "largest eigenvalue of the preconditioned normal operator, by Lanczos iterations",
    "regscale": "as given; 1 weighs the prior at the noise of one coefficient of the gradient of the data",
}


def summary(result, options, full: bool = False) -> dict[str, Any]:
    """Return the outcome of a run.

    Parameters
    ----------
    result : casa_sara.imaging.Result
    options : casa_sara.options.SolverOptions
    full : bool
        Add the history of every iteration.

    Returns
    -------
    dict
        `iterdone, niter, nmajordone, stopcode, stopDescription, summarymajor, summaryminor` as of tclean (a
        major cycle is one re-weighted problem) and `sara`: version, blocks with their bounds, re-weightings,
        chosen parameters, dropped samples and notes.
    """
    solved = result.reconstruction
    record = solved.record if solved else None
    ends = [update["iteration"] for update in record.reweightings] + [record.iteration[-1]] if record else []
    code = record.stop_code if record else ITERATION_LIMIT
    minor = {"iterDone": ends, "peakRes": [result.residual_peak], "modelFlux": [result.model_flux]}
    return {
        "iterdone": ends[-1] if ends else 0,
        "niter": options.niter,
        "nmajordone": max(len(ends), 1),
        "stopcode": code,
        "stopDescription": STOP_DESCRIPTIONS[code],
        "summarymajor": np.array(ends, int),
        "summaryminor": {0: {0: {0: minor}}},
        "sara": _sara(result, options, full),
    }


def _sara(result, options, full):
    data, solved = result.data, result.reconstruction
    sara = {
        "version": casa_sara.__version__,
        "visibilities": data.size,
        "dropped": dict(data.dropped),
        "notes": list(data.notes),
        "blocks": [_block(result, j) for j in range(len(result.blocks))],
        "suspects": [dict(suspect) for suspect in result.suspects],
        "nthreads": options.nthreads,
        "forecast": dict(result.forecast),
    }
    if solved:
        record = solved.record
        sara["chosen"] = {
            "threshold_jy_per_pixel": solved.threshold,
            "noise_jy_per_beam": solved.noise_jy_per_beam,
            "data_norm_sq": solved.data_norm_sq,
            "regscale": options.regscale,
        }
        sara["why"] = dict(WHY)
        sara["resumed"] = list(record.resumed)
        sara["wild"] = [dict(sample) for sample in solved.wild]
        sara["reweightings"] = [dict(update) for update in record.reweightings]
        sara["bounds"] = [{"iteration": iteration, "l2_bounds": bounds} for iteration, bounds in record.bounds]
        if full:
            columns = ("iteration", "reweighting", "rel_change", "residual_norm", "model_flux", "model_max")
            sara["history"] = {name: np.array(getattr(record, name)) for name in columns}
    return sara


def _block(result, j):
    block, solved = result.blocks[j], result.reconstruction
    entry = {
        "ms": block.ms_name,
        "observations": list(block.observations),
        "scans": list(block.scans),
        "start_mjd_s": block.start,
        "end_mjd_s": block.end,
        "samples": block.samples,
        "noise_measured": float(result.noise[j]),
    }
    if solved:
        entry["l2_bound"] = float(solved.l2_bounds[j])
        entry["residual_norm"] = float(solved.residual_norms[j])
        entry["noise_found"] = float(solved.l2_bounds[j] / np.sqrt(2.0 * block.samples))
        entry["nnls_residual_norm"] = float(solved.nnls_norms[j])
    return entry
