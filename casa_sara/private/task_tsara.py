"""The task tsara: checks its parameters and runs the imaging."""

from __future__ import annotations

import math
import os
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any

from casa_sara.analysis import folder
from casa_sara.casa.images.products import (
    CHECKPOINT,
    PRODUCTS,
    REPORT,
    check_imagename,
    existing_products,
    history_lines,
    recover_products,
)
from casa_sara.casa.images.restore import restoring_beam_words
from casa_sara.casa.images.spectral_axis import channel_number
from casa_sara.casa.images.spectral_index import check_spectral_index
from casa_sara.casa.ms.block_selection import parsed
from casa_sara.casa.ms.model_column import check_model_column_writable, incomplete_columns
from casa_sara.casa.runtime import log
from casa_sara.casa.runtime.lock import one_run_of
from casa_sara.casa.runtime.quantities import hertz, seconds
from casa_sara.imaging.continuum import make_image
from casa_sara.imaging.cube import make_cube
from casa_sara.imaging.dry_run import dry_run
from casa_sara.imaging.polarisation import make_polarised
from casa_sara.options import (
    Comparing,
    ImageGrid,
    ImagingRequest,
    Limits,
    Output,
    Selection,
    SingleDish,
    SolverOptions,
    Weighting,
)
from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.private.launch import in_parallel
from casa_sara.private.outlier_file import read_outlier_file
from casa_sara.private.pixels import cell_rad, pair
from casa_sara.private.summary import cube_summary, polarised_summary, summary
from casa_sara.runtime.machine import available_cores
from casa_sara.version import __version__

__all__ = ["selection_of", "tsara"]

MOST_TERMS = 6


def tsara(**parameters: Any) -> dict[str, Any]:
    """Run the task on validated parameters and return tclean's dictionary with a record `sara`."""
    _check_method(parameters)
    _refuse_for_mosaics(parameters)
    _check_single_dish(parameters)
    _refuse_for_spectra(parameters)
    _refuse_for_outliers(parameters)
    _refuse_for_several_stokes(parameters)
    return in_parallel(run, parameters) if parameters["parallel"] else run(parameters)


def run(parameters: dict[str, Any], comm: Serial = SERIAL) -> dict[str, Any]:
    """Run the task on the ranks of a communicator, of which rank 0 alone writes; return the same on all."""
    log.info(f"casa_sara {__version__}")
    _check_stokes(parameters)
    if parameters["method"] == "dabbech2018":
        log.info("method = 'dabbech2018': Algorithms 1 and 2 exactly as in Dabbech et al. (2018)")
    selection = selection_of(parameters)
    grid = _grid(parameters)
    weighting = Weighting(parameters["weighting"], parameters["robust"], parameters["npixels"],
                          tuple(parameters["uvtaper"]), parameters["mosweight"])
    options = _solver_options(parameters, comm)
    _refuse_for_cubes(parameters)
    _check_errors(parameters)
    limits = Limits(parameters["maxmem"], _seconds(parameters["maxtime"]), parameters["report"])
    if parameters["dryrun"] and comm.size > 1:
        raise ValueError("dryrun = True with parallel = True: a dry run takes one process; the memory of each rank is "
                         "in the first lines of the log of a normal run, and docs/parallel.md explains its time")
    if parameters["dryrun"]:
        output = Output(parameters["imagename"], blocks=_blocks(parameters))
        return {"forecast": dry_run(selection, grid, options, output, limits)}
    make, tell = _face_of(grid)
    with ExitStack() as stack:
        output = comm.once(_prepare, parameters, selection, grid, stack)
        grid = _continued(grid, output)
        dish = SingleDish(parameters["sdimage"], parameters["sdpsf"], parameters["sdgain"])
        result = make(ImagingRequest(selection, grid, weighting, options, output, limits, dish),
                      lambda result: tell(result, options, full=True)["sara"], comm)
        if parameters["report"]:
            comm.once(_report, output.imagename, selection, options.nthreads, grid.is_cube)
        elif not output.images_stand:
            comm.once(folder.remove, Path(output.imagename + REPORT))  # of older images
    return comm.bcast(tell(result, options, parameters["fullsummary"]))


def _face_of(grid):
    """Return what makes such an image, and what tells of it."""
    if len(grid.stokes) > 1:
        return make_polarised, polarised_summary
    return (make_cube, cube_summary) if grid.is_cube else (make_image, summary)


def _prepare(parameters, selection, grid, stack):
    """Take the imagename for as long as the stack lasts, and return the options of the output."""
    more = 2 * parameters["pbcor"] + grid.masked + 2 * bool(parameters["ndraws"]) + parameters["jackknife"]
    more = len(grid.stokes) * (len(PRODUCTS) + more) - len(PRODUCTS)
    for imagename, shape in zip(_imagenames(parameters, grid), grid.shapes):
        check_imagename(imagename, shape, more)
        stack.enter_context(one_run_of(imagename))
        recover_products(imagename)
    output = _output(parameters, grid)
    if output.savemodel == "modelcolumn":
        check_model_column_writable(selection)
    _warn_of_incomplete(selection.vis, output)
    return output


