"""Measured runs of a plant: inputs and measurements at equal intervals, checked."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servoctl.checks import array_of, as_list, as_numbers, named, numbers_by_name
from servoctl.control.conditions import steps
from servoctl.control.result import Closed
from servoctl.errors import SpecificationError
from servoctl.values import frozen

UNEVEN = 1e-3  # of the median interval: samples farther from equal intervals are uneven
AROUND = 5  # samples to each side, through which a line guesses a velocity that is not measured
SELDOM = 5.0  # time constants of the plant's fastest eigenvalue, beyond which samples do not show it
GAP = 1.5  # median intervals, beyond which samples are missing


@frozen
class Record:
    """One measured run, or a piece of it."""

    t: np.ndarray  # (N,) [s]
    inputs: np.ndarray  # (m, N) that act from each sample on
    held: np.ndarray  # (m, (N - 1) substeps), inputs in each integration step
    measured: dict  # (N,) arrays by name
    substeps: int  # Runge-Kutta steps between two samples
    step: float  # their length [s]
    states: np.ndarray  # (n_x, N) guesses

    def pieces(self, count):
        """The record cut into at most `count` pieces, each with a first state of its own: (first sample, piece)."""
        length = max(-(-len(self.t) // count), 2)
        cuts = [*range(0, len(self.t) - 1, length), len(self.t)]
        return [(a, self._samples(a, b)) for a, b in zip(cuts[:-1], cuts[1:], strict=True)]

    def _samples(self, a, b):
        """The samples a .. b - 1."""
        return replace(
            self,
            t=self.t[a:b],
            inputs=self.inputs[:, a:b],
            held=self.held[:, a * self.substeps : (b - 1) * self.substeps],
            measured={name: values[a:b] for name, values in self.measured.items()},
            states=self.states[:, a:b],
        )


def _held(inputs, late, before, substeps):
    """Inputs in each integration step, (m, steps), which arrive late by some of these steps."""
    k = np.arange((inputs.shape[1] - 1) * substeps)
    sent = [(k - d) // substeps for d in late]
    rows = zip(inputs, sent, before, strict=True)
    return np.array([np.where(i < 0, first, u[np.maximum(i, 0)]) for u, i, first in rows]).reshape(-1, len(k))


def as_records(plant, measured, noise, start):
    """Records (a list) from measured runs, and the standard deviations of the measurements by name."""
    listed = [measured] if isinstance(measured, (Closed, Mapping)) else as_list(measured)
    if not listed or not all(isinstance(one, (Closed, Mapping)) for one in listed):
        raise SpecificationError(
            f"The measurements are {repr(measured)[:150]}.",
            "They are closed loops, or dicts of arrays by name.",
            do='Pass sv.close(...), {"t": ..., "trolley": ..., "theta": ...}, or several of them.',
            type=type(measured).__name__,
        )
    noise = _levels(plant, listed, noise)
    return [_record(plant, one, noise, start) for one in listed], noise


def _levels(plant, listed, noise):
    """Standard deviations by measured name: those that were given, or those of the sensors of closed loops."""
    states = [name for name in plant.state_names if name not in plant.lagged]  # which are named like their inputs
    names = (*states, *plant.mechanism.outputs)
    if noise is not None:
        noise = numbers_by_name(noise, names, "state or output", "noise level", positive=True)
    elif isinstance(listed[0], Closed):
        sensors = listed[0].conditions.sensors
        quanta = {name: sensors.quantisation.get(name, 0.0) for name in listed[0].law.measures if name in names}
        noise = {name: float(np.hypot(sensors.noise.get(name, 0.0), q / np.sqrt(12))) for name, q in quanta.items()}
        noise = {name: level for name, level in noise.items() if level > 0}
    if not noise:
        one = listed[0].law.measures if isinstance(listed[0], Closed) else listed[0]
        example = next((name for name in names if name in one), names[0])
        raise SpecificationError(
            "No noise level is known.",
            "Measurements are weighed by their standard deviations.",
            do=f'Write noise={{"{example}": 1e-3}} with its standard deviation; only what has a level is used.',
            names=names,
        )
    return noise


def _record(plant, one, noise, start):
    if isinstance(one, Closed):
        _require_states(plant, one)
        data, guess = {"t": one.t, **one.measured, **one.input}, one.states[:, 0]
    else:
        data, guess = dict(one), np.zeros(plant.n_x)
    data = _checked(plant, data, noise)
    t = data["t"]
    inputs = np.array([data[name] for name in plant.inputs]).reshape(len(plant.inputs), len(t))
    states = _guesses(plant, data, guess, start)
    if isinstance(one, Closed):
        substeps, late, before = one.loop.substeps, one.loop.transport, one.loop.initial_input
    else:
        before, period = inputs[:, 0], float(t[-1] - t[0]) / (len(t) - 1)
        _require_often(plant, t, period, states[:, 0], before)
        substeps, late = steps(plant, period, None, float(t[0]), states[:, 0], before)
    late = np.zeros(len(before), dtype=int) if late is None else late
    step = float(t[-1] - t[0]) / ((len(t) - 1) * substeps)
    measured = {name: data[name] for name in noise}
    return Record(t, inputs, _held(inputs, late, before, substeps), measured, substeps, step, states)


def _require_often(plant, t, period, x, u):
    """Refuse samples that are too far apart for the fastest eigenvalue of the plant at its start."""
    A, _ = plant.linearised(float(t[0]), x[:, None], u[:, None])
    fastest = float(np.abs(np.linalg.eigvals(A[0])).max(initial=0.0)) if np.isfinite(A).all() else np.inf
    if fastest * period <= SELDOM:
        return
    if not np.isfinite(fastest):
        raise SpecificationError(
            "The plant's linearisation at the first sample is not finite.",
            "The search starts from a state in which the plant can move.",
            do="Pass another first state, start={...}, or other numbers of the plant.",
            start=x.tolist(),
        )
    raise SpecificationError(
        f"Samples are {period:g} s apart, and the plant's fastest eigenvalue at the first one is {fastest:.4g} 1/s.",
        f"Samples are at most {SELDOM:g} time constants of the plant's fastest eigenvalue apart.",
        nearest=f"Intervals of {SELDOM / fastest:.3g} s.",
        do=f"Write t in seconds: {period:g} ms are {period / 1000:g} s. Otherwise sample faster, or leave out a "
        "lag or a stiffness that the samples do not show.",
        period=period,
        eigenvalue=fastest,
        most=SELDOM / fastest,
    )


def _require_states(plant, loop):
    """Refuse a closed loop of a plant with other states or inputs."""
    for what in ("state_names", "inputs"):
        ours, theirs = getattr(plant, what), getattr(loop.plant, what)
        if ours != theirs:
            raise SpecificationError(
                f"The closed loop has the {what.replace('_', ' ')} {', '.join(theirs)}.",
                f"Those of the plant are {', '.join(ours)}.",
                do="Pass a plant with the same coordinates, actuators and lags.",
                names=theirs,
                expected=ours,
            )


def _guesses(plant, data, guess, start):
    """Guesses of the states (n_x, N): what is measured, slopes of what is, inputs for lagged ones, else the start's."""
    if isinstance(start, Mapping):
        values = numbers_by_name(dict(start), plant.state_names, "state", "first value")
        guess = np.array([values.get(name, x) for name, x in zip(plant.state_names, guess, strict=True)])
    elif start is not None:
        guess = array_of("start", start, plant.n_x)
    states = np.repeat(guess[:, None], len(data["t"]), axis=1)
    velocities = dict(zip(plant.mechanism.q.jet_names(1), plant.mechanism.q.names, strict=False))
    for i, name in enumerate(plant.state_names):
        if name in data:
            states[i] = data[name]
        elif name in velocities and velocities[name] in data and plant.mechanism.q.plain:
            states[i] = _line_slopes(data["t"], data[velocities[name]])
    return states


