"""Algorithm 1 of Dabbech et al. 2018: the adaptive preconditioned primal-dual iteration."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from casa_sara.parallel.serial import SERIAL, Serial
from casa_sara.solver import _kernels as kernels
from casa_sara.solver.interfaces import Measurement, Prior
from casa_sara.solver.planes import Planes
from casa_sara.solver.point_sources import PointSources
from casa_sara.solver.prox import ellipsoid_multiplier

__all__ = ["BASIS_ARRAYS", "SAMPLE_ARRAYS", "AdaptivePPD"]

RELAXATION = 1.8
# τ: the iteration converges for τ(η‖U^½Φ‖² + ζ‖Ψ‖²) < 1, at any 0 < ρ < 2 (Condat 2013). With η = 1/‖U^½Φ‖² and
# ζ = 1/‖Ψ‖² the bracket is 2, or less where a norm is known from above only. The paper gives no number; this is 1 %
# below the limit.
STEP = 0.495
SAMPLE_NS, PIXEL_NS = 2.5, 1.8  # on one thread, of a data and of an image step
PIECE = 4096  # samples of a block that one thread works on: sums are the same for any number of threads
STATE_ARRAYS = ("model", "anchor", "model_bar", "lowest", "l1_dual", "l1_weights", "l2_dual", "_phi_anchor",
                "multipliers", "residual_norms")
SAMPLE_ARRAYS, BASIS_ARRAYS = ("l2_dual", "_phi_anchor"), ("l1_dual", "l1_weights")  # where ranks differ
STATE_VALUES = ("threshold", "rel_change", "iteration", "constrained")


class AdaptivePPD:
    """The iteration that minimises ‖WΨ†x‖₁ over x ≥ 0 subject to the data.

    One call of :meth:`step` is one pass through Algorithm 1 (step numbers of the paper):

    ====  ==========================================================================
    5     v_j ← U_j(s_j − q_j) = λ_j(q_j − y_j),  s_j = U_j⁻¹v_j + Φ_j x̄,  q_j = P_{E_j}(s_j)
    6     μ_j = ‖y_j − Φ_j x‖
    13    u ← (1 − S_{κW})(u + Ψ†x̄) = clip(u + Ψ†x̄, ±κW)
    17    x ← P_{R+}(x − τ(η Φ†v + ζ Ψu)),  ζ = 1/‖Ψ‖² = 1
    18    x̄ ← 2x − x_prev
    19    σ = ‖x − x_prev‖ / ‖x‖
    ====  ==========================================================================

    Steps 7–10, by which the bounds ε_j move, need μ_j and σ and come after :meth:`step`: they are `adapt` of
    :class:`casa_sara.solver.l2_bounds.AdaptiveBounds` and of :class:`casa_sara.solver.dabbech2018.PaperBounds`.

    Steps 5, 13 and 17 are over-relaxed: v ← v + ρ(ṽ − v), u ← u + ρ(ũ − u) with ṽ, ũ what the table says, and the
    image's step starts from the anchor z ← z + ρ(x − z), so that x̄ = 2x − z.  ρ = 1 is the table itself (z = x_prev);
    any 0 < ρ < 2 has the same fixed points and converges under the same condition on the steps (Condat 2013).

    Step 6 needs Φx, but one Φ per iteration is enough: from x̄ = 2x − z follows Φx = ½(Φx̄ + Φz), and Φz follows z by
    Φz ← Φz + ρ(Φx − Φz).

    The projection in the metric U onto the ellipsoid of block j is q_j − y_j = U(s_j − y_j)/(U + λ_j).  Either its
    radius, the bound ε_j, is given and the multiplier λ_j follows from ‖q_j − y_j‖ = ε_j (:meth:`constrain`), or the
    multiplier is given and the bound is the radius that belongs to it (:meth:`penalise`): see
    :mod:`casa_sara.solver.l2_bounds` for how a noise level fixes a multiplier.

    The weights W stand in the threshold κW of Step 13, with u the dual variable of Ψ†x.  The paper has them in the
    operator WΨ†, with u that of WΨ†x; the problem is the same.  Here ‖Ψ‖ = 1 whatever the weights are, so that neither
    the steps nor the meaning of u change when the weights do.

    Parameters
    ----------
    measurement : object
        `forward(image, out)` → whitened visibilities (M,), `adjoint(vis, out)` → real image; `shape`; `workers`, whose
        `run(kernel, *arguments)` calls kernel(*arguments, worker, workers) on every thread.
    dictionary : object
        `allocate()`, `dual_step(model_bar, dual, threshold, weights, out, relaxation)` with ‖Ψ‖ = 1.
    vis : complex (M,)
        Whitened visibilities y, one block after the other.
    offsets : int (d + 1,)
        Block j is vis[offsets[j]:offsets[j+1]].
    precond : real (M,)
        U > 0.
    data_norm_sq : float
        ‖U^½Φ‖², or anything larger.
    positivity : bool
        x ≥ 0, or only real.
    relaxation : float
        ρ.
    comm : casa_sara.parallel.serial.Serial or MPI
        Where ranks share the work, each has its own samples of every block, its own bases, and the same images: a step
        needs one sum of the image's gradient over them, and of the d squared residual norms.

    Attributes
    ----------
    begins, block_sizes : int (d,)
        How many of a block's samples lie on ranks before this one, and on all.
    averaged : object or None
        What links averaged samples to those that they are averages of, by `renew(model, predicted)`: see
        :meth:`renew_averages`.
    calibration : object or None
        What knows which artefacts errors of the antenna gains make of a model: see
        :meth:`casa_sara.solver.significance.SignificantSupport.update`.
    samples : int (d,)
        M_j, samples of each block, before they were averaged.
    scatter : float (d,)
        What the averages leave out of ‖y_j − Φ_j x‖², because it is the same for all x.
    correction : real (nx, ny) or None
        What averages in enlarged cells leave out of Φ†v, because it is the same for all x: at a fixed point v is
        λ(Φx − y) of all samples. It belongs to the multipliers.
    model, model_bar : real (nx, ny)
        x and x̄.
    anchor : real (nx, ny)
        z.
    tau, l2_step : float
        τ, and η = 1/`data_norm_sq`.
    lowest : real (nx, ny)
        Least value of each pixel: 0, or −∞ without positivity and for pixels of `points`; +∞ for pixels that stay 0,
        see :meth:`confine`.
    points : PointSources
        Sources of which only the flux is free.
    confined_to : bool (nx, ny) or None
        The support of :meth:`confine`.
    l1_dual, l2_dual
        u and v.
    l1_weights
        W, ones at the beginning.
    multipliers : float (d,)
        λ_j.
    l2_bounds : float (d,)
        ε_j of :meth:`constrain`.
    constrained : bool
        Whether the bounds are given and Step 5 finds the multipliers, or the multipliers are.
    threshold : float
        κ, in the unit of the model: only the speed depends on it, but see :meth:`rescale`.
    residual_norms : float (d,)
        μ_j of the model before the last step.
    rel_change : float
        σ.
    model_flux, model_max : float
        Σx and max x after the last step.
    unit_jy : float
        Jy/pixel in the unit of the model, for the record.
    sky_over_image : real (nx, ny) or None
        Of a mosaic, by which the model is multiplied to be the sky, for the record.
    planes : Planes
        The images that are stacked here, (nx, ny) being of all together: of several frequencies, or of several parts of
        the sky. Flux and maximum are then those of what was asked for, and σ is that of all or of the main image,
        whichever is larger.
    """

    def __init__(self, measurement: Measurement, dictionary: Prior,  # noqa: PLR0913 - Φ, Ψ, y, U of the paper
                 vis: np.ndarray, offsets: np.ndarray, precond: np.ndarray, data_norm_sq: float,
                 positivity: bool = True, relaxation: float = RELAXATION,
                 comm: Serial = SERIAL) -> None:
        self.measurement, self.comm = measurement, comm
        self.dictionary: Any = dictionary  # Algorithm 2 of either method asks for more than a step does
        self.vis, self.precond, self.offsets = vis, precond, np.asarray(offsets)
        self.relaxation, self.positivity = relaxation, positivity
        self.confined_to: np.ndarray | None = None
        self.points = PointSources()
        self.tau, self.l2_step = STEP, 1.0 / data_norm_sq
        dtype = vis.real.dtype
        self.model, self.anchor, self.model_bar, self.lowest = comm.shared_images(4, measurement.shape, dtype)
        self.lowest[...] = 0 if positivity else -np.inf
        self._data_gradient = np.zeros(measurement.shape, dtype)
        self._slots = comm.shared_slots(measurement.shape, dtype)
        self._prior_gradient = self._slots[comm.rank] if self._slots else np.zeros(measurement.shape, dtype)
        self.l2_dual, self._phi_bar, self._phi_anchor = (np.zeros_like(vis) for _ in range(3))
        self.l1_dual, self.l1_weights = dictionary.allocate(), dictionary.allocate()
        self.l1_weights[...] = 1
        self.threshold = 0.0
        self.multipliers, self.l2_bounds, self.constrained = np.zeros(self.n_blocks), np.zeros(self.n_blocks), False
        self.begins, self.block_sizes = comm.exscan(np.diff(self.offsets))
        self.averaged: Any = None
        self.calibration: Any = None
        self.samples, self.scatter = self.block_sizes, np.zeros(self.n_blocks)
        self.correction: np.ndarray | None = None
        self.residual_norms = comm.norms(np.array([np.linalg.norm(vis[a:b]) for a, b in self.blocks()]))
        self._pieces = np.array([(a, min(a + PIECE, stop), j) for j, (start, stop) in enumerate(self.blocks())
                                 for a in range(start, stop, PIECE)], dtype=int).reshape(-1, 3)
        self._piece_norms_sq, self._norms_sq = np.zeros(len(self._pieces)), np.zeros(self.n_blocks)
        self.rel_change = np.inf
        self.model_flux = self.model_max = 0.0
        self._sums, = comm.shared_images(1, (measurement.shape[0], 4), float)
        self.iteration = 0
        self.unit_jy = 1.0
        self.sky_over_image: np.ndarray | None = None
        self.planes = Planes()

    @property
    def scratch_vis(self) -> np.ndarray:
        """Work space between the steps, complex (M,); each step overwrites it."""
        return self._phi_bar

    @property
    def scratch_image(self) -> np.ndarray:
        """Work space between the steps, real (nx, ny); each step overwrites it."""
        return self._data_gradient

    @property
    def n_blocks(self) -> int:
        """Number of data blocks d."""
        return len(self.offsets) - 1

    def blocks(self) -> Iterator[tuple[int, int]]:
        """Yield (start, stop) of every block."""
        return zip(self.offsets[:-1].tolist(), self.offsets[1:].tolist())

    def confine(self, support: np.ndarray) -> None:
        """Keep the model 0 outside a support: the projection of Step 17 is then on {x ≥ 0, x = 0 outside}.

        Parameters
        ----------
        support : bool (nx, ny)
            Pixels that may be non-zero.
        """
        self.confined_to = support
        self.lowest[~support] = np.inf
        self.comm.barrier()

    def support_only(self, support: np.ndarray, points: PointSources = PointSources()) -> None:
        """Keep the model 0 outside this support from now on, and outside that of :meth:`confine`; free it elsewhere.

        At `points`, which the support holds, it is free in its flux only.

        Parameters
        ----------
        support : bool (nx, ny)
            Pixels that may be non-zero.
        points : PointSources
            Sources that the support holds, of which only the flux is free.
        """
        if self.confined_to is not None:
            support = support & self.confined_to
        free = 0 if self.positivity else -np.inf
        self.comm.barrier()  # all ranks of one machine have read, and write the same
        self.lowest[self.points.x, self.points.y] = free
        self.lowest[support & (self.lowest == np.inf)] = free
        self.lowest[~support] = np.inf
        self.lowest[points.x, points.y] = -np.inf
        self.points = points
        self.comm.barrier()

    def start_from(self, model: np.ndarray) -> None:
        """Set x, z and x̄ to `model`, 0 outside the support; the dual variables stay.

        Parameters
        ----------
        model : real (nx, ny)
            In the unit of the iteration.
        """
        for image in (self.model, self.anchor, self.model_bar):
            image[...] = model  # ranks of one machine write the same
            image[self.lowest == np.inf] = 0
        self.comm.barrier()
        self.measurement.forward(self.model, self._phi_anchor)

    def renew_averages(self, model: np.ndarray) -> None:
        """Where the samples are averages, make them anew: what they leave of this model, and their scatter, are exact.

        Where their cells are enlarged, the gradient is made exact as well, for the present multipliers.

        Parameters
        ----------
        model : real (nx, ny)
            In the unit of the iteration.
        """
        if self.averaged is None:
            return
        predicted = self.measurement.forward(model, self.scratch_vis)
        np.copyto(self.vis, predicted)
        enlarged = self.averaged.enlarged
        self.scatter, gradient = self.averaged.renew(model, self.vis, self.multipliers if enlarged else None)
        self.correction = None
        if enlarged:
            left = np.subtract(self.vis, predicted, out=predicted)
            left *= np.repeat(self.multipliers.astype(self.precond.dtype), np.diff(self.offsets))
            correction = self.measurement.adjoint(left)
            correction -= gradient
            self.correction = self.comm.allreduce(correction)

    def constrain(self, l2_bounds: np.ndarray) -> None:
        """From now on, keep every block within its bound ε_j, float (d,): Step 5 finds the multipliers.

        Parameters
        ----------
        l2_bounds : float (d,)
            ε_j > 0, whitened.
        """
        self.l2_bounds, self.constrained = l2_bounds, True

    def penalise(self, multipliers: np.ndarray) -> None:
        """From now on, give every block the multiplier λ_j, float (d,); its bound is what follows from it.

        Parameters
        ----------
        multipliers : float (d,)
            λ_j ≥ 0.
        """
        before, after = self.multipliers.sum(), np.sum(multipliers)
        if self.correction is not None and before > 0:
            self.correction *= self.correction.dtype.type(after / before)
        self.multipliers[:], self.constrained = multipliers, False

    def step(self) -> None:
        """Do one iteration; Steps 7–10, the bounds, are taken after it."""
        summed_norms_sq = self._update_data_dual()  # Steps 5–6
        self._update_prior_dual()  # Step 13
        self._update_image()  # Steps 17–19
        np.sqrt(summed_norms_sq() + self.scatter, out=self.residual_norms)
        self.iteration += 1

    def _update_data_dual(self):
        """Steps 5–6: v from Φx̄, its gradient Φ†v, and μ_j²; return what waits for its sum over the ranks."""
        self.measurement.forward(self.model_bar, self._phi_bar)
        if self.constrained:
            self._update_multipliers()
        pairs = [vis.view(self.precond.dtype).reshape(-1, 2)
                 for vis in (self.l2_dual, self._phi_bar, self._phi_anchor, self.vis)]
        self.measurement.workers.run(kernels.data_step, *pairs, self.precond, self._pieces, self.multipliers,
                                     self.precond.dtype.type(self.relaxation), self._piece_norms_sq,
                                     work_ns=SAMPLE_NS * self.vis.size)
        self._norms_sq[:] = np.bincount(self._pieces[:, 2], self._piece_norms_sq, self.n_blocks)
        summed_norms_sq = self.comm.iallreduce(self._norms_sq)
        self.measurement.adjoint(self.l2_dual, self._data_gradient)
        if self.correction is not None and self.comm.rank == 0:
            self._data_gradient += self.correction
        return summed_norms_sq

    def _update_multipliers(self):
        """P_{E_j} of Step 5: the λ_j for which ‖q_j − y_j‖ = ε_j, from those of the iteration before."""
        for j, (start, stop) in enumerate(self.blocks()):
            self.multipliers[j] = ellipsoid_multiplier(
                self.l2_dual[start:stop], self._phi_bar[start:stop], self.vis[start:stop], self.precond[start:stop],
                self.l2_bounds[j], self.multipliers[j], self.comm)

    def _update_prior_dual(self):
        """Step 13: u from Ψ†x̄, and its gradient Ψu."""
        self.dictionary.dual_step(self.model_bar, self.l1_dual, self.threshold, self.l1_weights, self._prior_gradient,
                                  self.relaxation)

    def _update_image(self):
        """Steps 17–19: z, x and x̄ from the gradients, and σ."""
        points_before = self.points.values(self.model)
        real = self.model.dtype.type
        gradients, steps = self._summed_gradients((real(self.tau), real(self.l2_step), real(self.relaxation)))
        self.measurement.workers.run(kernels.primal_step, self.model, self.anchor, self.model_bar, *gradients, steps,
                                     self.lowest, self._sums, part=self.comm.part,
                                     work_ns=PIXEL_NS * self.model.size)
        self.comm.barrier()
        of_parts = np.array([self._sums[part, :3].sum(axis=0) for part in self.planes.parts])
        greatest = self._sums[:, 3].max()
        if len(self.points):
            if self.comm.part[0] == 0:
                of_parts += self.points.project(self.model, self.anchor, self.model_bar, points_before,
                                                self.planes.places(self.points))
            self.comm.barrier()
            of_parts, greatest = np.maximum(of_parts, (0, 0, -np.inf)), self.model.max()
        self.account_for(self.comm.bcast_numbers([*of_parts.sum(axis=0).tolist(), float(greatest)]))
        if len(of_parts) > 1:  # what is bright elsewhere must not hide that the main image still changes
            whole = self.rel_change
            self.account_for([*of_parts[0].tolist(), float(self.planes.main(self.model).max())])
            self.rel_change = max(self.rel_change, whole)
        if self.planes.n_planes > 1 or self.sky_over_image is not None:
            seen = self._seen() if self.comm.rank == 0 else np.zeros(1)  # the others wait before they change the model
            self.model_flux, self.model_max = self.comm.bcast_numbers([float(seen.sum(dtype=float)), float(seen.max())])

    def _seen(self):
        """Return the sky at the reference frequency, real (nx, ny)."""
        seen = self.planes.at_reference(self.model)
        if self.sky_over_image is None:
            return seen
        return np.multiply(seen, self.sky_over_image, out=self.planes.split(self.scratch_image)[0])

    def account_for(self, sums: Sequence[float]) -> None:
        """Take σ, the flux and the largest pixel from sums over the model after a step.

        Parameters
        ----------
        sums : float (4,)
            Σ(x − x_prev)², Σx², Σx and max x.
        """
        change, norm, self.model_flux, self.model_max = sums
        self.rel_change = float(np.sqrt(change / norm)) if norm > 0 else float(change > 0)

    def _summed_gradients(self, steps):
        """Return the two gradients and the steps to use with them: one sum over the ranks, in place of both.

        Ranks that share their memory need no messages: each adds what it needs, the rows of its part of the image.
        """
        gradients = self._data_gradient, self._prior_gradient
        if self.comm.size == 1:
            return gradients, steps
        run, real = self.measurement.workers.run, type(steps[1])
        if self.vis.size or self.correction is not None:
            run(kernels.add_scaled, *gradients, steps[1])
        if not self._slots:
            gradient = self.comm.allreduce(self._prior_gradient)
            return (gradient, gradient), (steps[0], real(0), steps[2])
        self.comm.barrier()
        first, *between, last = self._slots
        for other in between:
            run(kernels.add_scaled, other, first, real(1), part=self.comm.part)
        return (first, last), (steps[0], real(1), steps[2])

    def adjoint(self, vis: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        """Return Φ†·vis of the samples of all ranks.

        Parameters
        ----------
        vis : complex (M,)
            Whitened, of this rank.
        out : real (nx, ny), optional
            Receives the result.

        Returns
        -------
        real (nx, ny)
        """
        return self.comm.allreduce(self.measurement.adjoint(vis, out))

    def rescale(self, threshold: float) -> None:
        """Change κ and, with it, the dual variables and multipliers: the same problem, other step sizes.

        The saddle point of (κ, λ, u, v) and that of the same times a factor have the same image x.

        Parameters
        ----------
        threshold : float
            κ ≥ 0, in the unit of the model.
        """
        if self.threshold > 0:
            factor = threshold / self.threshold
            self.l1_dual *= self.l1_dual.dtype.type(factor)
            self.l2_dual *= self.precond.dtype.type(factor)
            self.multipliers *= factor
            if self.correction is not None:
                self.correction *= self.correction.dtype.type(factor)
        self.threshold = float(threshold)

    def state(self) -> dict[str, Any]:
        """Return all that the next step depends on, beside the constructor's arguments.

        Returns
        -------
        dict
            Plain values, and the arrays themselves.
        """
        arrays = {name: getattr(self, name) for name in STATE_ARRAYS}
        values = {name: getattr(self, name) for name in STATE_VALUES}
        return arrays | values | dict(l2_bounds=self.l2_bounds, points=self.points.places, correction=self.correction)

    def set_state(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state` has returned, by copies.

        Parameters
        ----------
        state : dict
            As :meth:`state` has returned it.

        Raises
        ------
        ValueError
            An array has another shape or type than this iteration's.
        """
        for name in STATE_ARRAYS:
            array, values = getattr(self, name), state[name]
            if np.shape(values) != array.shape or values.dtype != array.dtype:
                raise ValueError(f"{name}: an array of shape {array.shape} and type {array.dtype} is wanted, not "
                                 f"{np.shape(values)}")
            array[...] = values
        self.comm.barrier()
        for name in STATE_VALUES:
            setattr(self, name, state[name])
        self.l2_bounds = np.array(state["l2_bounds"])
        self.points = PointSources(state["points"])
        self.correction = None if state.get("correction") is None else np.array(state["correction"])
