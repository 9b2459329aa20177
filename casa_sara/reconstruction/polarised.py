"""Several Stokes parameters solved side by side: each its own solution, in steps that the cone ties together."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from casa_sara.data.distribution import Layout
from casa_sara.options import ImageGrid, SolverOptions
from casa_sara.parallel.partition import ALONE
from casa_sara.reconstruction.checkpoint import Checkpoint
from casa_sara.reconstruction.problem import Samples
from casa_sara.reconstruction.reconstruct import Control, reconstruction_steps
from casa_sara.reconstruction.result import Reconstruction
from casa_sara.reconstruction.solution import Solution
from casa_sara.solver.cone import PolarisationCone
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
                          support: np.ndarray | None = None, checkpoint: Checkpoint | None = None,
                          cone: bool = True) -> dict[str, Reconstruction]:
    """Find the images of several Stokes parameters, in one process.

    Each has its own noise levels, weights of the prior, support and end. With the cone, |(Q, U, V)| ≤ I holds after
    every step (:mod:`casa_sara.solver.cone`); without it, each is to the last bit what it is alone.

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
    cone : bool
        |(Q, U, V)| ≤ I.

    Returns
    -------
    dict of Reconstruction
        By Stokes parameter.

    Raises
    ------
    CheckpointError
        The state that was read is not one of these data.
    ValueError
        There is a cone, and no I that is positive.
    """
    if cone and not (problems[0].stokes == "I" and options.positivity):
        raise ValueError(f"a cone of {', '.join(one.stokes for one in problems)} with positivity = "
                         f"{options.positivity}: there should be a positive I, the first of them")
    states = _opened(checkpoint, problems, support)
    solving = [_Solving.of(one, partial(reconstruction_steps, grid=grid, options=options_of_stokes(options, one.stokes),
                                        support=support), checkpoint, states.get(one.stokes)) for one in problems]
    asked = _advanced(solving)
    together = PolarisationCone([one.solution.ppd for one in solving]) if cone else None
    while asked:
        _keep(checkpoint, solving)
        if together is not None:
            together.step(asked)
        else:
            for number in asked:
                solving[number].solution.ppd.step()
        asked = _advanced(solving)
    _keep(checkpoint, solving, any(one.ending for one in solving))
    return {one.stokes: one.found for one in solving if one.found is not None}


def _advanced(solving):
    """Go on to the next step of all; return the bounds of those that take one, by their numbers."""
    bounds = [one.advance() for one in solving]
    return {number: one for number, one in enumerate(bounds) if one is not None}


@dataclass
class _Solving:
    """The solution of one Stokes parameter in progress; this is its checkpoint, too.

    `make_state` returns the state after the last whole iteration; `ending` is the state of a solution that was stopped,
    and `found` the result of one that has ended.
    """

    stokes: str
    layout: Layout
    file: Checkpoint | None = None
    state: dict[str, Any] | None = None
    steps: Steps = field(init=False)
    solution: Solution = field(init=False)
    make_state: Callable[[], dict[str, Any]] | None = None
    ending: dict[str, Any] | None = None
    found: Reconstruction | None = None

    @classmethod
    def of(cls, problem, steps_of, checkpoint, state):
        """Make it ready to begin."""
        solving = cls(problem.stokes, Layout(problem.samples.offsets, ALONE.comm), checkpoint, state)
        control = replace(problem.control, checkpoint=solving, begun=solving.begin,
                          then=lambda ppd, bounds, record: None)  # the iteration keeps its model
        solving.steps = steps_of(problem.samples, startmodel=problem.startmodel, control=control)
        return solving

    def begin(self, solution):
        """Take the solution, before its first iteration."""
        self.solution = solution
        if solution.result is not None:
            self.make_state = partial(solution.state, None, self.layout, ALONE)

    def advance(self):
        """Go on to the next step, and return the bounds that it is to be taken with; None once there is an end."""
        if self.found is not None:
            return None
        try:
            _, bounds = next(self.steps)
        except StopIteration as end:
            self.found = end.value
            return None
        return bounds

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
        if now:
            self.ending = make_state()

    def whole_state(self):
        """Return the state between two iterations, None before the first, and for a solution that is not to be kept."""
        if self.ending is not None:
            return self.ending
        if self.found is not None and self.make_state is not None:
            return self.solution.state(None, self.layout, ALONE)
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
        return {one.stokes: planes[one.stokes] for one in problems}


def _keep(checkpoint, solving, now=False):
    """Write the states of all when it is time, or `now`; never those of a solution whose beginning was cut short."""
    if checkpoint is None or not checkpoint.due(now):
        return
    states = {one.stokes: one.whole_state() for one in solving}
    if all(states.values()):
        checkpoint.keep(lambda: dict(planes=states), max(one.solution.ppd.iteration for one in solving), now=True)
