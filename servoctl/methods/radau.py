"""Integrations in bulk, watched and sampled afterwards; Radau IIA methods for stiff motions among them."""

from dataclasses import dataclass

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.adaptive import INSIDE, Adaptive
from servoctl.methods.bounds import warn_unresolved
from servoctl.methods.drift import Poles, Project
from servoctl.methods.monitor import DEGRADED, NO_CHOICE
from servoctl.methods.radau_loop import first_step, inside, radau_steps
from servoctl.methods.resolution import unresolved

CHUNK = 200  # steps per call of the compiled loop


def radau_order(rtol):
    """The order of least work for a tolerance."""
    return 5 if rtol > 1e-4 else 9 if rtol > 1e-7 else 13


@dataclass(frozen=True)
class Steps:
    """Steps of a Radau IIA method.

    Attributes
    ----------
    t : (S + 1,) array
        Starts, and the end of the last one [s].
    x : (n_x, S + 1) array
        States there.
    failed : bool
        Whether no further step succeeds.
    order : int
    z : (S, s, n_x) array
        Increments of the stages.
    """

    t: np.ndarray
    x: np.ndarray
    failed: bool
    order: int
    z: np.ndarray

    def at(self, k, times):
        """States (n_x, N) at times (N,) within step k, by the collocation polynomial."""
        theta = (times - self.t[k]) / (self.t[k + 1] - self.t[k])
        return self.x[:, [k]] + inside(self.order, theta, self.z[k]).T

    def within(self, theta):
        """States (n_x, S, N) at fractions theta (N,) of all steps."""
        return self.x[:, :-1, None] + np.moveaxis(inside(self.order, theta, self.z), 2, 0)


class InBulk(Adaptive):
    """An integration that takes many steps at once, watched and sampled afterwards; `_steps` takes them."""

    every = 0

    def _piece(self, a, x, b):
        self.pending, self._sunk = np.array(self.pending), None
        self._begin(a, x, b)
        history, t = [self._guards(a, x)], a
        while t != b and self.motion.stop is None:
            steps = self._steps(t, x, b)
            stand, why = self._looked_at(steps, history)
            self._record(steps, stand)
            t, x = steps.t[stand], steps.x[:, stand].copy()
            self.progress(t)
            if why == "vanishes":
                self._around(t, x, history)
            elif why == "degrades":
                self._other(self.watch.anew(t, x, self._top(t, x)), t, x, history, (t, x, NO_CHOICE))
            elif steps.failed:
                self._failed(t, x, "")
                self._last(t, x)
        return x

    def _looked_at(self, steps, history):
        """How many steps stand, and whether a pivot "vanishes" in the next or "degrades" there."""
        total = len(steps.t) - 1
        if not total or not history[0].size:
            return total, ""
        times = (steps.t[:-1, None] + np.outer(np.diff(steps.t), INSIDE)).ravel()
        guards = self.f.grid(times, steps.within(np.array(INSIDE)).reshape(self.n_x, -1), self.p)[self.n_x :]
        self.motion.count(watched=times.size)
        reference = self.watch.reference
        track = np.column_stack([history[-1], self.watch.relative(guards)])
        quiet = np.all(np.sign(track[:, 1:]) * np.sign(track[:, :-1]) > 0) and np.all(np.abs(track) >= DEGRADED)
        if quiet and self._sunk is None:
            history[:] = [track[:, -2], track[:, -1]]
            return total, ""
        self.watch.reference = reference
        for k in range(total):
            start = (steps.t[k], steps.x[:, k].copy())
            if self._watched(history, start, steps.t[k + 1], lambda s, k=k: steps.at(k, np.array([s]))[:, 0]):
                return k, "vanishes"
            if self._must_repivot:
                return k + 1, "degrades"
        return total, ""

    def _around(self, t, x, history):
        """Before a pivot vanishes: go on with another choice of pivots, or say that the program is singular."""
        other = self.watch.other_choice(t, np.append(x, self._top(t, x)), *self._suspect[:2])
        self._other(other if self.motion.changes_pivots(t) else None, t, x, history, self._suspect)

    def _other(self, variant, t, x, history, suspect):
        if variant is None:
            self.motion.stop = self.watch.singular(*suspect)
            self._last(t, x)
        else:
            self._go_on(variant)
            history[:] = [self._guards(t, x)]

    def _record(self, steps, stand):
        """Record the pending samples within the first `stand` steps."""
        direction = 1.0 if self.forward else -1.0
        due = direction * self.pending <= direction * steps.t[stand]
        times, self.pending = self.pending[due], self.pending[~due]
        if not len(times):
            return
        owner = np.searchsorted(direction * steps.t[: stand + 1], direction * times, "right") - 1
        states = steps.x[:, np.clip(owner, 0, stand)]
        for k in np.unique(owner[owner < stand]):
            states[:, owner == k] = steps.at(k, times[owner == k])
        if self.every:
            states = self.loop.settle(times, states, self.p)
        top = self.f.grid(times, states, self.p)[self.n_x - self.model.n : self.n_x]
        self.motion.add(self.model, times, states, top)


