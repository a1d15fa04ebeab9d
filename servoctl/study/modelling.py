"""Levels of modelling as motions: models and plants of one scene, their starts, runs, and deviations by name."""

import inspect
import time
from contextlib import suppress
from dataclasses import replace

import numpy as np

from servoctl.checks import mapping, named, numbers_by_name, texts
from servoctl.control.close import close
from servoctl.errors import NameUnknown, ServoError, SpecificationError, unknown
from servoctl.methods.accuracy import component_sizes
from servoctl.methods.choice import Project
from servoctl.model.model import Model, derive
from servoctl.plants.equations import equations_at
from servoctl.plants.plant import Plant, plant
from servoctl.simulation import simulated
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program
from servoctl.study.tradeoff import CHECKS, Deadline, Reference, method_at, whole_run
from servoctl.values import frozen

ACCURACIES = (1e-3, 1e-6, 1e-9)  # relative tolerances with which levels are integrated
FEWEST_ROUNDS, ROUNDS_FOR = 3, 0.1  # rounds of timed calls, one of each row, and s that they take together in a case
LONGEST_CALL = 3.0  # s that one motion may take
ROW_SETTINGS = {True: ("none", ""), False: ("project", "rtol")}  # drift and setting of flat programs, and of others
MANY_STEPS = 150  # which a finer tolerance does not multiply: stability limits them
COURSE = 201  # at which the courses of errors in time are compared from case to case
ZERO_SIGNAL = 1e-9  # an output below this part of the largest signal is zero, and its error absolute


@frozen
class Level:
    """A model and its plant; `arguments` are the parameters that its function took from a case."""

    model: Model
    plant: Plant
    arguments: tuple = ()

    def at(self, numbers):
        """The level with other parameters, of those that it has."""
        numbers = {name: value for name, value in numbers.items() if name in self.model.numbers}
        return replace(self, model=self.model.with_parameters(**numbers), plant=_plant_at(self.plant, numbers))


