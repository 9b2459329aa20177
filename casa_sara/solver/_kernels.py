"""Compiled passes over visibilities and pixels; each reads and writes every array once."""

import numpy as np
from numba import njit

_jit = njit(nogil=True, cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")


@_jit
def residual_norm_sq(vis, phi_bar, phi_model, start, stop):
    """Replace Φx_{t−2} by Φx_{t−1} = (Φx̄ + Φx_{t−2})/2 and return ‖y − Φx_{t−1}‖² of one block."""
    total = 0.0
    half = phi_bar.real.dtype.type(0.5)
    for m in range(start, stop):
        predicted = half * (phi_bar[m] + phi_model[m])
        phi_model[m] = predicted
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
def update_dual(dual, phi_bar, vis, precond, multiplier, start, stop):
    """v ← U(s − z) = λ(v + U(Φx̄ − y))/(U + λ) for one block."""
    for m in range(start, stop):
        u = precond[m]
        dual[m] = (multiplier / (u + multiplier)) * (dual[m] + u * (phi_bar[m] - vis[m]))


@_jit
def primal_step(model, model_bar, data_gradient, prior_gradient, tau, l2_step, positivity):
    """x⁺ = P(x − τ(ηΦ†v + Ψu)) and x̄ = 2x⁺ − x; return ‖x⁺ − x‖² and ‖x⁺‖²."""
    change = 0.0
    norm = 0.0
    flat, bar = model.reshape(-1), model_bar.reshape(-1)
    g, p = data_gradient.reshape(-1), prior_gradient.reshape(-1)
    for i in range(flat.size):
        old = flat[i]
        new = old - tau * (l2_step * g[i] + p[i])
        if positivity and new < 0:
            new = type(new)(0)
        difference = new - old
        flat[i] = new
        bar[i] = new + difference
        change += difference * difference
        norm += new * new
    return change, norm
