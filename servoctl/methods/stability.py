"""Stability of integration and of sampled feedback: how fast a pole may be, and whether steps resolve a motion."""

from functools import cache
from itertools import pairwise
from math import comb, factorial, inf, pi

import numpy as np

from servoctl.checks import MOST_JETS, is_whole, named
from servoctl.errors import SpecificationError, warn
from servoctl.methods.accuracy import component_sizes
from servoctl.methods.choice import ORDERS, Poles
from servoctl.methods.motion import breakpoints, equal_steps
from servoctl.methods.runge_kutta import tableau
from servoctl.methods.sizes import state_levels

STEP_MAPS = (*ORDERS, "DOP853", "RK45", "Taylor", "RadauIIA", "Radau")
WITH_ORDER = ("Taylor", "RadauIIA")
BEYOND = 1e-10  # |R| - 1 that separates roots of |R|² = 1 where |R| crosses 1 from those where it touches 1
MANY_STEPS = 1e5  # steps of an adaptive method in a span that deserve a warning: each takes part of a millisecond
POWERS, NUDGE = 6, 1e-6  # power iterations for the fastest rate, and the relative size of their deviation
UNRESOLVED = 0.1  # of the state's size: a larger difference of a step and two half steps means that it is too long


def stability_function(method, order=None):
    """Numerator and denominator of R(z), z = hλ, the factor by which one step multiplies a solution of x' = λx.

    Coefficients (k,) ascend in powers of z: R = 1 + Σ bᵀAᵏ⁻¹1 zᵏ for an explicit tableau, the first p + 1 terms of eᶻ
    for a series of order p, and its Padé fraction (s - 1, s) for Radau IIA of s stages; "Radau" has three. "Taylor"
    needs an order, "RadauIIA" an odd one (2s - 1), and for other methods an order is refused. NameUnknown is raised for
    a method without a step map, such as a multistep one.
    """
    named(method, STEP_MAPS, "method")
    whole = is_whole(order) and 1 <= order <= MOST_JETS and (method == "Taylor" or order % 2 == 1)
    if not (whole if method in WITH_ORDER else order is None):
        raise SpecificationError(
            f"order={order!r} was given with method={method!r}.",
            f"'Taylor' has any order up to {MOST_JETS}, 'RadauIIA' an odd one; other methods take no order.",
            method=method,
            order=order,
        )
    return _fraction(method, order)


@cache
def _fraction(method, order):
    if method in ("Radau", "RadauIIA"):
        stages = 3 if method == "Radau" else (order + 1) // 2
        return _pade(stages - 1, stages), _pade(stages, stages - 1) * (-1.0) ** np.arange(stages + 1)
    if method == "Taylor":
        return np.array([1 / factorial(k) for k in range(order + 1)]), np.ones(1)
    a, b, _ = tableau(method)
    powers, coefficients = np.ones(len(b)), [1.0]
    for _ in range(len(b)):
        coefficients.append(b @ powers)
        powers = a @ powers
    return np.trim_zeros(np.array(coefficients), "b"), np.ones(1)


def _pade(k, m):
    """Coefficients of degree k in the numerator of the Padé fraction (k, m) of eᶻ."""
    return np.array([comb(k, j) * factorial(k + m - j) / factorial(k + m) for j in range(k + 1)])


def amplification(method, z, order=None):
    """|R(z)|, the factor by which one step multiplies a mode, for an array z = hλ; see `stability_function`."""
    above, below = stability_function(method, order)
    with np.errstate(over="ignore", invalid="ignore"):
        return np.abs(np.polyval(above[::-1], z) / np.polyval(below[::-1], z))


@cache
def largest_explicit(method, order=None, direction=pi):
    """The largest |hλ| up to which a method damps a mode with arg λ = direction [rad]; inf if no step amplifies it.

    |R(re^{iφ})|² = 1 is a polynomial equation in r; the least positive root beyond which |R| exceeds 1 is returned, or
    0 if even the shortest steps amplify the mode. On the negative real axis it is 2.785 for RK4 and 3.307 for RK45.
    """
    above, below = (c * np.exp(1j * direction * np.arange(len(c))) for c in stability_function(method, order))
    square = [np.convolve(c, c.conj()).real for c in (above, below)]
    size = max(map(len, square))
    square = [np.pad(c, (0, size - len(c))) for c in square]
    difference = square[0] - square[1]
    difference[np.abs(difference) <= 1e-14 * (np.abs(square[0]) + np.abs(square[1]))] = 0.0
    roots = np.roots(np.trim_zeros(difference, "b")[::-1]) if np.any(difference) else np.zeros(0)
    real = np.sort(roots.real[(np.abs(roots.imag) < 1e-7 * (1 + np.abs(roots))) & (roots.real > 1e-7)])
    edges = [0.0, *real, real[-1] + 2.0 if len(real) else 1.0]
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        middle = (low + high) / 2 * np.exp(1j * direction)
        if amplification(method, middle, order) > 1 + BEYOND:
            return float(low)
    return inf


def warn_fast_poles(method, poles, step):
    """Warn if steps [s] of a fixed-step method amplify error dynamics with poles [1/s] by row that should decay."""
    limits = [
        (limit / abs(pole), limit, pole, row)
        for row, values in poles.items()
        for pole in values
        if np.real(pole * step) < 0
        and abs(pole * step) > (limit := largest_explicit(method, None, float(np.angle(pole * step))))
    ]
    if limits:
        largest, limit, pole, row = min(limits, key=lambda entry: entry[0])
        number = f"{pole.real:g}" if pole.imag == 0 else f"{pole:g}"
        warn(
            f"Steps of {abs(step):.4g} s by {method} amplify the error dynamics of {row!r}, which the pole {number} "
            f"1/s should damp: |λ|h = {abs(pole * step):.4g} exceeds {limit:.4g}. The largest stable step is "
            f"{largest:.4g} s. Use it, slower poles, or drift='project'."
        )


