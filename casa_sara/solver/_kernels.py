"""Compiled passes over visibilities and pixels; each reads and writes every array once."""

import numpy as np

from casa_sara.runtime import jit

_jit = jit.kernel(fastmath={"reassoc", "contract", "arcp", "nsz"}, error_model="numpy")


@_jit
def data_step(dual, phi_bar, phi_anchor, vis, precond, pieces, multipliers, relaxation, norms_sq, worker, workers):
    """v ← v + ρ(ṽ − v), ṽ = λ(v + U(Φx̄ − y))/(U + λ), and Φz by that of z + ρ(x − z): Φx = ½(Φx̄ + Φz).

    Visibilities are real pairs (M, 2), `precond` is U (M,), λ the block's multiplier. Each row of `pieces` is the first
    sample, the last + 1 and the block of a piece, whose ‖y − Φx‖² goes to `norms_sq`.
    """
    real = precond.dtype.type
    for piece in range(worker, len(pieces), workers):
        total, multiplier = 0.0, real(multipliers[pieces[piece, 2]])
        for m in range(pieces[piece, 0], pieces[piece, 1]):
            step = relaxation * multiplier / (precond[m] + multiplier)
            power = real(0)
            for part in range(2):
                predicted = real(0.5) * (phi_bar[m, part] + phi_anchor[m, part])
                residual = vis[m, part] - predicted
                power += residual * residual
                phi_anchor[m, part] += relaxation * (predicted - phi_anchor[m, part])
                ahead = dual[m, part] + precond[m] * (phi_bar[m, part] - vis[m, part])
                dual[m, part] += step * ahead - relaxation * dual[m, part]
            total += power
        norms_sq[piece] = total


@_jit
def shifted_norms(dual, phi_bar, vis, precond, multiplier):
    """Return n² = ‖q − y‖² and −½ d(n²)/dλ for q − y = U(s − y)/(U + λ), s = U⁻¹v + Φx̄."""
    norm_sq = 0.0
    slope = 0.0
    for m in range(vis.size):
        u = np.float64(precond[m])
        offset = dual[m] / precond[m] + phi_bar[m] - vis[m]
        power = np.float64(offset.real) ** 2 + np.float64(offset.imag) ** 2
        shrunk = u / (u + multiplier)
        norm_sq += power * shrunk * shrunk
        slope += power * shrunk * shrunk / (u + multiplier)
    return norm_sq, slope


