"""Compiled passes over visibilities and pixels; each reads and writes every array once."""

import numpy as np
from numba import njit

_jit = njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")


@_jit
def residual_norm_sq(vis, phi_bar, phi_anchor, relaxation, start, stop):
    """From Φx̄ and Φz, x̄ = 2x − z, return ‖y − Φx‖² of one block, and replace Φz by that of z + ρ(x − z)."""
    total = 0.0
    half = phi_bar.real.dtype.type(0.5)
    for m in range(start, stop):
        predicted = half * (phi_bar[m] + phi_anchor[m])
        phi_anchor[m] += relaxation * (predicted - phi_anchor[m])
        residual = vis[m] - predicted
        total += residual.real**2 + residual.imag**2
    return total


@_jit
def shifted_norms(dual, phi_bar, vis, precond, multiplier, start, stop):
    """Return n² = ‖z − y‖² and −½ d(n²)/dλ for z − y = U(s − y)/(U + λ), s = U⁻¹v + Φx̄."""
    norm_sq = 0.0
    slope = 0.0
    for m in range(start, stop):
        u = np.float64(precond[m])
        offset = dual[m] / precond[m] + phi_bar[m] - vis[m]
        power = np.float64(offset.real) ** 2 + np.float64(offset.imag) ** 2
        shrunk = u / (u + multiplier)
        norm_sq += power * shrunk * shrunk
        slope += power * shrunk * shrunk / (u + multiplier)
    return norm_sq, slope


@_jit
def update_dual(dual, phi_bar, vis, precond, spread, multiplier, relaxation, start, stop):
    """v ← v + ρ(ṽ − v), ṽ = U(s − z) = λ(v + U(Φx̄ − y))/(U + λ), for one block; λ is multiplier × spread."""
    for m in range(start, stop):
        u = precond[m]
        share = multiplier * spread[m]
        projected = (share / (u + share)) * (dual[m] + u * (phi_bar[m] - vis[m]))
        dual[m] += relaxation * (projected - dual[m])


@_jit
def primal_step(model, anchor, model_bar, data_gradient, prior_gradient, steps, lowest):
    """z ← z + ρ(x − z), x⁺ = max(z − τ(ηΦ†v + Ψu), lowest), x̄ = 2x⁺ − z; return ‖x⁺ − x‖² and ‖x⁺‖².

    Steps are τ, η, ρ.
    """
    tau, l2_step, relaxation = steps
    change = 0.0
    norm = 0.0
    flat, relaxed, bar = model.reshape(-1), anchor.reshape(-1), model_bar.reshape(-1)
    g, p, low = data_gradient.reshape(-1), prior_gradient.reshape(-1), lowest.reshape(-1)
    for i in range(flat.size):
        old = flat[i]
        start = relaxed[i] + relaxation * (old - relaxed[i])
        new = start - tau * (l2_step * g[i] + p[i])
        if new < low[i]:
            new = low[i]
        difference = new - old
        relaxed[i] = start
        flat[i] = new
        bar[i] = new + (new - start)
        change += difference * difference
        norm += new * new
    return change, norm
