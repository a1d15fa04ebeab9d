"""The plant: the full mechanism with its parameters, friction, actuators and their limits."""

from dataclasses import field, fields, replace
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import (
    array_of,
    as_numbers,
    by_name,
    column,
    finite,
    interval,
    mapping,
    named,
    numbers_by_name,
    require_kind,
)
from servoctl.codegen.function import compiled
from servoctl.codegen.paths import Followed
from servoctl.errors import SpecificationError
from servoctl.jets.overflow import settled
from servoctl.markup import Shown
from servoctl.plants.equations import PlantEquations, equations_at, plant_equations
from servoctl.reduction.manifold import references_at
from servoctl.spec.mechanism import Mechanism, require_known
from servoctl.spec.references import other_paths, paths_at, require_fixed, required_paths
from servoctl.values import Value, frozen

UNSOLVED = 1e-7  # of the terms of a plant's equations: rates that leave more have lost half their digits to weak pivots


def plant(
    mechanism: Mechanism,
    *,
    forces=None,
    damping=None,
    limits=None,
    rate_limits=None,
    lag=None,
    delay=0.0,
    **parameters: float,
) -> "Plant":
    """Make the plant of a mechanism: the machine that a controller acts on.

    Plants of the same mechanism and forces share their equations, so that other numbers take no time, unless with these
    a material constraint has another order or a pivot vanishes.

    Parameters
    ----------
    mechanism : Mechanism
    forces : dict of str to SX, optional
        Further generalised forces, friction among them, by coordinate (or quasi-velocity) [N or N m]: expressions of
        t, q, γ' and the parameters.
    damping : dict of str to float, optional
        Viscous coefficients by coordinate (or quasi-velocity) [N s/m or N m s].
    limits : dict of str to float or (low, high), optional
        Limits of the actuators' inputs. A number c means (-c, c); None leaves a side open.
    rate_limits : dict of str to float, optional
        Largest |du/dt| of the inputs [1/s]. From sample to sample an input changes at most by this times the period.
    lag : dict of str to float, optional
        Time constants [s] of actuators that follow their input with first order. Each adds a state to the plant.
    delay : float or dict of str to float
        Transport delay of all or of named inputs [s].
    **parameters : float
        Parameters of the mechanism that differ from their defaults, SI.

    Returns
    -------
    Plant

    Raises
    ------
    NameUnknown
        For a name that is no parameter, actuator or coordinate.
    SpecificationError
        For a value outside its range, or a mass matrix that is not positive definite.
    """
    require_kind(Mechanism, "mechanism", mechanism, "sv.Mechanism(q, gibbs, ...)")
    return _made(mechanism, parameters, forces, damping, limits, rate_limits, lag, delay)


def _made(mechanism, parameters, forces, damping, limits=None, rate_limits=None, lag=None, delay=0.0):
    """As `plant`, with the parameters by name, which may be those of its options."""
    actuators = mechanism.actuators
    names = mechanism.q.force_names
    values = mechanism.parameters.values(parameters)
    damping = numbers_by_name(damping, names, "coordinate", "damping", low=0.0)
    lag = numbers_by_name(lag, actuators, "actuator", "lag", positive=True)
    rate_limits = numbers_by_name(rate_limits, actuators, "actuator", "rate limit", positive=True)
    if not isinstance(delay, dict):
        delay = dict.fromkeys(actuators, delay) if finite("delay", delay, "time") else {}
    delay = numbers_by_name(delay, actuators, "actuator", "delay", low=0.0)
    damped = tuple(i for i, name in enumerate(names) if name in damping)
    lagged = tuple(i for i, name in enumerate(actuators) if name in lag)
    equations = plant_equations(mechanism, _forces(mechanism, forces, names), damped, lagged, None)
    equations.require_inertia(values)
    equations = equations_at(equations, values)
    rates = [1.0 / lag[actuators[i]] for i in lagged]
    numbers = np.concatenate([values, [damping[names[i]] for i in damped], rates])
    state_names = (*mechanism.q.names, *mechanism.q.jet_names(1), *(actuators[i] for i in lagged))
    return Plant(
        mechanism,
        numbers,
        state_names,
        actuators,
        tuple(names),
        _limits(limits, actuators, mechanism.passive),
        rate_limits,
        lag,
        {n: d for n, d in delay.items() if d},
        damping,
        {name: mechanism.q.family.paths[name] for name in equations.references},
        equations,
    )


