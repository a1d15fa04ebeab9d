"""Equilibria on a switch: the motion on either side has another linearisation, and eigenvalues decide nothing."""

import numpy as np

from servoctl.errors import ServoError
from servoctl.methods.bounded import FreeEntries
from servoctl.model.switching import switching
from servoctl.values import evenly

ON_SWITCH = 1e-6  # value of a switching function, of what the state's size changes it by, below which it is zero
SAME_SIDES = 1e-6  # relative difference of two linearisations that is rounding
STAYS_AT = 5  # instants of a run that stays on a switch
SMOOTHER = "smooth the switch, such as tanh(v/v0) for sign(v)"  # the remedy


def kink(model, t, x):
    """The switch on which an equilibrium lies without a linearisation, in words; "" if there is none."""
    family = switching(model)
    if family is None:
        return ""
    branches = family.branches(t, x)
    values, slopes, others = (part[..., 0] for part in family.values(branches, np.array([t]), x[:, None]))
    near = np.abs(values) <= ON_SWITCH * (np.abs(slopes) @ np.maximum(np.abs(x), 1.0))
    for k, switch in enumerate(family.switches):
        if near[k] and not switch.angle:
            beyond = (*branches[:k], float(others[k]), *branches[k + 1 :])
            if not _same(family, branches, beyond, t, x):
                return switch.text
    return ""


def stays_on_switch(model, run):
    """The switch on which a run lies from start to end, without a linearisation, in words; "" if there is none."""
    if switching(model) is None:
        return ""
    x = run.jets[: len(model.state_names)]
    known = np.flatnonzero(np.isfinite(x).all(axis=0))
    some = known[evenly(len(known), STAYS_AT)]
    found = [kink(model, run.t[k], x[:, k]) for k in some]
    return found[0] if all(found) else ""


def _same(family, branches, beyond, t, x):
    """Whether the linearisations on both sides of a switch are one."""
    try:
        (free, rate, A), (others, other_rate, B) = (_linearised(family.at(side), t, x) for side in (branches, beyond))
    except ServoError:
        return False
    sides = np.array_equal(free, others) and np.abs(rate - other_rate).max(initial=0.0) <= SAME_SIDES
    return bool(sides and np.abs(A - B).max(initial=0.0) <= SAME_SIDES * np.abs(A).max(initial=1.0))


def _linearised(model, t, x):
    """The free entries of a smooth model, their rates and the linearisation in their sizes."""
    entries = FreeEntries(model, t, x)
    rate, A = (part[0] for part in entries.local(np.array([t]), x[:, None])[:2])
    size = entries.size[entries.free]
    return entries.free, rate / size, A * size / size[:, None]
