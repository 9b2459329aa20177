"""The dictionary that tsara returns: that of tclean, and a record of SARA."""

from __future__ import annotations

from typing import Any

import numpy as np

from casa_sara.imaging.continuum import Result
from casa_sara.imaging.cube import CubeResult
from casa_sara.imaging.polarisation import PolarisedResult
from casa_sara.options import SolverOptions
from casa_sara.solver.record import ITERATION_LIMIT, STOP_DESCRIPTIONS
from casa_sara.version import __version__

__all__ = ["cube_summary", "polarised_summary", "summary"]

WHY = {
    "threshold_jy_per_pixel": "kappa of the last iteration: starts at 0.15 of the mean brightness of the NNLS image, "
    "decreases with every re-weighting, and is halved where the residual rises; affects the speed of convergence only",
    "noise_jy_per_beam": "of the naturally weighted dirty image, computed from the MS weights and the noise found",
    "data_norm_sq": "largest eigenvalue of the preconditioned normal operator, by Lanczos iterations",
    "regscale": "the task parameter; with 1, the weight of the prior is the noise of one coefficient of the gradient "
                "of the "
    "data term",
}
PAPER_WHY = {
    "threshold_jy_per_pixel": "kappa: constant, 1e-5 of the brightest pixel of the first image",
    "regscale": "not used by this method",
}


def summary(result: Result, options: SolverOptions, full: bool = False) -> dict[str, Any]:
    """Return the outcome of a run.

    Parameters
    ----------
    result : casa_sara.imaging.continuum.Result
        The results of the run.
    options : casa_sara.options.SolverOptions
        Task parameters of the method.
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
    ends = _ends(result)
    code = record.stop_code if record else ITERATION_LIMIT
    minor = {"iterDone": ends, "peakRes": [result.residual_peak], "modelFlux": [result.model_flux]}
    outcome = _outcome(options, ends, code, {0: {0: minor}}, _sara(result, options, full))
    outcome["summaryminor"] |= {number: {0: {0: {"iterDone": ends, "peakRes": [one.images.residual_peak],
                                                 "modelFlux": [one.images.model_flux]}}}
                                for number, one in enumerate(result.outliers, 1)}  # as tclean numbers image fields
    return outcome


def cube_summary(result: CubeResult, options: SolverOptions, full: bool = False) -> dict[str, Any]:
    """Return the outcome of a run that made a cube.

    Parameters
    ----------
    result : casa_sara.imaging.cube.CubeResult
        The results of the run.
    options : casa_sara.options.SolverOptions
        Task parameters of the method.
    full : bool
        Add the history of every iteration.

    Returns
    -------
    dict
        As of :func:`summary`, the iterations counted through all channels; `summaryminor` has every channel that is not
        blank, with its stop code, and `sara` a record of each.
    """
    minor, ends, done = {}, [], 0
    for number, channel in enumerate(result.channels):
        if channel.result:
            minor[number] = {0: _minor(channel.result, result.code_of(channel))}
            ends += [done + end for end in minor[number][0]["iterDone"]]
            done = ends[-1] if ends else 0
    sara = _run(result, options, result.data.size) | {
        "outframe": result.frame,
        "channels": [_channel(channel, result.code_of(channel), options, full) for channel in result.channels],
    }
    return _outcome(options, ends, result.stop_code, minor, sara)


def polarised_summary(result: PolarisedResult, options: SolverOptions, full: bool = False) -> dict[str, Any]:
    """Return the outcome of a run that made several Stokes parameters.

    Parameters
    ----------
    result : casa_sara.imaging.polarisation.PolarisedResult
        The results of the run.
    options : casa_sara.options.SolverOptions
        Task parameters of the method.
    full : bool
        Add the history of every iteration.

    Returns
    -------
    dict
        As of :func:`summary`, of the Stokes parameter that took most iterations; `summaryminor` has all of them with
        their stop codes, and `sara` a record of each.
    """
    ends = max((_ends(one) for one in result.planes.values()), key=lambda one: one[-1:])
    minor = {number: _minor(one, result.code_of(stokes))
             for number, (stokes, one) in enumerate(result.planes.items())}
    sara = _run(result, options, result.data.size) | {
        "polbound": options.polbound,
        "polarised_above_jy_per_pixel": result.polarised_above,
        "stokes": [_stokes(stokes, one, sumwt, result.code_of(stokes), options, full)
                   for (stokes, one), sumwt in zip(result.planes.items(), result.sumwt)],
    }
    return _outcome(options, ends, result.stop_code, {0: minor}, sara)


def _stokes(stokes, result, sumwt, code, options, full):
    """Return the record of one Stokes parameter."""
    entry = {"stokes": stokes, "sumwt": sumwt, "model_flux_jy": result.model_flux, "stopcode": code,
             "stopDescription": STOP_DESCRIPTIONS[code], "suspects": [dict(suspect) for suspect in result.suspects],
             "blocks": [_block(result, j) for j in range(len(result.blocks))]}
    return entry | _solution(result, options, full)


def _outcome(options, ends, code, minor, sara):
    """Return tclean's dictionary; `ends` are the iterations at which the problems ended."""
    return {
        "iterdone": ends[-1] if ends else 0,
        "niter": options.niter,
        "nmajordone": max(len(ends), 1),
        "stopcode": code,
        "stopDescription": STOP_DESCRIPTIONS[code],
        "summarymajor": np.array(ends, int),
        "summaryminor": {0: minor},
        "sara": sara,
    }