def part_of(whole, mechanism):
    """The plant of a mechanism that `derive` left coordinates out of, with the numbers of the whole one.

    The whole plant, if it has no more coordinates, or if its forces couple them to those left out.
    """
    source, q = whole.mechanism, mechanism.q
    if not mechanism.left_out or source.q.names == q.names:
        return whole
    kinds = (("q", source.q.names, q.names), ("w", source.q.velocity_names, q.velocity_names))
    places = {(kind, i) for kind, names, kept in kinds for i, name in enumerate(names) if name in kept}
    rows = [{("w", i), *source.places(force)} for i, force in enumerate(whole.equations.forces.elements())]
    if any(row & places and not row <= places for row in (*source.couplings(), *rows)):
        return whole
    part, by_actuator = source.part(places), ("limits", "rate_limits", "lag", "delay")
    numbers = {what: {n: v for n, v in getattr(whole, what).items() if n in part.actuators} for what in by_actuator}
    return made_again(whole, part, **numbers)


def made_again(whole, mechanism, **of_actuators):
    """The plant of a mechanism with the forces, damping and parameters of a whole one."""
    forces = dict(zip(whole.disturbable, whole.equations.forces.elements(), strict=True))
    again = _made(
        mechanism,
        dict(zip(mechanism.parameters.names, whole.parameters.tolist(), strict=False)),
        {name: forces[name] for name in mechanism.q.force_names if not forces[name].is_zero()},
        {name: c for name, c in whole.damping.items() if name in mechanism.q.force_names},
        **of_actuators,
    )
    return again.with_references(**{name: whole.paths[name] for name in again.paths})


def refuse_references(plant, what):
    """Refuse a plant whose own equations contain references; `what` begins the rule: "The identification is"."""
    if plant.paths:
        raise SpecificationError(
            f"The equations of the plant contain the references {', '.join(plant.paths)}.",
            f"{what} that of a plant whose equations contain t, its states, inputs and parameters alone.",
            do="Write formulas of q.t in the mechanism instead.",
            references=tuple(plant.paths),
        )


