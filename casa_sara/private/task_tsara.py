"""The task tsara: what the user asked for, checked and handed to the imaging."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import casa_sara
from casa_sara.analysis import folder
from casa_sara.casa import log
from casa_sara.casa.blockwords import parsed
from casa_sara.casa.lock import one_run_of
from casa_sara.casa.modelcolumn import check_model_column_writable, incomplete_columns
from casa_sara.casa.products import (
    CHECKPOINT, REPORT, check_imagename, existing_products, history_lines, recover_products,
)
from casa_sara.casa.quantities import radians, seconds
from casa_sara.casa.restore import restoring_beam_words
from casa_sara.imaging import make_image
from casa_sara.options import Comparing, ImageGrid, Limits, Output, Selection, SolverOptions, Weighting
from casa_sara.private.summary import summary
from casa_sara.rehearsal import rehearse
from casa_sara.resources import available_cores

__all__ = ["selection_of", "tsara"]

ARCSEC = math.pi / 180 / 3600


def tsara(**parameters: Any) -> dict[str, Any]:
    """Run the task on validated parameters and return tclean's dictionary with a record `sara`."""
    log.info(f"casa_sara {casa_sara.__version__}")
    _check_stokes(parameters)
    selection = selection_of(parameters)
    grid = _grid(parameters)
    weighting = Weighting(parameters["weighting"], parameters["robust"], parameters["npixels"],
                          tuple(parameters["uvtaper"]))
    options = _solver_options(parameters)
    limits = Limits(parameters["maxmem"], _seconds(parameters["maxtime"]), parameters["report"])
    if parameters["dryrun"]:
        return {"forecast": rehearse(selection, grid, options, _blocks(parameters), limits)}
    check_imagename(parameters["imagename"], grid.shape, 2 * parameters["pbcor"] + grid.masked)
    with one_run_of(parameters["imagename"]):
        recover_products(parameters["imagename"])
        output = _output(parameters)
        if output.savemodel == "modelcolumn":
            check_model_column_writable(selection)
        _warn_of_incomplete(selection.vis, output)
        result = make_image(selection, grid, weighting, options, output,
                            lambda result: summary(result, options, full=True)["sara"], limits)
        if parameters["report"]:
            _report(output.imagename, selection, options.nthreads)
        elif not output.images_stand:
            folder.remove(Path(output.imagename + REPORT))  # of older images
    return summary(result, options, parameters["fullsummary"])


def _warn_of_incomplete(vis, output):
    """Point out model columns that a killed run left half written, unless this run writes them."""
    if output.savemodel == "modelcolumn":
        return
    for name in incomplete_columns(vis):
        log.warn(f"MODEL_DATA of '{name}' is incomplete, a run was killed while it wrote it: calibrate with it only "
                 "after tsara with restart=True, niter=0, savemodel='modelcolumn' has written it anew")


def _report(imagename, selection, nthreads):
    """Write the report of one run beside its images."""
    from casa_sara.analysis.report import write_report
    from casa_sara.compare import compare_images

    log.info("writing the report")
    comparison = compare_images(Comparing((imagename,), nthreads=nthreads), selection, single=True)
    write_report(comparison, Path(imagename + REPORT), f"tsara: {Path(imagename).name}")


def selection_of(parameters: dict[str, Any]) -> Selection:
    """Return the data selection in the parameters of a task."""
    vis = parameters["vis"]
    vis = (vis,) if isinstance(vis, str) else tuple(vis)
    chosen = {name: parameters[name] for name in Selection.PARAMETERS}
    chosen = {name: tuple(value) if isinstance(value, list) else str(value) for name, value in chosen.items()}
    return Selection(vis, datacolumn=parameters["datacolumn"], **chosen)


def _grid(parameters):
    shape = _pair(parameters["imsize"], "imsize", "one number of pixels, or two")
    cells = [_cell_rad(value) for value in _pair(parameters["cell"], "cell", "one pixel size as '0.1arcsec', or two")]
    return ImageGrid(tuple(int(n) for n in shape), tuple(cells), parameters["phasecenter"], parameters["projection"],
                     parameters["stokes"], parameters["reffreq"], parameters["usemask"], _mask(parameters), parameters["pbmask"])


def _check_stokes(parameters):
    """Raise on what does not go with Stokes Q, U and V."""
    stokes = parameters["stokes"]
    if stokes == "I":
        return
    for name, right, reason in (("positivity", False, "it may be negative"),
                                ("savemodel", "none", "the model column holds what both parallel hands see of Stokes I"),
                                ("report", False, "a report is of Stokes I")):
        if parameters[name] != right:
            raise ValueError(f"{name} = {parameters[name]!r} does not go with stokes = '{stokes}', {reason}: set {name} = {right!r}")


