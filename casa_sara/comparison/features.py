"""Tests whether structures of an image are real: its run repeated, and solved without and with emission in a region."""

from __future__ import annotations

from functools import partial

import numpy as np

from casa_sara.casa.runtime import log
from casa_sara.comparison.injection import problem_of_run
from casa_sara.imaging.run_solver import Watch, solve_image
from casa_sara.options import Selection
from casa_sara.reconstruction.feature_test import FEATURE_DRAWS, FeatureResult, FeatureTest
from casa_sara.solver.record import DIVERGED, STOPPED_BY_USER

__all__ = ["measures_of", "test_features"]


def test_features(one, regions: dict[str, np.ndarray], selection: Selection,
                  nthreads: int = 1) -> dict[str, FeatureResult]:
    """Repeat the run of an image, and test regions of it.

    Parameters
    ----------
    one : casa_sara.casa.images.image_sets.ImageSet
        Of a run of tsara.
    regions : dict
        Name → bool (nx, ny), on the pixels of the image.
    selection : Selection
        Of the visibilities.
    nthreads : int
        Threads of the numerics.

    Returns
    -------
    dict
        Name → FeatureResult.

    Raises
    ------
    KeyboardInterrupt
        It was stopped by Ctrl-C.
    RuntimeError
        The run does not come to an end.
    """
    samples, grid, options = problem_of_run(one, selection, nthreads)
    log.info(f"imaging '{one.name}' again, and testing {len(regions)} features with {FEATURE_DRAWS} draws each")
    found: dict[str, FeatureResult] = {}
    solved = solve_image(samples, grid, options, watch=Watch(then=partial(_test, found, regions, options)))
    if solved.record.stop_code == STOPPED_BY_USER:
        raise KeyboardInterrupt
    if solved.record.stop_code == DIVERGED:
        raise RuntimeError(f"features: the run of '{one.name}' diverges when it is repeated")
    for name, result in found.items():
        drawn = f"in the draws {result.drawn.mean():.3g} (largest {result.drawn.max():.3g})"
        log.info(f"feature '{name}' of '{one.name}': {result.flux_jy:.4g} Jy; without it chi-square is "
                 f"{result.change:.4g} larger, {drawn}; {result.sigma:.2g} sigma")
    return found


def _test(found, regions, options, stopped, ppd, bounds, record):
    """Test the regions at the end of a solution, unless that was stopped."""
    if record.stop_code in (STOPPED_BY_USER, DIVERGED):
        return
    reweightings = record.reweightings
    test = FeatureTest(ppd, bounds, reweightings[-1]["scale"] if reweightings else 0.0,
                       options.significance > 0 and options.nreweights > 0)
    for name, region in regions.items():
        found[name] = test.test(region, stopped=stopped, progress=partial(_tell, name))


def _tell(name, number):
    """Say which draw is begun."""
    log.info(f"feature '{name}': draw {number + 1} of {FEATURE_DRAWS}")


def measures_of(result: FeatureResult) -> dict:
    """Return the numbers of a test: plain values."""
    return dict(flux_jy=result.flux_jy, delta_chi_square=result.change, drawn=result.drawn.tolist(),
                p_value=result.p_value, rank_p_value=result.rank_p_value, sigma=result.sigma)