@frozen(eq=False)
class Plant(Value, Shown):
    """The full mechanism under actuator inputs and disturbances, material constraints held; made by `plant`.

    Attributes
    ----------
    mechanism : Mechanism
    parameters : (n_c,) array
        The mechanism's parameters, damping coefficients, 1/lag.
    state_names : tuple of str
        Names of the state x = (q, γ', lagged inputs).
    inputs : tuple of str
        Names of the actuators.
    disturbable : tuple of str
        Names of the generalised forces that disturbances can act on: of the coordinates or quasi-velocities.
    limits : dict of str to (float, float)
    rate_limits, lag, delay, damping : dict of str to float
    paths : dict of str to Path
        Paths of the references in the mechanism's own equations, such as those of a moving support or of the wind.
    """

    mechanism: Mechanism
    parameters: np.ndarray
    state_names: tuple
    inputs: tuple
    disturbable: tuple
    limits: dict
    rate_limits: dict
    lag: dict
    delay: dict
    damping: dict
    paths: dict
    equations: PlantEquations = field(repr=False, compare=False)

    def __post_init__(self):
        self.__dict__["paths"] = paths_at(self.paths, self.mechanism.parameters, self.parameters)

    def __eq__(self, other):
        return super().__eq__(other) and self.equations.choices == other.equations.choices

    __hash__ = Value.__hash__

    def __reduce__(self):
        numbers = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "equations"}
        return _unpickled, (numbers, self.equations.choices)

    @property
    def n_x(self):
        """The number of states."""
        return len(self.state_names)

    @property
    def lagged(self):
        """Names of the actuators with a lag, in the order of the state."""
        return self.state_names[self.n_x - len(self.lag) :]

    @property
    def constrained(self):
        """Whether the state has invariants: material constraints or those of the kinematics."""
        return self.equations.constrained

    def with_references(self, **paths) -> "Plant":
        """The same plant along other paths of the references in its own equations; nothing is derived.

        Parameters
        ----------
        **paths : Path
            Of one component each, by the names of the references; what SciPy makes is one, too.

        Returns
        -------
        Plant

        Raises
        ------
        NameUnknown
            For a name that is no reference of the mechanism's equations.
        SpecificationError
            For what is no path of one component.
        """
        return replace(self, paths=other_paths(self.paths, paths))

    @cached_property
    def _followed(self):
        return Followed([path.held() for path in required_paths(self.paths).values()])

    @property
    def place(self):
        """The place in memory of the paths that are followed, at which p begins: (1,), or (0,) without references."""
        return np.array([self._followed.address] if self.paths else [])

    @property
    def at_u(self):
        """The index of the first input in p."""
        return bool(self.paths) + len(self.parameters)

    def p(self, u=None, d=None):
        """The vector p of the plant's functions: place of the paths, if any, parameters, inputs u and disturbances d.

        Parameters
        ----------
        u : (m,) or (m, N) array, optional
            Inputs; default 0.
        d : (n,) array, optional
            Disturbances by generalised force; default 0.

        Returns
        -------
        (n_p,) or (n_p, N) array
        """
        m, n = len(self.inputs), len(self.disturbable)
        u = np.zeros(m) if u is None else as_numbers(u)
        d = np.zeros(n) if d is None else array_of("d", d, n)
        if u.ndim != 2 or len(u) != m:
            return np.concatenate([self.place, self.parameters, array_of("u", u, m), d])
        fixed = np.append(self.place, self.parameters)
        fixed, d = (np.repeat(part[:, None], u.shape[1], axis=1) for part in (fixed, d))
        return np.concatenate([fixed, u, d])  # u is NaN where a motion ended

    def disturbed(self, name):
        """The index in p of what a disturbance acts on.

        Parameters
        ----------
        name : str
            A generalised force, or a parameter that enters forces only, such as the speed of the wind: a disturbance
            is then its value.

        Returns
        -------
        int

        Raises
        ------
        NameUnknown
            If the plant has neither.
        SpecificationError
            For a parameter of inertia, kinematics, constraints or paths, whose rate of change would act as well.
        """
        parameters = self.mechanism.parameters
        if name in self.disturbable:
            return self.at_u + len(self.inputs) + self.disturbable.index(name)
        if name not in parameters.names:
            raise self.mechanism.no("generalised force or parameter", name, (*self.disturbable, *parameters.names))
        require_fixed(self.paths, parameters, [name], "Disturbances change")
        m, place = self.mechanism, parameters.names.index(name)
        kinds = {
            "the inertia": ca.vec(m.mass),
            "the kinematics": ca.vertcat(ca.vec(m.q.V), m.q.h, *m.q.invariants.values()),
            "the material constraints": ca.vertcat(ca.SX(0, 1), *m.constraints.values()),
        }
        for what, expression in kinds.items():
            if ca.depends_on(expression, parameters.symbols[place]):
                raise SpecificationError(
                    f"The parameter {name!r} is disturbed, and {what} depend{'s' * (what[-1] == 'a')} on it.",
                    "A parameter that is a function of time enters forces only; elsewhere its rate of change acts too.",
                    do="Describe it as a coordinate that is driven, or as a function of t in the mechanism.",
                    name=name,
                    where=what,
                )
        return bool(self.paths) + place

    def function(self, name):
        """One of the plant's compiled functions of (t, x, p), built at first use.

        Parameters
        ----------
        name : str
            "ode", "ode_power", "jacobian", "directions", "power", "accelerations", "outputs", "multipliers",
            "constraints", "constraints_jacobian", "full" or "project".

        Returns
        -------
        Compiled
        """
        named(name, FUNCTIONS, "function")
        functions = self.equations.functions
        if name not in functions:
            f, *options = FUNCTIONS[name](self.equations)
            functions[name] = compiled(f, f.name(), *options)
        return functions[name]

    def constraint_names(self):
        """Names of the invariants in the order of the function "constraints"."""
        return self.equations.constraints()[0]

    def rates(self, t, x, u, d=None) -> np.ndarray:
        """The rates x' at one point.

        Parameters
        ----------
        t : float
            [s]
        x : (n_x,) array
        u : (m,) array
        d : (n,) array, optional

        Returns
        -------
        (n_x,) array
        """
        t, x = finite("t", t, "time"), array_of("x", x, self.n_x)
        p = self.p(array_of("u", u, len(self.inputs)), d)
        return self.sound_at(t, x, p).function("ode")(t, x, p)

    def linearised(self, t, x, u):
        """A = ∂x'/∂x and B = ∂x'/∂u at points.

        Parameters
        ----------
        t : (N,) array
            [s]
        x : (n_x, N) array
        u : (m, N) array

        Returns
        -------
        A : (N, n_x, n_x) array
        B : (N, n_x, m) array
        """
        t = array_of("t", np.atleast_1d(as_numbers(t)), None)
        x, u = array_of("x", x, self.n_x, len(t)), array_of("u", u, len(self.inputs), len(t))
        p = self.p(u)
        y, weak = self.function("jacobian").grid(t, x, p), ~self._sound(t, x, p)
        while weak.any():
            k = int(np.argmax(weak))
            other = self.near(t[k], x[:, k])
            sound = weak & other._sound(t, x, p)
            sound = sound if sound[k] else weak  # no pivots are strong there, and others are not asked for
            y[:, sound], weak = other.function("jacobian").grid(t[sound], x[:, sound], p[:, sound]), weak & ~sound
        both = y.reshape(-1, self.n_x, len(t)).transpose(2, 1, 0)
        return both[:, :, : self.n_x], both[:, :, self.n_x :]

    def sound_at(self, t, x, p):
        """The plant, or that with the pivots `near` a state where its own are too weak to solve its equations.

        Parameters
        ----------
        t : float
            [s]
        x : (n_x,) array
        p : (n_p,) array
            As `p` gives them.
        """
        return self if self._sound(np.array([t]), x[:, None], p[:, None])[0] else self.near(t, x)

    def _sound(self, t, x, p):
        """Where the pivots of a plant with constraints are strong enough to solve its equations, at points (N,)."""
        if not self.mechanism.constraints:
            return np.ones(len(t), dtype=bool)
        return self.function("unsolved").grid(t, x, p)[0] <= UNSOLVED

    def near(self, t: float, x) -> "Plant":
        """The plant whose pivots are decided near a state, where those decided elsewhere vanish.

        Pivots that were decided near another state are taken where they do not vanish at this one.

        Parameters
        ----------
        t : float
            [s]
        x : (n_x,) array
        """
        others, place = self.equations.others, (np.array([t]), x[:, None], self.p()[:, None])
        for equations in others:
            plant = replace(self, equations=equations)
            if plant._sound(*place)[0]:
                return plant
        followed = references_at(self.paths, t)
        others.append(self.equations.near(t, x, self.parameters[: len(self.equations.values)], followed))
        return replace(self, equations=others[-1])

    def state(self, values) -> np.ndarray:
        """A full state: an array of (q, γ') or of all states, or values by name.

        Lagged inputs without a value are NaN: `close` starts them at the first input.

        Parameters
        ----------
        values : array, dict of str to float, or a consistent start

        Returns
        -------
        (n_x,) array

        Raises
        ------
        SpecificationError
            If entries are missing, too many or not finite.
        """
        names, n = self.state_names, self.n_x - len(self.lag)
        values = getattr(values, "values", values) if not isinstance(values, dict) else values
        if isinstance(values, dict):
            for name in values:
                named(name, names, "state")
            missing = [name for name in names[:n] if name not in values]
            if missing:
                raise SpecificationError(
                    f"The state has no {missing[0]}.",
                    f"A state of this plant has the values {', '.join(names[:n])}.",
                    do=f"Add {', '.join(missing)}.",
                    missing=missing,
                )
            return np.array([finite(k, values[k], "state") if k in values else np.nan for k in names])
        state = as_numbers(values).ravel()
        if state.size not in (n, self.n_x) or not np.isfinite(state).all():
            raise SpecificationError(
                f"The state is {np.array2string(state, threshold=8)}.",
                f"A state of this plant is {n} finite numbers: {', '.join(names[:n])}"
                + (f"; or {self.n_x}, with the inputs {', '.join(names[n:])}." if self.lag else "."),
                do="Pass one finite number for each, such as plan.state(0.0).",
                names=names,
                size=state.size,
            )
        return np.concatenate([state, np.full(self.n_x - state.size, np.nan)])

    def __repr__(self):
        names, defaults = self.mechanism.parameters.names, self.mechanism.parameters.defaults
        numbers = zip(names, self.parameters, strict=False)  # damping and lag follow the parameters
        entries = {
            "Plant: state ": " ".join(self.state_names),
            "  inputs ": ", ".join(self.inputs) or "(none)",
            "  material constraints: ": ", ".join(self.mechanism.constraints),
            "  follows ": ", ".join(self.paths),
            "  changed: ": ", ".join(f"{n}={v:g}" for n, v in numbers if v != defaults[n]),
            "  limits: ": ", ".join(f"{n} {a:g} .. {b:g}" for n, (a, b) in self.limits.items()),
            "  rate limits [1/s]: ": _text(self.rate_limits),
            "  lag [s]: ": _text(self.lag),
            "  delay [s]: ": _text(self.delay),
            "  damping: ": _text(self.damping),
        }
        return "\n".join(f"{what}{text}"[:118] for what, text in entries.items() if text)