def _blocks(parameters):
    """The number of blocks, or the entries that name some of them."""
    blocks = parameters["blocks"]
    if isinstance(blocks, int):
        return blocks
    entries = (blocks,) if isinstance(blocks, str) else tuple(blocks)
    for entry in entries or ("",):
        parsed(entry)
    return entries


def _mask(parameters):
    """The entries of the mask."""
    mask = parameters["mask"]
    entries = tuple(entry for entry in ([mask] if isinstance(mask, str) else mask) if entry.strip())
    if parameters["usemask"] == "user" and parameters["pbmask"] and not entries:
        raise ValueError(f"pbmask = {parameters['pbmask']:g} has no effect without a mask, as in tclean: set usemask = 'pb', "
                         "give a mask, or leave pbmask at 0.0")
    return entries


def _pair(value, name, right):
    values = list(value) if isinstance(value, (list, tuple)) else [value]
    if len(values) not in (1, 2):
        raise ValueError(f"{name} = {value!r}: should be {right}")
    return values * 2 if len(values) == 1 else values


def _cell_rad(value):
    """One pixel size in radians; a number without unit is in arcsec, as in tclean."""
    try:
        size = float(value) * ARCSEC
    except ValueError:
        size = radians(value, "cell")
    if not 0 < size < 1:
        raise ValueError(f"cell = {value!r}: should be a positive angle, e.g. '0.1arcsec'")
    return size


def _seconds(maxtime):
    """The time limit in seconds, a number without unit being minutes; infinite where there is none."""
    if maxtime == "":
        return math.inf
    try:
        span = float(maxtime) * 60
    except ValueError:
        return seconds(maxtime, "maxtime")
    if not 0 < span < math.inf:
        raise ValueError(f"maxtime = {maxtime!r}: should be a positive number of minutes, or a time as '2h'; "
                         "'' sets no limit")
    return span


def _solver_options(parameters):
    if parameters["databound"] == "fixed" and not parameters["l2bound"]:
        raise ValueError(f"l2bound = {parameters['l2bound']!r}: databound='fixed' needs positive noise levels, one for all "
                         "blocks or one for each, in units of what the weights say")
    if not parameters["regscale"] > 0:
        raise ValueError(f"regscale = {parameters['regscale']!r}: should be positive; 1 is the noise")
    names = set(SolverOptions.__dataclass_fields__) - {"nthreads"}
    values = {name: tuple(value) if isinstance(value := parameters[name], list) else value for name in names}
    nthreads = min(parameters["nthreads"] or available_cores(), os.cpu_count() or 1)
    return SolverOptions(nthreads=nthreads, **values)


def _output(parameters):
    imagename = parameters["imagename"]
    startmodel = parameters["startmodel"]
    old, checkpoint = existing_products(imagename), imagename + CHECKPOINT
    images_stand = (parameters["restart"] and parameters["niter"] == 0 and parameters["savemodel"] == "modelcolumn"
                    and imagename + ".model" in old)
    unfinished = os.path.lexists(checkpoint) and not images_stand
    if parameters["restart"]:
        if not unfinished:
            startmodel = _model_to_continue(imagename, startmodel, old)
    elif unfinished and not parameters["overwrite"]:
        raise FileExistsError(f"imagename = '{imagename}': a run that has not finished left '{checkpoint}'; choose "
                              "another name, restart = True to go on from it, or overwrite = True to begin anew")
    elif old and not parameters["overwrite"]:
        raise FileExistsError(f"imagename = '{imagename}': {', '.join(old)} exist; choose another name, "
                              "overwrite = True to replace them, or restart = True to continue from the model")
    beam = tuple(restoring_beam_words(parameters["restoringbeam"])) if parameters["restoration"] else None
    return Output(imagename, startmodel, _blocks(parameters), beam, parameters["savemodel"], images_stand,
                  tuple(history_lines("tsara", parameters)), parameters["restart"] and unfinished,
                  parameters["pblimit"], parameters["pbcor"])


def _model_to_continue(imagename, startmodel, old):
    """Return the first model of a restart without a checkpoint: the old model, where there is one."""
    model = imagename + ".model"
    if model not in old:
        log.info(f"restart = True: there is neither '{imagename + CHECKPOINT}' nor '{model}': "
                 "starting from the beginning")
        return startmodel
    if startmodel:
        raise ValueError(f"startmodel = '{startmodel}' and restart = True both give the first model: set only one")
    log.info(f"restart = True: continuing from '{model}'")
    return model