def _imagenames(parameters, grid):
    """Return the imagenames of the main image and of its outliers."""
    return [parameters["imagename"], *(outlier.imagename for outlier in grid.outliers)]


def _warn_of_incomplete(vis, output):
    """Warn of model columns that a killed run left incomplete, unless this run writes them."""
    if output.savemodel == "modelcolumn":
        return
    for name in incomplete_columns(vis):
        log.warn(f"MODEL_DATA of '{name}' is incomplete, because a run was killed while it wrote it. Do not calibrate "
                 "with it before tsara with restart=True, niter=0, savemodel='modelcolumn' has written it again")


def _report(imagename, selection, nthreads, cube):
    """Write the report of one run."""
    from casa_sara.analysis.cube_report import write_cube_report
    from casa_sara.analysis.report import write_report
    from casa_sara.comparison.compare_cubes import compare_cubes
    from casa_sara.comparison.compare_images import compare_images

    log.info("writing the report")
    compare, write = (compare_cubes, write_cube_report) if cube else (compare_images, write_report)
    comparison = compare(Comparing((imagename,), nthreads=nthreads), selection, single=True)
    write(comparison, Path(imagename + REPORT), f"tsara: {Path(imagename).name}")


def selection_of(parameters: dict[str, Any]) -> Selection:
    """Return the data selection in the parameters of a task."""
    vis = parameters["vis"]
    vis = (vis,) if isinstance(vis, str) else tuple(vis)
    chosen = {name: parameters[name] for name in Selection.PARAMETERS}
    chosen = {name: tuple(value) if isinstance(value, list) else str(value) for name, value in chosen.items()}
    return Selection(vis, datacolumn=parameters["datacolumn"], **chosen)


def _grid(parameters):
    planes = parameters["wprojplanes"]
    if planes in (0, 1):
        raise ValueError(f"wprojplanes = {planes} would leave the w-term out, as gridder = 'standard' does; should be "
                         "-1, or 2 or more")
    if planes > 1:
        log.info(f"wprojplanes = {planes}: not used, the w-term is computed exactly, without planes")
    shape = pair(parameters["imsize"], "imsize", "one number of pixels, or two")
    cells = [cell_rad(value) for value in pair(parameters["cell"], "cell", "one pixel size as '0.1arcsec', or two")]
    grid = ImageGrid(tuple(int(n) for n in shape), tuple(cells), parameters["phasecenter"], parameters["projection"],
                     parameters["stokes"], parameters["reffreq"], gridder=parameters["gridder"],
                     spectralindex=_spectral_index(parameters), usemask=parameters["usemask"], mask=_mask(parameters),
                     pbmask=parameters["pbmask"], onepointing=parameters["onepointing"], nterms=parameters["nterms"],
                     **_spectral(parameters))
    outliers = read_outlier_file(parameters["outlierfile"], grid, parameters["imagename"])
    return replace(grid, outliers=outliers)


def _spectral_index(parameters):
    """The spectral index as text, a number or the name of an image."""
    text = str(parameters["spectralindex"])
    check_spectral_index(text)
    if text and parameters["reffreq"]:
        hertz(parameters["reffreq"], "reffreq")
    return text


def _spectral(parameters):
    """Return the parameters of the spectral axis, of which only the mode counts for a continuum image."""
    if parameters["specmode"] != "cube":
        return {"specmode": parameters["specmode"]}
    restfreq = parameters["restfreq"]
    restfreq = [restfreq] if isinstance(restfreq, str) else restfreq
    return {name: parameters[name] for name in ("specmode", "nchan", "outframe", "veltype", "interpolation")} | {
        "start": channel_number(parameters["start"], "start"), "width": channel_number(parameters["width"], "width"),
        "restfreq": tuple(text for text in restfreq if text)}


def _refuse_for_cubes(parameters):
    """Raise on parameters that are for continuum images only."""
    if parameters["specmode"] != "cube":
        return
    if parameters["npixels"]:
        raise ValueError(f"npixels = {parameters['npixels']} with specmode = 'cube': cubes use the uv cell of the "
                         "image only; should be 0")


def _check_errors(parameters):
    """Raise where errors are asked for that cannot be found."""
    for name, right in (("ndraws", 0), ("jackknife", False)):
        value = parameters[name]
        if value and parameters["specmode"] == "cube" and parameters["restoringbeam"] in ("common", ["common"]):
            raise ValueError(f"{name} = {value} with restoringbeam = 'common': the errors of a cube are smoothed to "
                             "the beam of each channel; should be '', or the beam itself")
        if value and parameters["niter"] == 0:
            raise ValueError(f"{name} = {value} with niter = 0: errors are those of a model that was solved; should be "
                             f"{right}")
    if parameters["ndraws"] == 1:
        raise ValueError("ndraws = 1: an error takes two draws or more; should be 0, or at least 2 (20 are usual)")