def _text(values):
    return ", ".join(f"{name} {value:g}" for name, value in values.items())


def _limits(limits, actuators, passive):
    limits = {name: value for name, value in mapping(limits, "The limits").items() if name not in passive}
    limits = by_name(limits, actuators, "actuator", "The limits")
    return {name: interval(name, value, "limit") for name, value in limits.items()}


def _forces(mechanism, forces, names):
    """Further generalised forces (n,) as a serialised function; "" for none."""
    q, total = mechanism.q, ca.SX.zeros(mechanism.q.n)
    for name, value in mapping(forces, "The forces").items():
        named(name, names, "coordinate" if q.plain else "quasi-velocity")
        (expression,) = settled(column(value, f"the force on {name!r}", 1))
        require_known(expression, mechanism, f"the force on {name!r}")
        if q.order(expression) > 1:
            raise SpecificationError(
                f"The force on {name!r} depends on accelerations.",
                "Forces of a plant are functions of t, q and γ'.",
                do="Describe it as a mass in the Gibbs function of the mechanism.",
                name=name,
            )
        total[names.index(name)] = expression
    return "" if total.is_zero() else q.as_function([total], mechanism.parameters.symbols).serialize()


def _unpickled(numbers, choices):
    return Plant(**numbers, equations=plant_equations(numbers["mechanism"], *choices))


FUNCTIONS = {  # arguments of `compiled`: the function, its loops, its projection
    "ode": lambda e: (e.ode(), ("closed",), e.project()),
    "ode_power": lambda e: (e.ode_power(), ("closed",), e.project(extra=1)),
    "jacobian": lambda e: (e.jacobian(),),
    "directions": lambda e: (e.directions(),),
    "power": lambda e: (e.power(),),
    "accelerations": lambda e: (e.accelerations(),),
    "outputs": lambda e: (e.outputs(),),
    "multipliers": lambda e: (e.reactions(),),
    "unsolved": lambda e: (e.unsolved(),),
    "constraints": lambda e: (e.constraints()[1],),
    "full": lambda e: (e.full(),),
    "project": lambda e: (e.project(),),
    "constraints_jacobian": lambda e: (e.constraints_jacobian(),),
}