@_jit
def primal_step(model, anchor, model_bar, data_gradient, prior_gradient, steps, lowest, sums, worker, workers):
    """z ← z + ρ(x − z), x⁺ = max(z − τ(ηΦ†v + Ψu), lowest), x̄ = 2x⁺ − z; steps are τ, η, ρ.

    Where lowest is +∞, x⁺ = 0.

    Row i of `sums` becomes Σ(x⁺ − x)², Σ(x⁺)², Σx⁺ and max x⁺ of row i of the image.
    """
    tau, l2_step, relaxation = steps
    for i in range(model.shape[0] * worker // workers, model.shape[0] * (worker + 1) // workers):
        change = norm = flux = 0.0
        peak = model.dtype.type(-np.inf)
        for k in range(model.shape[1]):
            old = model[i, k]
            start = anchor[i, k] + relaxation * (old - anchor[i, k])
            new = start - tau * (l2_step * data_gradient[i, k] + prior_gradient[i, k])
            if new < lowest[i, k]:  # NaN stays NaN, and is found
                new = lowest[i, k] if lowest[i, k] < np.inf else model.dtype.type(0)
            difference = new - old
            anchor[i, k] = start
            model[i, k] = new
            model_bar[i, k] = new + (new - start)
            change += difference * difference
            norm += new * new
            flux += new
            if new > peak:
                peak = new
        sums[i, 0], sums[i, 1], sums[i, 2], sums[i, 3] = change, norm, flux, peak


@_jit
def _polarised(models, units, metric, multiplier, i, k):
    """Return |p′|² and its derivative by λ, of p′ = p/(1 + λa), in Jy."""
    power = slope = 0.0
    for s in range(len(models)):
        shrink = 1.0 + multiplier * metric[s]
        value = units[s] * np.float64(models[s][i, k]) / shrink
        power += value * value
        slope -= 2.0 * value * value * metric[s] / shrink
    return power, slope


@_jit
def _multiplier(models, units, metric, bound, i, k):
    """Return the λ at which |p′| is the bound, by Newton's method for 1/|p′|, which is concave."""
    multiplier = 0.0
    for _ in range(40):
        power, slope = _polarised(models, units, metric, multiplier, i, k)
        size = np.sqrt(power)
        if size <= bound * (1 + 1e-9):
            break
        multiplier += 2 * size * size * (size / bound - 1) / -slope
    return multiplier


@_jit
def polarised_step(models, bars, anchors, bound, units, metric, worker, workers):
    """Project x⁺ of some of Q, U and V on |(Q, U, V)| ≤ `bound` (Jy), in place, and x̄ = 2x⁺ − z with it.

    `units` are Jy of each; the projection is the nearest in Σ|x − x⁺|²/a of the images in Jy, a the `metric`.
    """
    for i in range(bound.shape[0] * worker // workers, bound.shape[0] * (worker + 1) // workers):
        for k in range(bound.shape[1]):
            most = np.float64(bound[i, k])
            if _polarised(models, units, metric, 0.0, i, k)[0] <= most * most:
                continue
            multiplier = _multiplier(models, units, metric, most, i, k) if most > 0 else np.inf
            for s in range(len(models)):
                models[s][i, k] /= 1.0 + multiplier * metric[s]
                bars[s][i, k] = 2 * models[s][i, k] - anchors[s][i, k]


@_jit
def changes(model, before, sums, worker, workers):
    """Fill row i of `sums` with Σ(x⁺ − x)², Σ(x⁺)², Σx⁺ and max x⁺ of row i of the image, x being `before`."""
    for i in range(model.shape[0] * worker // workers, model.shape[0] * (worker + 1) // workers):
        change = norm = flux = 0.0
        peak = model[i, 0]
        for k in range(model.shape[1]):
            new = model[i, k]
            change += (new - before[i, k]) ** 2
            norm += new * new
            flux += new
            peak = max(peak, new)
        sums[i, 0], sums[i, 1], sums[i, 2], sums[i, 3] = change, norm, flux, peak


@_jit
def add_scaled(data_gradient, prior_gradient, l2_step, worker, workers):
    """Ψu ← ηΦ†v + Ψu."""
    for i in range(data_gradient.shape[0] * worker // workers, data_gradient.shape[0] * (worker + 1) // workers):
        for k in range(data_gradient.shape[1]):
            prior_gradient[i, k] += l2_step * data_gradient[i, k]


@_jit
def nnls_step(model, momentum, gradient, step, penalty, positivity, uphill, worker, workers):
    """Replace the gradient g at the momentum point m by x⁺ = m + step·g, less the penalty, x⁺ ≥ 0 if `positivity`.

    Entry i of `uphill` becomes Σ(m − x⁺)(x⁺ − x) of row i.
    """
    for i in range(model.shape[0] * worker // workers, model.shape[0] * (worker + 1) // workers):
        total = 0.0
        for k in range(model.shape[1]):
            free = momentum[i, k] + step * gradient[i, k]
            new = max(free - penalty, model.dtype.type(0))
            if not positivity:
                new += min(free + penalty, model.dtype.type(0))
            gradient[i, k] = new
            total += (momentum[i, k] - new) * (new - model[i, k])
        uphill[i] = total


@_jit
def extrapolate(model, momentum, new, factor, worker, workers):
    """m ← x⁺ + factor·(x⁺ − x), x ← x⁺."""
    for i in range(model.shape[0] * worker // workers, model.shape[0] * (worker + 1) // workers):
        for k in range(model.shape[1]):
            momentum[i, k] = new[i, k] + factor * (new[i, k] - model[i, k])
            model[i, k] = new[i, k]