def _line_slopes(t, values):
    """Slopes (N,) of straight lines through the samples around each one."""
    from scipy.signal import savgol_filter

    around = min(AROUND, (len(t) - 1) // 2)
    return savgol_filter(values, 2 * around + 1, 1, deriv=1, delta=t[1] - t[0])


def _checked(plant, data, noise):
    """Arrays (N,) by name, all of one length, at equal intervals, with finite values."""
    known = ("t", *plant.inputs, *plant.state_names, *plant.mechanism.outputs)
    for name in data:
        named(name, known, "measurement")
    missing = [name for name in ("t", *plant.inputs, *noise) if name not in data]
    if missing:
        raise SpecificationError(
            f"The measurements have no {missing[0]!r}.",
            f"They have the times t, every input ({', '.join(plant.inputs)}), and all that has a noise level.",
            do=f"Add {', '.join(missing)}.",
            missing=missing,
        )
    arrays = {name: np.atleast_1d(as_numbers(values)) for name, values in data.items()}
    count = arrays["t"].size
    for name, values in arrays.items():
        if values.shape != (count,) or count < 3:
            raise SpecificationError(
                f"{name!r} has {values.size} values, t has {count}.",
                "All signals are sampled at the same instants, at least 3.",
                do="Interpolate slower signals to the instants t, or leave them out.",
                name=name,
                values=values.size,
                instants=count,
            )
    _require_even(arrays["t"])
    used = ("t", *plant.inputs, *noise)
    for name in used:
        lost = np.flatnonzero(~np.isfinite(arrays[name]))
        if len(lost):
            t = float(arrays["t"][lost[0]])
            raise SpecificationError(
                f"{name!r} has {len(lost)} values that are no finite numbers, the first at t = {t:.7g} s.",
                "Every sample has a value.",
                do="Interpolate over them, or pass the parts between them as several runs.",
                name=name,
                lost=len(lost),
                t=t,
                sample=int(lost[0]),
            )
    return {name: values for name, values in arrays.items() if name in used or name in plant.state_names}


def _require_even(t):
    """Refuse instants that are not in order, have gaps, or are not at equal intervals."""
    lost = np.flatnonzero(~np.isfinite(t))
    intervals = np.diff(np.delete(t, lost))
    period = float(np.median(intervals))
    kinds = {
        "not finite": lost,
        "not after the one before": np.flatnonzero(intervals <= 0),
        "after a gap": np.flatnonzero(intervals > GAP * period),
        "not at equal intervals": np.flatnonzero(np.abs(intervals - period) > UNEVEN * period),
    }
    for what, where in kinds.items():
        if len(where):
            k = int(where[0]) + (what != "not finite")
            raise SpecificationError(
                f"{len(where)} of {len(t)} instants are {what}, the first at sample {k}, t = {t[k]:.7g} s.",
                f"Samples follow each other at equal intervals, here {period:.7g} s.",
                do="Interpolate to equal intervals, or pass the parts between gaps as several runs.",
                count=len(where),
                sample=k,
                period=period,
            )