class Levelled:
    """One scene at several levels: what does not change from case to case.

    Parameters
    ----------
    builds : dict of str to callable, (Mechanism, Program) or Model
    reference : str
        Name of the level with which others are compared.
    span : (t0, t1)
        [s]
    start : dict, callable or None
    outputs : sequence of str, dict of str to float, or None
    law : callable or None
    """

    def __init__(self, builds, reference, span, start, outputs, law):
        self.builds, self.reference, self.span, self.law = builds, reference, span, law
        self.held = None if callable(start) else mapping(start, "The values at the start")
        self.start = start
        self.sizes = numbers_by_name(outputs, outputs, "", "size", positive=True) if isinstance(outputs, dict) else {}
        self.names = None if outputs is None else tuple(self.sizes) or texts(outputs, "The outputs")
        self.actuators, self._built = None, {}

    def built(self, name, case):
        """The parameters that a level's function takes from a case, and what it returns for them."""
        build = self.builds[name]
        own = inspect.signature(build).parameters if callable(build) else ()
        arguments = {key: value for key, value in case.items() if key in own}
        key = (name, *arguments.items())
        if key not in self._built:
            made = build(**arguments) if callable(build) else build
            self._built[key] = require_level(name, made, self.law)
        return arguments, self._built[key]

    def level(self, name, case):
        """A level with the parameters of a case: arguments of its function, or parameters of its model."""
        arguments, made = self.built(name, case)
        key = (name, "level", *arguments.items())
        if key not in self._built:
            self._built[key] = as_level(made, tuple(arguments), self.names or ())
        return self._built[key].at({key: value for key, value in case.items() if key not in arguments})

    def parameters(self, case):
        """Names of the parameters of all levels that can be built."""
        names = {}
        for name in self.builds:
            with suppress(ServoError):
                level = self.level(name, case)
                names |= dict.fromkeys((*level.arguments, *level.model.numbers))
        return tuple(names)

    def measured(self, case, bar):
        """The rows of a case, and the largest disagreement of the two methods that computed each motion.

        The latter are two numbers, of the motion and of the actuation.
        """
        try:
            exact = self._motion(self.reference, case)
        except ServoError as error:
            if self.actuators is None:  # in the first case
                raise
            said = f"the reference: {_failure(error)}"
            return [{"level": name, "failure": said} for name in self.builds], np.zeros(2)
        motions, rows = {}, []
        for name in self.builds:
            self.built(name, case)
            try:
                motions[name] = exact if name == self.reference else self._motion(name, case, exact.start)
            except ServoError as error:
                rows.append({"level": name, "failure": _failure(error)})
            bar.update()
        self._settle_names(motions)
        self._require_held(motions.values())
        comparison = Comparison(self, exact, motions.values())
        for name, motion in motions.items():
            rows += [{"level": name, **row} for row in comparison.ladder(motion)]
        _time(rows)
        order = list(self.builds)
        unsure = np.max([comparison.disagreement(motion) for motion in motions.values()], axis=0)
        return sorted(rows, key=lambda row: order.index(row["level"])), unsure

    def _motion(self, name, case, near=None):
        """A level's motion; what it leaves free at the start is near the start of the reference."""
        level = self.level(name, case)
        start = self.start(level.model) if self.held is None else self._start(level.model, near)
        return LevelMotion(level, start, self.span)

    def _start(self, model, near):
        held = {name: value for name, value in self.held.items() if name in (*model.state_names, *model.outputs)}
        near = {} if near is None else dict(zip(near.names, near.values.tolist(), strict=True))
        guess = {name: value for name, value in near.items() if name in model.state_names and name not in held}
        return model.start(t=self.span[0], guess=guess or None, **held)

    def _require_held(self, motions):
        """Refuse values at the start that no level has."""
        known = {name: None for motion in motions for name in (*motion.model.state_names, *motion.model.outputs)}
        for name in self.held or ():
            named(name, known, "value at the start")

    def _settle_names(self, motions):
        """Which signals are compared: decided in the first case, and the same in all."""
        models = [motion.model for motion in motions.values()]
        reference = motions[self.reference].model
        if self.names is None:
            shared = [{*model.coordinate_names, *model.outputs} for model in models]
            signals = (*reference.coordinate_names, *reference.outputs)
            self.names = tuple(name for name in signals if all(name in names for names in shared))
        if not self.names:
            raise SpecificationError(
                f"The levels {', '.join(motions)} share no coordinate and no output.",
                "Their motions are compared by signals of the same name.",
                do="Give their mechanisms outputs of the same name, such as the position of the load.",
                levels=list(motions),
            )
        for name, motion in motions.items():
            motion.require(self.names, name)
        if self.actuators is None:
            forces = [_forces(model) for model in models]
            self.actuators = tuple(name for name in _forces(reference) if all(name in names for names in forces))


class LevelMotion:
    """A level's converged motion from its start."""

    def __init__(self, level, start, span):
        self.model, self.plant, self.start, self.span = level.model.including(start.names), level.plant, start, span
        self.converged = Reference(self.model, start, span, LONGEST_CALL, CHECKS[::-1])

    def run(self, method, drift, times):
        """The run by a method, sampled at times (N,) [s]."""
        options = {"drift": drift, "t_eval": times, "progress": Deadline(LONGEST_CALL)}
        return whole_run(simulated(self.model, self.start, self.span, method, **options))

    def require(self, signals, level):
        """Refuse signals that the motion does not have."""
        run = self.converged.check
        for name in signals:
            try:
                run[name]
            except NameUnknown as error:
                raise unknown(name, run.names, f"signal of the level {level!r}") from error


