"""A first transient: forces that decay from the first instant on because of what a start gives to free values."""

import warnings

import numpy as np

from servoctl.errors import ServoError
from servoctl.markup import digits
from servoctl.model.jets import with_highest
from servoctl.model.start import STILL, without_rounding
from servoctl.run import AGREES


def first_transient(run, motion):
    """What to say where a force begins above all its later peaks, with a start, found, that has none of it; else "".

    `motion(start, span)` is the run of the same model from a state over a span (t0, t1) [s]. A run keeps the answer.
    """
    if "_transient" not in vars(run):
        vars(run)["_transient"] = _sought(run, motion)
    return vars(run)["_transient"]


def _sought(run, motion):
    """As `first_transient`."""
    model, start, moves = run.model, run.start, np.abs(run.jets[run.model.nq :, 0]).max() > STILL  # at rest is none
    driven = model.reduction.mechanism.actuators and not model.reduction.ideal
    if not (moves and driven and model.free and start and run.success and run.t[0] < run.t[-1]):
        return ""
    names, forces = run.signals("actuation")
    sizes = np.abs(forces)
    if not sizes.any():
        return ""
    falls = [int(np.argmin(np.append(np.diff(size) < 0, False))) for size in sizes]
    later, rounding = np.array([s[k:].max() for s, k in zip(sizes, falls, strict=True)]), AGREES * sizes.max()
    a = int(np.argmax(sizes[:, 0] / (later + rounding)))
    first, most = (digits(float(size), 4) for size in (forces[a, 0], later[a]))
    if sizes[a, 0] <= later[a] + rounding or digits(sizes[a, 0], 3) == digits(later[a], 3):
        return ""
    values = ", ".join(f"{name} = {run[name][0]:.4g}" for name in start.held or start.free if name in run.names)
    cause = f", as {values} {'was held' if start.held else 'was left free'}" * bool(values)
    for state in _attracted(run, run.t[falls[a]], motion):
        call = _call(state, model, later + rounding) if _nearer(run, state, falls[a]) else ""
        if call:
            told = f"{names[a]} has a first transient of {first} {run.unit(names[a])}".rstrip()
            return f"{told} and is at most {most} later{cause}. Start without it: {call}"
    return ""


def _nearer(run, state, k):
    """Whether a state lies as near as the run's start to where it moves from its sample k on: on the same branch."""
    later, nq = run.jets[: run.model.nq, k:].T, run.model.nq
    found, first = (np.linalg.norm(x[:nq] - later, axis=1).min() for x in (state.values, run.jets[:, 0]))
    return found <= first


def _attracted(run, fallen, motion):
    """Starts beside that of a run: a rest, and where motions that began earlier have come to by then.

    They begin as long before as the run lasts, or as the transient does until it has `fallen` [s]. The model remembers
    those that it found for the last start.
    """
    model, t0 = run.model, float(run.t[0])
    start = dict(zip(model.state_names, run.jets[:, 0].tolist(), strict=False))
    last, found = vars(model).get("_attracted", (None, {}))
    if last != (t0, start):
        last, found = vars(model)["_attracted"] = (t0, start), {}
    for length in dict.fromkeys((0.0, float(run.t[-1]) - t0, float(fallen) - t0)):
        if length not in found:
            found[length] = _come_to(model, t0, start, length, motion)
        if found[length] is not None:
            yield found[length]


def _come_to(model, t0, start, length, motion):
    """The start at t0 [s] to which a motion has come that began from a start by name so long before; None if none."""
    guess = {name: value for name, value in start.items() if length or name in model.reduction.mechanism.q.names}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            state = model.start(t0 - length, guess=guess)
            x = motion(state, (state.t, t0)).jets[: len(start), -1] if length else state.values
            return model.start(t0, guess=dict(zip(start, without_rounding(x).tolist(), strict=True)))
    except ServoError:
        return None


def _call(state, model, later):
    """The call of a start by as few digits of its free values as serve; "" if a force is above its `later` peaks."""
    f = model.signals("actuation")[1]

    def below(x):
        forces = f.grid([state.t], with_highest(model, [state.t], x[:, None])[: f.n_x], model.p)[:, 0]
        return (np.abs(forces) <= later).all()

    for most in (4, 8, 16) if below(state.values) else ():
        held = {name: float(f"{state[name]:.{most}g}") for name in state.free}
        guess = {name: float(f"{state[name]:.4g}") for name in model.reduction.mechanism.q.names if name not in held}
        try:
            x = model.start(state.t, guess=guess, **held).values
        except ServoError:
            continue
        if below(x):
            values = [f"t={state.t:g}"] * bool(state.t) + [f"{name}={value}" for name, value in held.items()]
            return f"model.start({', '.join([*values, *[f'guess={guess}'] * bool(guess)])})"
    return ""
