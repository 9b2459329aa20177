"""Loading of the compiled kernels in a thread while CASA reads."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from casa_sara.operators.dictionary import SaraDictionary
from casa_sara.operators.measurement import MeasurementOperator
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.nnls import nnls

__all__ = ["kernels_loading", "use_every_kernel"]


@contextmanager
def kernels_loading() -> Iterator[None]:
    """Have a thread load the compiled kernels, half a second's work in a new process; the end waits for it.

    CASA's tools let other threads go on while they work, so that this costs next to nothing.
    """
    thread = threading.Thread(target=use_every_kernel, name="casa_sara kernels")
    thread.start()
    try:
        yield
    finally:
        thread.join()


def use_every_kernel() -> None:
    """Call every kernel of a solution once, on an image of 32×32 pixels and three visibilities."""
    uv, image = np.array([[0.0, 1e3, 2e3], [0.0, 5e2, 1e3]]), np.ones((32, 32), np.float32)
    for eps in (2e-5, 1e-6):  # of most solutions, and of the images: the gridding kernels are compiled for their width
        measurement = MeasurementOperator(uv, 1e-5, image.shape, eps=eps)
        vis = measurement.forward(image)
        measurement.adjoint(vis)
    dictionary = SaraDictionary(measurement.shape)
    precond, norm_sq = np.ones(3, np.float32), 3.0 * image.size
    model, _ = nnls(measurement, vis, precond, norm_sq, max_iter=1)
    ppd = AdaptivePPD(measurement, dictionary, vis, [0, 3], precond, norm_sq)
    ppd.start_from(model)
    ppd.step()
    dictionary.reweight(ppd.model, 1.0, 1.0, ppd.l1_weights)
    ppd.step()
