"""Flat programs: a Newton solve at each instant, nothing is integrated."""

import contextlib

import numpy as np

from servoctl.errors import IntegrationStopped, ServoError
from servoctl.methods.monitor import DEGRADED, NO_CHOICE, Watch
from servoctl.methods.motion import Motion, interruptible

CHUNK = 4000  # instants per call of the loop: 0.2 ms compiled, 0.2 s where CasADi evaluates


def algebraic(model, t0, x0, times, progress):
    """Solve a flat program for q, γ' and γ'' at each time.

    Parameters
    ----------
    model : Model
        With Σ o_a = 0.
    t0 : float
        [s]
    x0 : (n_x,) array
        Consistent state at t0.
    times : (N,) array
        In the order of the motion [s].
    progress : callable

    Returns
    -------
    Motion
    """
    motion = Motion()
    with interruptible(motion):
        model = _with_pivots(model, t0, np.asarray(x0), motion)
        watch, q, done, previous = Watch(model, t0, x0), np.asarray(x0)[: model.nq], 0, None
        times = np.asarray(times, dtype=float)
        while done < len(times):
            f = model.function("path")
            block = times[done : done + CHUNK]
            x, y, iterations = f.newton(block, q, model.parameters)
            motion.count(iterations=iterations)
            state, top, guards = _split(model, x, y)
            stand, why, repivot = _check(watch, block, state, guards, previous)
            motion.add(model, block[:stand], state[:, :stand], top[:, :stand])
            if why or (x.shape[1] < len(block) and not repivot):
                t, at = _last(times, block, state, stand, why)
                motion.stop = _stopped(watch, t, at, why)
                break
            if stand:
                q, previous = x[:, stand - 1], guards[:, max(stand - 2, 0) : stand]
                done += stand
                progress(block[stand - 1])
            if repivot:
                at, following = min(stand, state.shape[1] - 1), float(block[min(stand, len(block) - 1)])
                helps = motion.changes_pivots(following)
                variant = watch.anew(block[at], state[:, at], top[:, at]) if helps else None
                if variant is None:
                    motion.stop = watch.singular(*_last(times, block, state, stand, why), NO_CHOICE)
                    break
                (model, watch), previous = variant, None
                motion.count(pivot_changes=1)
    return motion


def _with_pivots(model, t, x, motion):
    """The model, with pivots chosen at the start where its own vanish there."""
    if not np.all(np.isfinite(model.function("path")(t, x[: model.nq], model.parameters))):
        with contextlib.suppress(ServoError):
            model = model.near(t, np.append(x, np.zeros(model.n)))
            motion.count(pivot_changes=1)
    return model


def _split(model, x, y):
    """State (q, γ'), γ'' and guards from the outputs (δq, q', γ', γ'', guards)."""
    nq, n = model.nq, model.n
    return np.vstack([x, y[2 * nq : 2 * nq + n]]), y[2 * nq + n : 2 * nq + 2 * n], y[2 * nq + 2 * n :]


def _check(watch, t, state, guards, previous):
    """How many samples stand, why no more, and whether pivots must be chosen anew."""
    total = state.shape[1]
    track = guards if previous is None else np.concatenate([previous, guards], axis=1)
    offset = track.shape[1] - guards.shape[1]
    if not guards.size:
        return total, "", False
    relative = watch.relative(track)
    changes = [k for r in relative for k in np.flatnonzero(np.sign(r[:-1]) * np.sign(r[1:]) < 0)]
    if changes:
        k = max(min(changes) + 1 - offset, 0)
        near = [watch.rank_measure(t[i], state[:, i]) for i in {max(k - 1, 0), k}]
        if min(near) < DEGRADED or not _crosses_chart(watch, t, state, k):
            return k, "a pivot changes its sign", False
        return k, "", True
    weak = np.flatnonzero(np.abs(relative[:, offset:]).min(axis=0) < DEGRADED)
    for k in weak:
        if k and watch.chart_only(float(np.abs(relative[:, offset + k]).min()), t[k], state[:, k]):
            return int(k), "", True
    return total, "", False


def _crosses_chart(watch, t, state, k):
    """Whether only the choice of pivots fails between samples k - 1 and k: the matrices keep their rank between."""
    if k == 0:
        return True
    middle = (state[:, k - 1] + state[:, k]) / 2
    return watch.rank_measure((t[k - 1] + t[k]) / 2, middle) > DEGRADED


def _last(times, block, state, stand, why):
    k = max(stand - 1, 0)
    if state.shape[1]:
        return (block[k] + block[min(stand, len(block) - 1)]) / 2 if why else block[k], state[:, k]
    return block[0], state[:, 0] if state.shape[1] else np.zeros(len(state))


def _stopped(watch, t, x, why):
    if why or watch.lost(t, x):
        return watch.singular(t, x, why or "Newton's method finds no solution beyond")
    return IntegrationStopped(
        f"The program has no solution that Newton's method finds after t = {t:.7g} s.",
        "A flat program is solved for the coordinates at each instant.",
        nearest=f"The motion before t = {t:.6g} s, which is kept.",
        do="Check whether the path leaves the reach of the mechanism.",
        t=float(t),
    )