def _refuse_for_mosaics(parameters):
    """Raise on parameters that mosaics do not have."""
    if parameters["gridder"] == "mosaic" and parameters["specmode"] == "cube" and parameters["report"]:
        raise ValueError("report = True with gridder = 'mosaic' and specmode = 'cube': reports are made of mosaics of "
                         "one channel, and of cubes of single pointings; should be False")


def _check_single_dish(parameters):
    """Raise on parameters that do not go with a single dish."""
    image = parameters["sdimage"]
    if not parameters["sdgain"] > 0:
        raise ValueError(f"sdgain = {parameters['sdgain']!r}: should be positive; 1 leaves the flux scale as it is")
    if not image:
        return
    _refuse(parameters, f"sdimage = '{image}'", (
        ("specmode", "mfs", "total power is for continuum images"),
        ("stokes", "I", "total power is of Stokes I"),
        ("method", "tsara", "the paper has no total power"),
        ("databound", "adapt", "the noise of sdimage is found, it has no weights"),
        ("spectralindex", "", "the sky has to be the same at all frequencies"),
        ("nterms", 1, "the sky has to be the same at all frequencies"),
        ("ndraws", 0, "its errors are not found by bootstrap"),
        ("jackknife", False, "its errors are not found by jackknife"),
        ("parallel", False, "total power takes one process")))


def _refuse_for_spectra(parameters):
    """Raise on parameters that unknown spectra do not have."""
    nterms = parameters["nterms"]
    if not 1 <= nterms <= MOST_TERMS:
        raise ValueError(f"nterms = {nterms}: should be from 1 to {MOST_TERMS}")
    if nterms == 1:
        return
    if parameters["gridder"] == "wproject":
        raise ValueError(f"gridder = 'wproject' with nterms = {nterms}: the w-term is modelled of flat, or of known "
                         "spectra; should be 'standard' or 'mosaic'")
    _refuse(parameters, f"nterms = {nterms}", (
        ("method", "tsara", "the paper's method has one image"),
        ("stokes", "I", "spectra are those of the brightness"),
        ("positivity", True, "the brightness is positive at all frequencies"),
        ("spectralindex", "", "either the index is known, or it is solved for"),
        ("parallel", False, "spectra take one process")))


def _refuse_for_outliers(parameters):
    """Raise on parameters that outliers do not have."""
    name = parameters["outlierfile"]
    if not name:
        return
    _refuse(parameters, f"outlierfile = '{name}'", (
        ("specmode", "mfs", "outliers are of continuum images"),
        ("gridder", ("standard", "wproject"), "outliers are of single pointings"),
        ("stokes", "I", "outliers are of Stokes I"),
        ("method", "tsara", "the paper has one image"),
        ("nterms", 1, "the spectra of outliers are flat"),
        ("spectralindex", "", "the spectra of outliers are flat"),
        ("sdimage", "", "total power is of one image"),
        ("ndraws", 0, "errors by bootstrap are of one image"),
        ("jackknife", False, "errors by jackknife are of one image"),
        ("report", False, "reports are made of one image"),
        ("parallel", False, "outliers take one process")))


def _refuse_for_several_stokes(parameters):
    """Raise on parameters that images of several Stokes parameters do not have."""
    stokes = parameters["stokes"]
    if len(stokes) == 1:
        return
    _refuse(parameters, f"stokes = '{stokes}'", (
        ("specmode", "mfs", "they are continuum images"),
        ("gridder", ("standard", "wproject"), "mosaics are of one Stokes parameter"),
        ("method", "tsara", "the paper's method has one image"),
        ("parallel", False, "they take one process"),
        ("ndraws", 0, "errors by bootstrap are of one image"),
        ("jackknife", False, "errors by jackknife are of one image")))
    if "I" in stokes and parameters["polbound"] and not parameters["positivity"]:
        raise ValueError(f"positivity = False with stokes = '{stokes}' and polbound = True: where |(Q, U, V)| is at "
                         "most I, I is not negative; should be True, or polbound = False")


def _check_stokes(parameters):
    """Raise on parameters that are not possible with Stokes Q, U and V."""
    stokes = parameters["stokes"]
    if stokes == "I":
        return
    signed = (("positivity", False, "the image may be negative"),) if "I" not in stokes else ()
    _refuse(parameters, f"stokes = '{stokes}'", (
        *signed,
        ("savemodel", "none", "MODEL_DATA is written for Stokes I only"),
        ("report", False, "reports are made for Stokes I only")))