class Comparison:
    """Deviations of motions from the converged one of the reference, in signals of the same names."""

    def __init__(self, scene, exact, motions):
        self.exact, self.names, self.actuators, self.law = exact, scene.names, scene.actuators, scene.law
        self.times = np.unique(np.concatenate([motion.converged.times for motion in motions]))
        self.run = exact.converged.at(self.times)
        together = [name for name in self.names if name in exact.model.coordinate_names]
        forces = _signal_sizes(self.run, self.actuators, self.actuators)
        self.sizes = _signal_sizes(self.run, self.names, together) | forces | scene.sizes

    def off(self, names, run, other):
        """Largest deviation of signals between two motions at the same instants, relative to their sizes."""
        off = [float(np.abs(run[name] - other[name]).max()) / self.sizes[name] for name in names]
        return max(off, default=np.nan)

    def course(self, names, run, other):
        """Deviations of all signals at evenly spaced instants (n COURSE,): how an error goes with time."""
        t = np.linspace(*self.exact.span, COURSE)
        forward = np.argsort(run.t)
        off = [(run[name] - other[name])[forward] / self.sizes[name] for name in names]
        return np.concatenate([np.interp(t, run.t[forward], values) for values in off] or [np.zeros(0)])

    def disagreement(self, motion):
        """Deviations of motion and actuation between the two methods that computed a converged motion."""
        exact, check = motion.converged.at(motion.converged.times), motion.converged.check
        return [self.off(names, check, exact) if names else 0.0 for names in (self.names, self.actuators)]

    def in_loop(self, motion, run):
        """Deviation of the reference's plant under the law of a level's plan, and its course."""
        span = self.exact.span
        loop = close(self.exact.plant, self.law(run, motion.plant), self.run.state(span[0]), span)
        names, exact = [name for name in self.names if name in loop.names], self.exact.converged.at(loop.t)
        return self.off(names, loop, exact), self.course(names, loop, exact)

    def ladder(self, motion):
        """The rows of a level: one for each setting; by an implicit method, too, where stability limits the steps."""
        if motion.model.flat:
            return [self._row(motion, "algebraic", np.nan)]
        rows = [self._row(motion, "Taylor", value) for value in ACCURACIES]
        steps = [row.get("steps", MANY_STEPS) for row in rows]  # of those that take too long, too
        if steps[0] >= max(MANY_STEPS, steps[-1]):
            rows += [self._row(motion, "RadauIIA", value) for value in ACCURACIES]
        return rows

    def _row(self, motion, name, value):
        flat, converged = motion.model.flat, motion.converged.at(self.times)
        method, drift = method_at(name, value), None if flat else Project()
        row = {"method": name, "value": value} | dict(zip(("drift", "setting"), ROW_SETTINGS[flat], strict=True))
        row["modelling"] = self.off(self.names, converged, self.run)
        row["courses"] = {"modelling": self.course(self.names, converged, self.run)}
        try:
            run = motion.run(method, drift, self.times)
            row |= self._errors(motion, run, converged) | {"call": (motion.run, method, drift, self.times)}
            row["courses"]["actuation"] = self.course(self.actuators, run, self.run)
            row["failure"] = "" if self.law is None else self._looped(motion, run, row)
        except ServoError as error:
            row["failure"] = _failure(error)
        return row

    def _errors(self, motion, run, converged):
        return {
            "error": self.off(self.names, run, self.run),
            "integration": self.off(self.names, run, converged),
            "actuation": self.off(self.actuators, run, self.run),
            "operations": motion.model.function("path" if motion.model.flat else "ode").operations,
            "evaluations": run.counters.get("nfev", run.counters.get("iterations", 0)),
            "steps": run.counters.get("steps", len(run.t)),
        }

    def _looped(self, motion, run, row):
        """Add the error in the loop to a row; returns why there is none, or an empty text."""
        try:
            row["in_loop"], row["courses"]["in_loop"] = self.in_loop(motion, run)
        except ServoError as error:
            return f"in the loop: {_failure(error)}"
        return ""