def warn_many_steps(method, poles, length):
    """Warn if poles [1/s] by row limit the steps of an explicit adaptive method to a tiny part of a span [s]."""
    steps = [
        (abs(pole) / limit, pole, row)
        for row, values in poles.items()
        for pole in values
        if 0 < (limit := largest_explicit(method, None, float(np.angle(pole * length)))) < inf
    ]
    rate, pole, row = max(steps, key=lambda entry: entry[0], default=(0.0, 0.0, ""))
    count = rate * abs(length)
    if count > MANY_STEPS:
        warn(
            f"The pole {pole:g} 1/s of {row!r} limits the steps of {method} to {1 / rate:.2g} s: {count:.1g} steps "
            "over the span. Use slower poles, drift='project', or 'RadauIIA'."
        )


def warn_unstable(verdict):
    """Warn that the internal dynamics of a motion are unstable; the verdict says over which time, and how far."""
    warn(
        f"{verdict[0].upper()}{verdict[1:]}. The program does not determine this motion well. Take a shorter span or "
        "another output; sv.lqr stabilises the whole state about a plan."
    )


def warn_drifted(name, residual, t, method):
    """Warn that the residual of a constraint has drifted away from zero by the end of a motion at t [s]."""
    warn(
        f"The residual of {name!r} has drifted to {residual:.2g} at t = {t:.6g} s: {method} does not keep the program "
        "so long. Use drift='project', poles by a time constant, shorter steps or a smaller rtol."
    )


def unresolved(pieces, halved):
    """The last step of a motion, or else the one of the fastest change, if two half steps lead elsewhere; else None.

    Pieces are (model, t, states), with steps from t[k] to t[k + 1] [s] and states (n_x, N); `halved`(model, t, x, h)
    gives states (n_x, 3) at t, t + h and t + 2 h, fewer if a step fails. Returns the start and end of the step [s], the
    state at its start, the difference of both ends (n_x,) relative to the sizes of the state's entries, infinite if a
    half step fails, and these sizes (n_x,).
    """
    pieces = [piece for piece in pieces if len(piece[1]) > 1]
    if not pieces:
        return None
    largest = np.column_stack([np.abs(states).max(axis=1) for _, _, states in pieces])
    size = component_sizes(largest, state_levels(pieces[0][0]))
    changes = [(np.abs(np.diff(states)) / size[:, None]).max(axis=0) for _, _, states in pieces]
    fastest = int(np.argmax([change.max() for change in changes]))
    last = (len(pieces) - 1, len(changes[-1]) - 1)
    for i, k in dict.fromkeys((last, (fastest, int(np.argmax(changes[fastest]))))):
        model, t, states = pieces[i]
        halves = halved(model, t[k], states[:, k], (t[k + 1] - t[k]) / 2)
        lost = halves.shape[1] < 3
        difference = np.full(len(size), np.inf) if lost else (states[:, k + 1] - halves[:, -1]) / size
        if not np.abs(difference).max() <= UNRESOLVED:
            return t[k : k + 2], states[:, k], difference, size
    return None


def run_checked(stepping, t0, x0, t1, t_eval, knots):
    """`stepping.run` for steps of fixed length, with warnings if they amplify errors or do not resolve the motion."""
    explicit = stepping.method in ORDERS
    if explicit and isinstance(stepping.drift, Poles):
        lengths = (equal_steps(a, b, stepping.step)[0] for a, b in pairwise(breakpoints((t0, t1), knots)))
        warn_fast_poles(stepping.method, stepping.drift.by_row(stepping.model), max(lengths, key=abs))
    motion = stepping.run(t0, x0, t1, t_eval, knots)
    if motion.stop is None and not motion.interrupted:
        with np.errstate(all="ignore"):
            step = unresolved(stepping.taken, stepping.halved)
            if step is not None:
                _warn_unresolved(stepping, explicit, *step)
    return motion


def _warn_unresolved(stepping, explicit, ends, x, difference, size):
    """Warn about a step that two half steps contradict, with the largest stable step of an explicit method there."""
    t, length, bound = ends[0], abs(ends[1] - ends[0]), ""
    if explicit:
        stable = largest_explicit(stepping.method) / _fastest_rate(stepping, t, x, difference, size)
        if stable < length:
            bound = f" The largest stable step there is about {stable:.2g} s."
    warn(
        f"Steps of {length:.4g} s by {stepping.method} do not resolve the motion: at t = {t:.6g} s one step and two of "
        f"half its length differ by {np.abs(difference).max():.2g} of the size of the state.{bound} Use shorter steps, "
        "'RadauIIA' with adaptive steps, or accuracy=1e-6."
    )


def _fastest_rate(stepping, t, x, direction, size):
    """|λ| of the mode that dominates in a direction, by power iteration; NaN if it is not finite."""
    rate = np.nan
    for _ in range(POWERS):
        direction = NUDGE * direction / np.abs(direction).max()
        ahead = stepping.rates(t, x + size * direction) - stepping.rates(t, x)
        direction, rate = ahead / size, float(np.abs(ahead / size).max() / NUDGE)
    return rate