def _check_method(parameters):
    """Raise on parameters that the algorithm of the paper does not have, or a model that nothing confines."""
    method = parameters["method"]
    if parameters["gainfit"] and not parameters["significance"]:
        raise ValueError("gainfit = True with significance = 0: nothing confines the model; should be False, or "
                         "significance above 0")
    if method == "tsara":
        return
    _refuse(parameters, f"method = '{method}'", (
        ("regscale", 1.0, "its prior has no weight that depends on the noise"),
        ("significance", SolverOptions.significance, "it leaves the model free everywhere"),
        ("gainfit", False, "it leaves the model free everywhere"),
        ("ndraws", 0, "its errors are not known from draws"),
        ("jackknife", False, "its errors are not known from draws"),
        ("parallel", False, "it runs in one process")), ", or method = 'tsara'")


def _refuse(parameters, asked, rules, otherwise=""):
    """Raise on the first parameter that does not go with what was asked; rules are its name, what is right, and why."""
    for name, right, reason in rules:
        allowed = right if isinstance(right, tuple) else (right,)
        if parameters[name] not in allowed:
            raise ValueError(f"{name} = {parameters[name]!r} with {asked}: {reason}; should be "
                             f"{' or '.join(map(repr, allowed))}{otherwise}")


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
        raise ValueError(f"pbmask = {parameters['pbmask']:g} has no effect without a mask, as in tclean: set usemask = "
                         "'pb', give a mask, or leave pbmask at 0.0")
    return entries


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


def _solver_options(parameters, comm):
    if parameters["databound"] == "fixed" and not parameters["l2bound"]:
        raise ValueError(f"l2bound = {parameters['l2bound']!r}: databound='fixed' needs positive noise levels, one for "
                         "all blocks or one for each, relative to the MS weights")
    if not parameters["regscale"] > 0:
        raise ValueError(f"regscale = {parameters['regscale']!r}: should be positive; 1 is the automatic weight of the "
                         "prior")
    names = set(SolverOptions.__dataclass_fields__) - {"nthreads", "averaging"}
    values = {name: tuple(value) if isinstance(value := parameters[name], list) else value for name in names}
    nthreads = min(parameters["nthreads"] or _own_cores(comm), os.cpu_count() or 1)
    return SolverOptions(nthreads=nthreads, **values)


def _own_cores(comm):
    """Cores that this process may use, shared with the ranks that may use the same ones."""
    cores = frozenset(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else None
    return max(1, available_cores() // comm.same_here(cores))


def _output(parameters, grid):
    imagename = parameters["imagename"]
    startmodel = parameters["startmodel"]
    names = _imagenames(parameters, grid)
    old, checkpoint = sum(map(existing_products, names), []), imagename + CHECKPOINT
    images_stand = (parameters["restart"] and parameters["niter"] == 0 and parameters["savemodel"] == "modelcolumn"
                    and {name + ".model" for name in names} <= set(old))
    unfinished = os.path.lexists(checkpoint) and not images_stand
    if parameters["restart"]:
        if not unfinished:
            startmodel = _model_to_continue(imagename, startmodel, old)
    elif unfinished and not parameters["overwrite"]:
        raise FileExistsError(f"imagename = '{imagename}': an unfinished run left '{checkpoint}'; choose "
                              "another name, restart = True to continue from it, or overwrite = True to start anew")
    elif old and not parameters["overwrite"]:
        raise FileExistsError(f"imagename = '{imagename}': {', '.join(old)} exist; choose another name, "
                              "overwrite = True to replace them, or restart = True to continue from the model")
    beam = tuple(restoring_beam_words(parameters["restoringbeam"])) if parameters["restoration"] else None
    return Output(imagename, startmodel, _blocks(parameters), beam, parameters["savemodel"], images_stand,
                  tuple(history_lines("tsara", parameters)), parameters["restart"] and unfinished,
                  parameters["pblimit"], parameters["pbcor"])


def _continued(grid, output):
    """Return the grid whose outliers go on from their old models where the main image does."""
    if output.startmodel != output.imagename + ".model":
        return grid
    models = {outlier: outlier.imagename + ".model" for outlier in grid.outliers}
    return replace(grid, outliers=tuple(replace(outlier, startmodel=model) if os.path.lexists(model) else outlier
                                        for outlier, model in models.items()))


def _model_to_continue(imagename, startmodel, old):
    """Return the first model of a restart without a checkpoint: the old model, where there is one."""
    model = imagename + ".model"
    if model not in old:
        log.info(f"restart = True: there is neither '{imagename + CHECKPOINT}' nor '{model}': "
                 "starting from the beginning")
        return startmodel
    if startmodel:
        raise ValueError(f"startmodel = '{startmodel}' and restart = True both define the first model: set only one of "
                         "them")
    log.info(f"restart = True: continuing from '{model}'")
    return model