def add_likeness(rows):
    """Replace the courses of errors in rows by their cosines with those of the first row of the same level and setting.

    They are 1 where the course in time is the same up to a factor, and -1 up to a negative one.
    """
    first = {}
    for row in rows:
        for of, course in row.pop("courses", {}).items():
            other = first.setdefault((of, row["level"], row["method"], str(row["value"])), course)
            sizes = np.linalg.norm(course) * np.linalg.norm(other) if course.shape == other.shape else 0.0
            row[f"{of}_like"] = float(course @ other / sizes) if sizes > 0 else 1.0


def _time(rows):
    """Processor time of each row's call: the shortest of several rounds over all rows."""
    calls = [(row, *row.pop("call")) for row in rows if "call" in row]
    rounds, spent = 0, 0.0
    while calls and (rounds < FEWEST_ROUNDS or spent < ROUNDS_FOR):
        for row, call, *arguments in calls:
            since = time.process_time()
            call(*arguments)
            seconds = time.process_time() - since
            row["seconds"], spent = min(row.get("seconds", np.inf), seconds), spent + seconds
        rounds += 1


def _signal_sizes(run, names, together):
    """Size of each signal: its largest magnitude, at least 1e-3 of the largest of those taken together."""
    if not names:
        return {}
    values = np.array([run[name] for name in names])
    groups = np.array([0 if name in together else i + 1 for i, name in enumerate(names)])
    zero = (np.abs(values).max(axis=1) <= ZERO_SIGNAL * np.abs(values).max()) & (groups > 0)
    return dict(zip(names, np.where(zero, 1.0, component_sizes(values, groups)).tolist(), strict=True))


def _forces(model):
    """Names of the forces and moments that realise the program."""
    return [name for name, group in model.signal_groups.items() if group in ("actuation", "reaction")]


def _failure(error):
    return f"{type(error).__name__}: {error}"


# --- one level


def require_level(name, made, law):
    """A Model, or a pair of a Mechanism or Plant and a Program; anything else is refused."""
    machine, program = made if isinstance(made, (tuple, list)) and len(made) == 2 else (None, None)
    if not isinstance(made, Model) and not (isinstance(machine, (Mechanism, Plant)) and isinstance(program, Program)):
        raise SpecificationError(
            f"The level {name!r} is a {type(made).__name__}.",
            "A level is a Model, a pair (Mechanism, Program) or (Plant, Program), or a function that returns one.",
            do="Give the function that builds the scene.",
            name=name,
            type=type(made).__name__,
        )
    if isinstance(machine, Plant) and law is None:
        raise SpecificationError(
            f"The level {name!r} has a Plant, and no law is given.",
            "A plan is that of the mechanism; what a plant adds, such as lag, friction or limits, acts in a loop.",
            do="Add law=sv.feedforward, or give the mechanism.",
            name=name,
        )
    return made


def as_level(made, arguments, kept):
    """A level from what its function returned; coordinates among the names `kept` are part of its model."""
    if isinstance(made, Model):
        mechanism = made.reduction.mechanism
        return Level(made.including(kept), plant(mechanism.whole or mechanism, **made.numbers), arguments)
    machine, program = made
    machine = machine if isinstance(machine, Plant) else plant(machine)
    mechanism = machine.mechanism
    model = derive(mechanism, program, keep=[name for name in kept if name in mechanism.q.names])
    numbers = dict(zip(mechanism.parameters.names, machine.parameters.tolist(), strict=False))
    return Level(model.with_parameters(**{n: v for n, v in numbers.items() if n in model.numbers}), machine, arguments)


def _plant_at(machine, numbers):
    """The plant with other parameters of its mechanism."""
    names = machine.mechanism.parameters.names
    values = np.array([numbers.get(name, value) for name, value in zip(names, machine.parameters, strict=False)])
    machine.equations.require_inertia(values)
    parameters = np.concatenate([values, machine.parameters[len(values) :]])
    return replace(machine, parameters=parameters, equations=equations_at(machine.equations, values))
