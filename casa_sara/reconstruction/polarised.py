"""Several Stokes parameters: each its own solution, Q, U and V in steps that I ties together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruction_steps
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.solver.adaptive_ppd import AdaptivePPD
from casa_sara.solver.polarisation import PolarisationBound
from casa_sara.solver.record import UNFINISHED
from casa_sara.solver.reweighting import Steps

__all__ = ["StokesProblem", "options_of_stokes", "reconstruct_polarised"]


@dataclass(frozen=True)
class StokesProblem:
    """What is solved for one Stokes parameter, and how it is followed.

    Attributes
    ----------
    stokes : str
        'I', 'Q', 'U' or 'V'.
    samples : Samples
        As of :func:`casa_sara.reconstruction.reconstruct.reconstruct`, as are the others.
    startmodel : real (nx, ny) or None
        First image, Jy/pixel.
    control : Control
        Its checkpoint is not used.
    """

    stokes: str
    samples: Samples
    startmodel: np.ndarray | None = None
    control: Control = Control()


def options_of_stokes(options: SolverOptions, stokes: str) -> SolverOptions:
    """Return the options of one Stokes parameter: only I may be confined to positive values.

    Parameters
    ----------
    options : SolverOptions
        Of all.
    stokes : str
        'I', 'Q', 'U' or 'V'.

    Returns
    -------
    SolverOptions
    """
    return replace(options, positivity=options.positivity and stokes == "I")


def reconstruct_polarised(problems: list[StokesProblem], grid: ImageGrid, options: SolverOptions,
                          support: np.ndarray | None = None,
                          checkpoint: Checkpoint | None = None) -> dict[str, Reconstruction]:
    """Find the images of several Stokes parameters, in one process, one after the other.

    Each is to the last bit what it is alone, with noise levels, weights of the prior, support and end of its own. With
    `options.polbound` that is so of I; then Q, U and V take their steps side by side, and |(Q, U, V)| ≤ I after each
    (:mod:`casa_sara.solver.polarisation`), but for pixels where I may be negative, around unresolved sources.

    Parameters
    ----------
    problems : list of StokesProblem
        I first, where it is one of them.
    grid : ImageGrid
        Size, pixels, direction and gridder of the image.
    options : SolverOptions
        Task parameters of the method.
    support : bool (nx, ny), optional
        The models are exactly 0 elsewhere.
    checkpoint : Checkpoint, optional
        Keeps the states of all now and then; where it holds a `state` that was read, they go on from that.

    Returns
    -------
    dict of Reconstruction
        By Stokes parameter.

    Raises
    ------
    CheckpointError
        The state that was read is not one of these data.
    """
    states = _opened(checkpoint, problems, support)
    solving = [_Solving.of(one, partial(reconstruction_steps, grid=grid, options=options_of_stokes(options, one.stokes),
                                        support=support), checkpoint, states.get(one.stokes)) for one in problems]
    bounded = options.polbound and problems[0].stokes == "I"
    for together in [solving[:1], solving[1:]] if bounded else [[one] for one in solving]:
        brightness = solving[0].brightness() if bounded and together[0] is not solving[0] else None
        going, bound = _going(together), None
        while going:
            _keep(checkpoint, solving)
            if brightness is None:
                going[0].ppd.step()
            else:
                if bound is None or len(bound) > len(going):
                    bound = PolarisationBound([one.ppd for one in going], _left_by(together, brightness))
                bound.step([one.bounds for one in going])
            going = _going(together)
    _keep(checkpoint, solving, any(one.ending for one in solving))
    return {one.stokes: one.found for one in solving if one.found is not None}


def _going(solving):
    """Go on to the next step of all, and return those that take one."""
    return [one for one in solving if one.advance()]


def _left_by(solving, brightness):
    """Return what the solutions that have ended leave of |(Q, U, V)| ≤ I to the others, Jy/pixel."""
    power = np.square(brightness, dtype=float)
    for one in solving:
        if one.found is not None:
            power -= np.square(one.found.model, dtype=float)
    return np.sqrt(np.maximum(power, 0)).astype(np.float32)


@dataclass
class _Solving:
    """The solution of one Stokes parameter; this is its checkpoint, too.

    `make_state` returns the state after the last whole iteration; `ending` is the state of a solution that was stopped,
    `found` the result of one that has ended, and `signed` where its model may be negative.
    """

    stokes: str
    file: Checkpoint | None = None
    state: dict[str, Any] | None = None
    steps: Steps | None = None
    ppd: AdaptivePPD | None = None
    bounds: Any = None
    make_state: Callable[[], dict[str, Any]] | None = None
    ending: dict[str, Any] | None = None
    found: Reconstruction | None = None
    signed: np.ndarray | None = None
    iteration: int = 0

    @classmethod
    def of(cls, problem, steps_of, checkpoint, state):
        """Make it ready to begin, or take over what has ended."""
        solving = cls(problem.stokes, checkpoint, state)
        if state is not None and "ended" in state:
            with solving.applied():
                solving.found, solving.signed = Reconstruction.of(state["ended"]), np.array(state["signed"])
        control = replace(problem.control, checkpoint=solving, then=solving.end)
        if solving.found is None:
            solving.steps = steps_of(problem.samples, startmodel=problem.startmodel, control=control)
        return solving

    def end(self, ppd, bounds, record):
        """Note, at the end, where the model may be negative; the iteration keeps its model for those beside it."""
        self.signed = ppd.lowest < 0

    def brightness(self):
        """Return the model in Jy/pixel, +∞ where it may be negative."""
        assert self.found is not None and self.signed is not None
        return np.where(self.signed, np.float32(np.inf), self.found.model)

    def advance(self):
        """Go on to the next step of `ppd`, with `bounds`; return False once there is an end, and let go of all else."""
        if self.steps is None:
            return False
        try:
            self.ppd, self.bounds = next(self.steps)
        except StopIteration as end:
            self.found, self.steps, self.ppd, self.bounds, self.make_state = end.value, None, None, None, None
            return False
        return True

    def identify(self, **data):
        """Nothing to do: the data of all are known by their contents."""

    @contextmanager
    def applied(self, read: bool = True) -> Iterator[dict[str, Any] | None]:
        """Yield `state`, to be put to use; `read` as of Checkpoint."""
        try:
            yield self.state
        except (LookupError, TypeError, ValueError, AttributeError) as error:
            assert self.file is not None
            raise self.file.refusal(f"its state does not fit ({error})") from None
        self.state = None

    def keep(self, make_state, iteration, now=False):
        """Take note of how the state is made; of a solution that is stopped, make it."""
        self.make_state = make_state
        self.iteration = iteration
        if now:
            self.ending = make_state()

    def whole_state(self):
        """Return the state between two iterations, None of what has not begun, or was cut short before it did."""
        if self.ending is not None:
            return self.ending
        if self.found is not None:
            if self.found.record.stop_code in UNFINISHED:
                return None
            return dict(ended=vars(self.found) | dict(record=self.found.record.state()), signed=self.signed)
        return self.make_state and self.make_state()


def _opened(checkpoint, problems, support):
    """Tell the checkpoint what data these are, and return the states that were read, by Stokes parameter."""
    if checkpoint is None:
        return {}
    first = problems[0].samples
    digests: dict[str, Any] = {f"visibilities of {one.stokes}": one.samples.data.vis for one in problems}
    digests |= {f"weights of {one.stokes}": one.samples.data.weight for one in problems}
    digests |= {f"noise of {one.stokes}": one.samples.noise for one in problems}
    checkpoint.identify(**digests, uvw=first.data.uvw, density=first.density, blocks=first.offsets, support=support)
    if checkpoint.state is None:
        return {}
    with checkpoint.applied() as state:
        planes: Mapping[str, dict[str, Any]] = state["planes"]
        return dict(planes)


def _keep(checkpoint, solving, now=False):
    """Write the states of all that have one when it is time, or `now`."""
    if checkpoint is None or not checkpoint.due(now):
        return
    states = {one.stokes: state for one in solving if (state := one.whole_state())}
    if states:
        done = max(one.iteration for one in solving if one.stokes in states)
        checkpoint.keep(lambda: dict(planes=states), done, now=True)