class RadauMethod(InBulk):
    """One integration by a Radau IIA method.

    Parameters
    ----------
    model : Model
    drift : None, Poles or Project
    rtol, atol : float
    order : {5, 9, 13} or None
        None chooses it by `radau_order`.
    step : float or None
        Length of fixed steps [s]; None adapts them.
    progress : callable
    """

    def __init__(self, model, drift, rtol, atol, order, step, progress):
        self.order, self.step = radau_order(rtol) if order is None else order, step
        self.every = drift.every if isinstance(drift, Project) else 0
        self.chunk = max(CHUNK - CHUNK % self.every, self.every) if self.every else CHUNK
        super().__init__(model, "RadauIIA", drift, rtol, atol, progress)

    def _use(self, model):
        self.model = model
        stabilised = isinstance(self.drift, Poles)
        self.loop = radau_steps(model, stabilised)
        self.f = self.loop.f
        self.p = np.append(model.parameters, self.drift.coefficients(model)) if stabilised else model.parameters
        self.n_x = self.f.n_x

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate from t0 to t1; samples at t_eval. Fixed steps that do not resolve the motion are warned about."""
        self.taken = []
        motion = super().run(t0, x0, t1, t_eval, knots)
        if self.step is not None and motion.stop is None and not motion.interrupted:
            found = unresolved(self.taken, self._halved)
            if found is not None:
                step, _, difference, _ = found
                warn_unresolved("RadauIIA", step, np.abs(difference).max())
        return motion

    def _halved(self, model, t, x, h):
        self._use(model)
        settings = (self.rtol, self.atol, 2, True, self.every)
        return self.loop.steps(t, x, t + 2 * h, self.p, self.order, abs(h), *settings)[1]

    def _record(self, steps, stand):
        super()._record(steps, stand)
        if self.step is not None:
            self.taken.append((self.model, steps.t[: stand + 1], steps.x[:, : stand + 1]))

    def _begin(self, a, x, b):
        if self.step is None:
            self.h = first_step(self.f, a, x, self.p, self.order, b - a, self.rtol, self.atol)
            self.motion.count(nfev=2)
        else:
            self.h = abs(b - a) / max(1, np.ceil(abs(b - a) / self.step * (1 - 1e-12)))

    def _steps(self, t, x, b):
        settings = (self.rtol, self.atol, self.chunk, self.step is not None, self.every)
        t, x, _, z, self.h, counts = self.loop.steps(t, x, b, self.p, self.order, self.h, *settings)
        self.motion.count(steps=len(z), **dict(zip(("rejected", "nfev", "njev", "nlu"), counts, strict=True)))
        if self.every:
            self.motion.count(projections=len(z) // self.every)
            if t[-1] == b:
                x = np.column_stack([x[:, :-1], self.loop.settle(t[-1:], x[:, -1:], self.p)])
        return Steps(t, x, len(z) < self.chunk and t[-1] != b, self.order, z)

    def _failed(self, t, x, message):
        if self.watch.lost(t, x):
            self.motion.stop = self.watch.singular(t, x, "the step of the integrator shrinks to nothing")
            return
        why = "its steps vanish" if self.step is None else "a fixed step is not solved by the Newton iteration"
        self.motion.stop = IntegrationStopped(
            f"RadauIIA stopped at t = {t:.7g} s: {why}.",
            "A motion is integrated as far as its solution exists and steps can be solved.",
            nearest=f"The motion before t = {t:.6g} s, which is kept.",
            do="Take a smaller step or none, loosen rtol, or see whether the motion escapes.",
            t=float(t),
        )
