"""Switches of a motion: where its equations have a kink or jump, and on which side they go on."""

import numpy as np

from servoctl.errors import IntegrationStopped
from servoctl.methods.pieces import LEAVES, RESOLUTION, End, least_between, net, residuals, row_of
from servoctl.model.equations import invariant_names

AT_ONCE = 1e-9  # of the span: switches closer than this follow at once
BESIDE_ENDS = 1e-3  # of a step: instants next to its ends, which show where a function has its least value across steps
NEAR_ZERO = 0.2  # of a function's values beside its least one: a vertex below this is looked at closely
MOST_AT_ONCE = 2  # changes of one branch at once, after which the motion stays on the switch


class Switches:
    """The switching functions of a motion of length `span` [s], evaluated at the ends of so many parts of each step.

    `branches` are those that hold, `start` is that of the piece [s]; `tolerance` is that of the states.
    """

    def __init__(self, family, branches, span, parts, tolerance):
        self.family, self.branches, self.span, self.parts, self.tolerance = family, branches, span, parts, tolerance
        self.counts, self.rested, self.start = {}, set(), 0.0

    def first(self, stretch, states, state):
        """The first switch within steps as an `End`, or None.

        `states` gives X (n_x, N) from steps (N,) and times (N,), where switches are looked for; `state` from (k, t),
        where one is located.
        """
        t, x = self._instants(stretch, states)
        functions, slopes, _ = self.family.values(self.branches, t, x)
        allowed = self.tolerance.of(slopes, x)
        wrong = functions < -allowed
        wrong[:, 0] = False  # where the branches were chosen: a root that is rounded
        last = max(int(np.argmax(wrong.any(axis=0))), 1) if wrong.any() else len(t)
        direction = np.copysign(1.0, t[-1] - t[0])

        def step(s):
            return int(np.clip(np.searchsorted(direction * stretch.t, direction * s) - 1, 0, len(stretch.t) - 2))

        crossing = self._grazed(t[:last], functions[:, :last], allowed, lambda s: state(step(s), s))
        if crossing is None and not wrong.any():
            return None
        begin, end, rows = crossing or (t[last - 1], t[last], np.flatnonzero(wrong[:, last]))
        roots = {i: self._root(i, begin, end, lambda s: state(step(s), s)) for i in rows}
        at = direction * min(direction * root for root in roots.values())
        changed = tuple(int(i) for i, root in roots.items() if abs(root - at) <= AT_ONCE * self.span)
        k = step(at)
        y = state(k, at) if at != t[0] else stretch.x[:, 0]
        return End(k, float(at), y, changed, self._beyond(changed, at, y))

    def _grazed(self, t, functions, allowed, state):
        """The first interval in which a function dips below zero between instants: its ends and the function; or None.

        Where a function has a least value among three instants, the parabola through them shows whether it comes near
        zero between them; its true minimum decides.
        """
        if len(t) < 3:
            return None
        least, vertex = least_between(t, functions)
        low = least & (vertex < NEAR_ZERO * np.minimum(functions[:, :-2], functions[:, 2:]))
        for j, i in np.argwhere(low.T):
            begin, end = t[j], t[j + 2]
            least, value = self._least(i, begin, end, state)
            if value < -allowed[i, j + 1]:
                return begin, least, np.array([i])
        return None

    def _least(self, i, a, b, state):
        from scipy.optimize import minimize_scalar

        def function(s):
            return self.family.values(self.branches, np.array([s]), state(s)[:, None])[0][i, 0]

        found = minimize_scalar(function, bounds=sorted((a, b)), method="bounded", options={"xatol": 1e-9 * abs(b - a)})
        return found.x, found.fun

    def _instants(self, stretch, states):
        """Instants (N,) and states (n_x, N) at which the functions are evaluated: ends of steps, and parts of them."""
        k, at, _ = net(stretch.t, self.span / RESOLUTION, self.parts)
        h, every = np.diff(stretch.t), np.arange(len(stretch.t) - 1)
        beside = np.concatenate([stretch.t[:-1] + BESIDE_ENDS * h, stretch.t[1:] - BESIDE_ENDS * h])
        k, at = np.concatenate([k, every, every]), np.concatenate([at, beside])
        order = np.lexsort((at if h[0] > 0 else -at, k))
        k, at = k[order], at[order]
        x, last = states(k, at), np.append(k[1:] > k[:-1], True)
        x[:, last] = stretch.x[:, 1:]
        return np.append(stretch.t[:1], at), np.column_stack([stretch.x[:, :1], x])

    def _root(self, i, a, b, state):
        from scipy.optimize import brentq

        def function(s):
            return self.family.values(self.branches, np.array([s]), state(s)[:, None])[0][i, 0]

        low, high = function(a), function(b)
        if not low > 0 > high:
            return a
        return brentq(function, a, b, xtol=1e-15, rtol=8.9e-16)

    def _beyond(self, changed, t, x):
        """All branches beyond a switch, with those that follow from it."""
        result, open_ = list(self.branches), list(changed)
        t, x = np.array([t]), x[:, None]
        while open_:
            others = self.family.values(tuple(result), t, x)[2]
            for i in open_:
                result[i] = float(others[i, 0])
            changed = {*changed, *open_}
            functions, slopes, _ = self.family.values(tuple(result), t, x)
            wrong = np.flatnonzero(functions[:, 0] < -self.tolerance.of(slopes, x)[:, 0])
            open_ = [i for i in wrong if i not in changed]
        return tuple(result)

    def stays(self, end):
        """The switches from which the motion is driven back on both sides, in words, and the branches to go on with.

        Where sign(0) = 0 and |0| = 0 are meant, the motion may rest on the switch: it is tried once.
        """
        if abs(end.t - self.start) > AT_ONCE * self.span:
            self.counts, self.rested = {}, set()
        for i in end.switched:
            self.counts[i] = self.counts.get(i, 0) + 1
        stuck = [i for i, count in self.counts.items() if count > MOST_AT_ONCE]
        if stuck and not self.rested & {*stuck} and all(self.family.switches[i].rests for i in stuck):
            self.rested |= {*stuck}
            return [], tuple(0.5 if i in stuck else b for i, b in enumerate(end.branches))
        return [self.family.switches[i].text for i in stuck], end.branches

    def texts(self, end):
        """The switches that the motion crosses at an end, in words."""
        return " and ".join(self.family.switches[i].text for i in end.switched)

    def jump(self, model, other, end):
        """The error of a residual, or derivative of one, that jumps from one model to another; None if none does."""
        names = [name for _, name in invariant_names(model)]
        if not names or names != [name for _, name in invariant_names(other)]:
            return None
        place = self.tolerance, np.array([end.t]), end.x[:, None]
        (before, allowed), (after, beyond) = (residuals(side, *place) for side in (model, other))
        heights = np.abs(after - before)[:, 0]
        jumps = np.flatnonzero(heights > LEAVES * np.maximum(allowed, beyond)[:, 0])
        if not len(jumps):
            return None
        name, height = names[jumps[0]], float(heights[jumps[0]])
        where = self.texts(end)
        row = row_of(model, name)
        what = f"{name!r} jumps" if row is None else f"{row!r} has a kink: its rate {name} jumps"
        return IntegrationStopped(
            f"The residual {what} by {height:.3g} at t = {end.t:.7g} s, where {where}.",
            "To keep it at zero on both sides, coordinates or velocities would jump.",
            do="Write the residual with a smooth function, such as sqrt(y**2 + a**2) for |y|, or let the motion end "
            "here. The run before this instant is in .run.",
            t=end.t,
            residual=row or name,
            level=name,
            height=height,
            switch=where,
        )


def sticks(method, t, switches):
    """The error of a motion that cannot leave a switch."""
    where = " and ".join(switches)
    return IntegrationStopped(
        f"{method} stopped at t = {t:.7g} s: the motion stays at the switch {where}, driven back from both sides.",
        "On a switch the equations of neither side hold, as where dry friction sticks.",
        do="Write the switch as a smooth function, such as tanh(v/v0) for sign(v), or let the motion end here. The run "
        "before this instant is in .run.",
        t=t,
        switches=list(switches),
    )


def no_model(method, t, where, reason):
    """The error of a motion that meets a switch beyond which its program has no model."""
    return IntegrationStopped(
        f"{method} stopped at t = {t:.7g} s, where {where}: {reason}",
        "Beyond a switch the program needs a model of the same structure.",
        do="Let the motion end here. The run before this instant is in .run.",
        t=t,
        switch=where,
        reason=type(reason).__name__,
    )