def _channel(channel, code, options, full):
    """Return the record of one channel."""
    entry = {"frequency_hz": channel.freq_hz, "sumwt": channel.sumwt, "blank": channel.result is None}
    if channel.result is None:
        return entry
    result = channel.result
    axes = {name: channel.beam[name] for name in ("major", "minor", "positionangle")}
    beam = {name: f"{axis['value']:.9g}{axis['unit']}" for name, axis in axes.items()}
    entry |= {"visibilities": result.data.size, "dropped": dict(result.data.dropped), "beam": beam, "stopcode": code,
              "stopDescription": STOP_DESCRIPTIONS[code],
              "blocks": [_block(result, j) for j in range(len(result.blocks))]}
    return entry | _solution(result, options, full)


def _ends(result):
    """Return the iterations after which the ℓ1 problems of a solution ended."""
    if not result.reconstruction:
        return []
    record = result.reconstruction.record
    return [update["iteration"] for update in record.reweightings] + [record.iteration[-1]]


def _minor(result, code):
    """Return tclean's entry of one channel in `summaryminor`, and its stop code."""
    return {"iterDone": _ends(result), "peakRes": [result.residual_peak], "modelFlux": [result.model_flux],
            "stopCode": code}


def _sara(result, options, full):
    sara = _run(result, options, result.size) | {
        "blocks": [_block(result, j) for j in range(len(result.blocks))],
        "suspects": [dict(suspect) for suspect in result.suspects],
    }
    if result.subbands is not None:
        sara["spectra"] = {"frequencies_hz": result.subbands.freqs_hz, "reference_hz": result.subbands.reference_hz,
                           "shares": result.subbands.shares}
    if result.outliers:
        sara["outliers"] = [one.summary() for one in result.outliers]
    return sara | _solution(result, options, full)


def _run(result, options, visibilities):
    """Return what every record begins with."""
    return {
        "version": __version__,
        "method": options.method,
        "visibilities": visibilities,
        "dropped": dict(result.data.dropped),
        "notes": list(result.data.notes),
        "nthreads": options.nthreads,
        "forecast": dict(result.forecast),
    }


def _solution(result, options, full):
    """Return the entries about a solution, none where there is none."""
    solved, sara = result.reconstruction, {}
    if solved:
        record = solved.record
        sara["chosen"] = {
            "threshold_jy_per_pixel": solved.threshold,
            "noise_jy_per_beam": solved.noise_jy_per_beam,
            "data_norm_sq": solved.data_norm_sq,
            "regscale": options.regscale,
        }
        sara["why"] = WHY | (PAPER_WHY if options.method == "dabbech2018" else {})
        sara["resumed"] = list(record.resumed)
        sara["wild"] = [dict(sample) for sample in solved.wild]
        sara["averaging"] = dict(solved.averaging)
        sara["islands"] = [dict(island) for island in record.islands]
        sara["residual_snr"] = [dict(peak) for peak in record.residual_snr]
        sara["gain_errors"] = dict(record.gain_errors)
        if solved.draws is not None:
            sara["draws"] = {"asked": options.ndraws, "made": len(solved.draws)}
        if solved.jackknife is not None:
            sara["jackknife"] = {"groups": solved.jackknife.asked, "made": len(solved.jackknife)}
        sara["reweightings"] = [dict(update) for update in record.reweightings]
        blocks = len(result.blocks)  # without that of a single dish
        sara["bounds"] = [{"iteration": iteration, "l2_bounds": bounds[:blocks]} for iteration, bounds in record.bounds]
        if solved.total_power:
            sara["total_power"] = dict(solved.total_power)
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
    if block.band_hz:
        entry["band_hz"] = list(block.band_hz)
    if solved:
        entry["l2_bound"] = float(solved.l2_bounds[j])
        entry["residual_norm"] = float(solved.residual_norms[j])
        entry["noise_found"] = float(solved.l2_bounds[j] / np.sqrt(2.0 * block.samples))
        entry["nnls_residual_norm"] = float(solved.nnls_norms[j])
    return entry
