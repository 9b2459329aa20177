"""The task saracompare: checks its parameters and runs the comparison."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from casa_sara.analysis.comparison import Comparison
from casa_sara.analysis.cube_comparison import CubeComparison
from casa_sara.analysis.folder import MEASURES, PAGE, in_the_way
from casa_sara.casa.images.image_sets import has_channels
from casa_sara.casa.runtime import log
from casa_sara.comparison.compare_cubes import compare_cubes
from casa_sara.comparison.compare_images import compare_images
from casa_sara.options import Comparing, Selection
from casa_sara.private.parameters import SARACOMPARE
from casa_sara.private.task_tsara import selection_of
from casa_sara.runtime.machine import available_cores
from casa_sara.version import __version__

__all__ = ["saracompare"]

LISTS = ("models", "names", "regions", "frames", "inject", "features")
# what has no effect without vis
OF_VIS = (*Selection.PARAMETERS, "datacolumn", "robust", "inject", "injectflux", "features")


def saracompare(**parameters: Any) -> dict[str, Any]:
    """Run the task on validated parameters and return the measures."""
    log.info(f"casa_sara {__version__}")
    selection = _selection(parameters)
    folder = _folder(parameters["outdir"], parameters["overwrite"])
    models, names, regions, frames, inject, features = (_words(parameters[name]) for name in LISTS)
    if frames and not folder:
        raise ValueError(f"frames = {list(frames)} has no effect without outdir: give outdir, the folder of the report")
    if parameters["injectflux"] and not inject:
        raise ValueError(f"injectflux = {parameters['injectflux']!r} has no effect without inject: give inject, the "
                         "places of the sources")
    request = Comparing(models, names, parameters["truth"], regions, parameters["support"], parameters["threshold"],
                        parameters["robust"], frames, inject, parameters["injectflux"], features, available_cores())
    if any(map(has_channels, models)):
        comparison = compare_cubes(request, selection)
    else:
        comparison = compare_images(request, selection)
    if folder:
        _report(comparison, folder)
    return comparison.measures


def _selection(parameters):
    """Return the selection of visibilities, None where there are none."""
    if _words(parameters["vis"]):
        return selection_of(parameters)
    defaults = {parameter.name: parameter.default for parameter in SARACOMPARE}
    for name in OF_VIS:
        if parameters[name] != defaults[name]:
            raise ValueError(f"{name} = {parameters[name]!r} has no effect without vis: give vis, or leave {name} at "
                             f"{defaults[name]!r}")
    return None


def _folder(outdir, overwrite):
    """Return the folder of the report, None where none is wanted; raise unless it can be written."""
    if not outdir:
        return None
    folder = Path(outdir)
    parent = folder.absolute().parent
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"outdir = '{outdir}' is a file: should be a folder, or the name of a new one")
    if folder.is_dir() and any(folder.iterdir()) and not overwrite:
        raise FileExistsError(f"outdir = '{outdir}' holds files: choose another folder, or overwrite = True to replace "
                              "an earlier report in it")
    if taken := in_the_way(folder, (PAGE, MEASURES)):
        raise FileExistsError(f"outdir = '{outdir}' holds {', '.join(taken)}, not of an earlier report: choose another "
                              "folder, or move it away")
    if not parent.is_dir():
        raise FileNotFoundError(f"outdir = '{outdir}': the folder '{parent}' does not exist")
    if not os.access(folder if folder.is_dir() else parent, os.W_OK | os.X_OK):
        raise PermissionError(f"outdir = '{outdir}' cannot be written to")
    return folder


def _words(value):
    """Return one string or several as a tuple, without empty ones."""
    return tuple(word for word in ([value] if isinstance(value, str) else value) if word)


def _report(comparison: Comparison | CubeComparison, folder: Path) -> None:
    """Write the report, its pictures and the measures."""
    if isinstance(comparison, CubeComparison):
        from casa_sara.analysis.cube_report import write_cube_report  # matplotlib takes its time

        write_cube_report(comparison, folder)
        return
    from casa_sara.analysis.report import write_report

    write_report(comparison, folder)
