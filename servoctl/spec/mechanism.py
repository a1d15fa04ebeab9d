"""The mechanism: its balance r = ∂S/∂γ'' - Γ, its actuators and its material constraints."""

import itertools
import json
from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from servoctl.checks import by_name, column, distinct, interval, mapping, require_kind
from servoctl.errors import NameUnknown, SpecificationError, unknown
from servoctl.jets.branches import Branches
from servoctl.jets.identity import spread, vanish
from servoctl.jets.overflow import settled
from servoctl.jets.tape import Tape, evaluate
from servoctl.markup import Shown, listed
from servoctl.spec.bodies import lagrange
from servoctl.spec.coordinates import Coordinates, jet_name, require_order, symbols_in
from servoctl.spec.packing import packed, unpacked
from servoctl.spec.parameters import Parameters
from servoctl.spec.shapes import as_shapes
from servoctl.spec.sums import summands, without
from servoctl.tolerances import ENTRY
from servoctl.units import FORCES, rate_unit, units_by_name
from servoctl.values import Identity

IDENTITY_SEED = 20021  # of the random points at which identities are tested
RANDOM = (0.3, 1.3)  # range of these, with parameters in units of their defaults: of order one, and away from zero
INTEGRABLE = 1e-9  # part of the brackets of V's columns outside their span, relative to the largest bracket


class Constraints(dict):
    """Rows by name, and `followers`: rows left out that hold on a branch of these, which a start is on."""

    def __init__(self, rows, followers):
        super().__init__(rows)
        self.followers = followers

    def __or__(self, other):
        return Constraints({**self, **other}, self.followers | getattr(other, "followers", {}))

    def __ror__(self, other):
        return Constraints({**other, **self}, self.followers)


class Mechanism(Shown):
    """A mechanism with forces, actuators and material constraints.

    What bears the name of a coordinate, or of a signal before it, is read by a longer one: slew_input, m1_parameter.

    Main arguments

    Parameters
    ----------
    q : Coordinates
    gibbs : SX, optional
        Gibbs-Appell function S(t, q, γ', γ''), at most quadratic in γ'' (`particle`, `rigid_body`, or written out).
    potential : SX, optional
        Potential energy U(q, t) [J]; gives Γ = -Vᵀ ∂U/∂q.
    actuators : dict of str to SX or sequence, optional
        Each by the displacement it works on (a scalar function of q [m or rad]; input in N or N m), or by a
        generalised direction (a sequence or column of n entries; always a sequence where n = 1).
    parameters : Parameters, optional

    Other arguments

    kinetic : SX, optional
        Kinetic energy T(q, γ') [J], for Lagrange's equations. With `gibbs` as well, both must give the same balance.
    balance : (n,) SX, optional
        The balance itself, r(t, q, γ', γ''), without `forces` and `potential`: inverse dynamics from elsewhere. Its
        mass matrix is symmetric. What is left of it at rest, r(t, q, 0, 0), such as gravity, counts as forces -r;
        energy includes gravity only as `potential`.
    mass : (n, n) SX, optional
        The mass matrix ∂r/∂γ'' of `balance` in a form that takes fewer operations than its derivative does.
    forces : dict of str to SX, or (n,) SX, optional
        Generalised forces by coordinate (or quasi-velocity) name.
    constraints : dict of str to SX, optional
        Material constraints of order 0, 1 or 2, realised by ideal reactions.
    outputs : dict of str to SX, optional
        Named outputs, expressions of t, q and jets.
    shapes : dict of str to sequence of points, optional
        Lines and bodies by which figures show the mechanism (`servoctl.spec.shapes`): points (x, y) or (x, y, z) [m],
        the last axis up, expressions of t, q and the parameters.
    units : dict of str to str, optional
        Units of coordinates, quasi-velocities, actuators, outputs, parameters and "multiplier_NAME" by name, as
        figures, tables, reports and exported C show them. Those of coordinates may be given there; those of rates
        follow, and those of actuators on coordinates, N or N m.
    limits : dict of str to float or (low, high), optional
        What the machine allows of its coordinates, velocities, actuators, outputs and reactions by name, such as
        {"tension": (0, None)} of a rope. `verify` says where a motion is beyond them; nothing is changed for them.

    Raises
    ------
    SpecificationError
        If an expression names a symbol that is no coordinate, parameter or t; if S is not quadratic in γ''; if S
        and T disagree; if there is nothing to take the balance from; if the mass matrix of `balance` is not symmetric,
        or not `mass`; if a coordinate has two units, or a name and its longer form are taken.
    NameUnknown
        If a force names no coordinate, or a unit or a limit nothing of the mechanism.
    """

    def __init__(
        self,
        q,
        gibbs=None,
        potential=None,
        actuators=None,
        parameters=None,
        *,
        kinetic=None,
        balance=None,
        mass=None,
        forces=None,
        constraints=None,
        outputs=None,
        shapes=None,
        units=None,
        limits=None,
    ):
        self.left_out, self.whole = {}, None
        self.q = require_kind(Coordinates, "q", q, 'sv.coordinates("x y")')
        parameters = Parameters({}) if parameters is None else parameters
        self.parameters = require_kind(Parameters, "parameters", parameters, "sv.parameters(m=1.0, ...)")
        self._gibbs = None if gibbs is None else self._known(gibbs, "the Gibbs function")
        self._kinetic = None if kinetic is None else self._known(kinetic, "the kinetic energy")
        n, self._inverse_dynamics = q.n, None if balance is None else self._known(balance, "the balance", q.n)
        self._mass = None if mass is None else ca.reshape(self._known(ca.vec(mass), "the mass matrix", n * n), n, n)
        self.potential = ca.SX(0) if potential is None else self._known(potential, "the potential")
        applied, acceleration = self._forces(forces), ca.vertcat(*q.gamma(2))
        self._applied = self.forces = ca.substitute(applied, acceleration, ca.SX.zeros(n))
        self._added = self._applied - applied if q.order(applied) > 1 else ca.SX(n, 1)  # forces -m q'' are inertia
        self.actuators = tuple(mapping(actuators, "The actuators"))
        self.E = self._directions(actuators or {})
        self.constraints = self._named(constraints, "constraint")
        self.followers = self._named(getattr(constraints, "followers", None), "constraint")
        self.outputs = self._named(outputs, "output")
        self.shapes = as_shapes(shapes, self._known)
        self.inputs, self.reported, self.passive = (), {}, ()
        self._refuse_orders()
        self._keep_names_apart()
        self.units, self.limits = self._units(units), self._limits(limits)
        self._check_balance()
        if self._inverse_dynamics is not None:
            self._refuse_doubled()
            self.forces = self._applied - self._static_forces()

    def __repr__(self):
        lines = [f"Mechanism: {' '.join(self.q.names)}"]
        if not self.q.plain:
            lines.append(f"  quasi-velocities {' '.join(self.q.velocity_names)}")
        for what, names in (
            ("actuators", self.actuators),
            ("material constraints", self.constraints),
            ("outputs", self.outputs),
        ):
            if names:
                lines.append(f"  {what}: {', '.join(names)}")
        if self.longer:
            lines.append(f"  longer names, as other signals have the short ones: {listed(self.longer, 60)}")
        lines.append(f"  {self.parameters!r}"[:118])
        return "\n".join(lines)

    def as_text(self):
        """Names, numbers and expressions as text, which is equal for equal mechanisms alone."""
        q, p = self.q, self.parameters
        names = [q.names, q.velocity_names, q.plain, list(q.invariants), self.actuators, list(self.constraints)]
        expressions = [
            q.V,
            q.h,
            *q.invariants.values(),
            self.balance,
            self.energy,
            self.forces,
            self.E,
            *self.constraints.values(),
            *self.followers.values(),
            *self.outputs.values(),
            *self.shapes.values(),
        ]
        function = q.as_function([*expressions, *self.reported.values()], p.symbols).serialize()
        facts = [names, list(self.outputs), list(self.shapes), self.inputs, list(self.reported)]
        facts += [p.defaults, self.left_out, self.units, self.limits]
        return json.dumps(facts) + "\n" + function

    def __eq__(self, other):
        if type(other) is not type(self):
            return NotImplemented
        return self is other or self.as_text() == other.as_text()

    def __hash__(self):
        return hash((self.q.names, self.actuators, self.parameters.names))

    def __copy__(self):
        """With the same symbols, unlike one that is read back."""
        twin = object.__new__(type(self))
        vars(twin).update(vars(self))
        return twin

    def __reduce__(self):
        content = packed(vars(self) | {"whole": None}, self.q, self.parameters, {"parameters": self.parameters})
        return _restored, (self.q, self.parameters, content)

    def places(self, *expressions):
        """Coordinates and velocities in expressions: a set of ("q", i) and ("w", i)."""
        expressions = (e if e.__class__ is ca.SX else ca.SX(e) for e in expressions)
        found = (self.q.where(s) for e in expressions for s in symbols_in(e))
        return {(place[0], place[2]) for place in found if place is not None and place[0] in "qw"}

    def couplings(self):
        """What is coupled: a list of sets of places, one for each term.

        Terms are those of inertia and potential, the rows of forces and of q' = V w + h, the invariants, the material
        constraints, and the directions of actuators.
        """
        q = self.q
        energies = [e for e in (self._gibbs, self._kinetic, self.potential) if e is not None]
        terms = [self.places(term) for energy in energies for term in summands(energy, self.places)]
        rows = [self._applied, self._added]
        rows += [] if self._inverse_dynamics is None else [self._inverse_dynamics]
        terms += [{("w", i), *self.places(row[i])} for row in rows for i in range(q.n)]
        terms += [{("q", i), *self._along(q.V[i, :].T), *self.places(q.h[i])} for i in range(q.nq)]
        terms += [self.places(e) for e in (*q.invariants.values(), *self.constraints.values())]
        return terms + [self.driven(name) for name in self.actuators]

    def driven(self, actuator):
        """Places that an actuator couples."""
        return self._along(self.E[:, self.actuators.index(actuator)])

    def _along(self, direction):
        """Places of the velocities along a direction (n,), and in its entries."""
        nonzero = zip(direction.row(), direction.nonzeros(), strict=True)
        entries = {i: entry for i, entry in nonzero if not entry.is_zero()}
        return {*(("w", i) for i in entries), *self.places(*entries.values())}

    def part(self, places):
        """The mechanism of some of its coordinates and velocities, to which nothing couples the others.

        Parameters
        ----------
        places : set of ("q", i) and ("w", i)
            Whole unions of `couplings`.

        Returns
        -------
        Mechanism
            With the same symbols and all parameters; `left_out` has the names of the others by kind, `whole` is this
            mechanism until it is pickled.
        """
        return _part(Identity(self), frozenset(places))

    def no(self, what, name, valid):
        """The `NameUnknown` of a name that is not valid; of one that plays no part, how to include it.

        Parameters
        ----------
        what : str
            Kind of the valid names.
        name : str
        valid : sequence of str
        """
        for kind, names in self.left_out.items():
            for other in names:
                coordinates = [other] if kind == "coordinate" else list(self.left_out["coordinate"])
                if name in (f"multiplier_{other}", *(jet_name(other, k, kind == "coordinate") for k in range(8))):
                    return NameUnknown(
                        f"{name!r} belongs to the {kind} {other}, which plays no part in the program.",
                        "A model leaves out what nothing couples to its program.",
                        do=f"Include it: sv.derive(mechanism, program, keep={coordinates}).",
                        name=name,
                        left_out=other,
                    )
        return unknown(name, valid, what)

    def under(self, inputs, forces, reported=None, q=None):
        """The mechanism without actuators, whose inputs are forces and outputs instead.

        Parameters
        ----------
        inputs : dict of str to SX
            By actuator.
        forces : (n,) SX
            Further generalised forces.
        reported : dict of str to SX, optional
            Residuals that runs report: those of a program that the inputs realise approximately.
        q : Coordinates, optional
            The same coordinates with references that only the inputs contain.
        """
        driving = self.E @ ca.vertcat(*(inputs[name] for name in self.actuators)) if self.actuators else 0
        driven = Mechanism(
            q or self.q,
            self._gibbs,
            self.potential,
            None,
            self.parameters,
            kinetic=self._kinetic,
            balance=self._inverse_dynamics,
            mass=self._mass,
            forces=self._applied - self._added + forces + driving,
            constraints=self.constraints,
            outputs={**self.outputs, **inputs},
            shapes={name: ca.horzsplit(points) for name, points in self.shapes.items()},
        )
        driven.inputs, driven.reported = tuple(inputs), driven._named(reported, "residual")
        driven.units, driven.limits = self.units, self.limits
        driven.longer, driven.followers, driven.passive = self.longer, self.followers, self.passive
        return driven

    @property
    def signals(self):
        """Names of what runs read, but for residuals and time derivatives; parameters are none."""
        left_out = (name for kind in ("coordinate", "quasi-velocity") for name in self.left_out.get(kind, ()))
        return ("t", "energy", *self.q.names, *self.q.velocity_names, *left_out, *self.actuators, *self.outputs)

    @cached_property
    def balance(self):
        """r = ∂S/∂γ'' - Γ without actuation, (n,) SX in units of generalised force."""
        if self._inverse_dynamics is not None:
            inertial = self._inverse_dynamics
        elif self._gibbs is not None:
            inertial = ca.gradient(self._gibbs, ca.vertcat(*self.q.gamma(2)))
        else:
            inertial = lagrange(self.q, self._kinetic)
        inertial = inertial + self._added
        return ca.cse(inertial - self._applied + self.q.V.T @ ca.gradient(self.potential, ca.vertcat(*self.q)))

    @cached_property
    def mass(self):
        """The inertia matrix M = ∂r/∂γ'', (n, n) SX, with that of forces which contain accelerations."""
        acceleration = ca.vertcat(*self.q.gamma(2))
        if self._mass is None:
            return ca.jacobian(self.balance, acceleration)
        return self._mass + ca.jacobian(self._added, acceleration)

    @property
    def weight(self):
        """Generalised forces of the potential, and what is left of a given balance at rest, (n,) SX."""
        return self.q.V.T @ ca.gradient(self.potential, ca.vertcat(*self.q)) + self._applied - self.forces

    @cached_property
    def energy(self):
        """Kinetic plus potential energy [J], SX; without a kinetic energy T it is taken as wᵀMw/2."""
        w, acceleration = (ca.vertcat(*self.q.gamma(k)) for k in (1, 2))
        inertia = self.mass if self._kinetic is None else ca.jacobian(self._added, acceleration)
        return ca.dot(w, inertia @ w) / 2 + (0 if self._kinetic is None else self._kinetic) + self.potential

    def _check_balance(self):
        given = {"gibbs": self._gibbs, "kinetic": self._kinetic, "balance": self._inverse_dynamics, "mass": self._mass}
        sources = {name for name, value in given.items() if value is not None}
        if not sources or sources >= {"gibbs", "balance"} or sources & {"mass", "balance"} == {"mass"}:
            raise SpecificationError(
                f"The mechanism has {' and '.join(sorted(sources)) or 'no inertia'}.",
                "Inertia comes from a Gibbs function, a kinetic energy, or a balance, perhaps with its mass matrix.",
                do="Pass gibbs=sv.particle(...) + ..., kinetic=T or balance=r.",
                coordinates=list(self.q.names),
            )
        given = self._gibbs is not None or self._inverse_dynamics is not None
        if self._kinetic is not None and not given and not self.q.plain and self.q.n < self.q.nq:
            self._refuse_nonholonomic_frame()
        acceleration = ca.vertcat(*self.q.gamma(2))
        curvature = ca.jacobian(ca.vec(self.mass), acceleration)
        if curvature.nnz() and not self.is_zero(curvature.nonzeros()):
            raise SpecificationError(
                "The Gibbs function is not quadratic in the accelerations."
                if self._gibbs is not None
                else "The balance is not linear in the accelerations.",
                "S = Σ m a·a/2 is quadratic in γ'', so that ∂S/∂γ'' is linear (3.8).",
                do="Build S by sv.particle and sv.rigid_body, or check the powers of the second derivatives.",
                source="balance" if self._gibbs is None else "gibbs",
            )
        self._refuse_asymmetry()
        if self._kinetic is not None and given:
            w, what = ca.vertcat(*self.q.gamma(1)), "Gibbs function" if self._inverse_dynamics is None else "balance"
            if self._gibbs is not None:
                both = ca.gradient(self._gibbs, acceleration), lagrange(self.q, self._kinetic)
            else:  # a balance may contain other loads
                slopes = ca.gradient(self._kinetic, w)
                both = ca.jtimes(self._inverse_dynamics, acceleration, w), ca.jtimes(slopes, w, w)
            couples = list(zip(*(side.elements() for side in both), strict=True))
            if different := self._different(couples, self.q.jet_names(2)):
                raise SpecificationError(
                    f"The {what} and the kinetic energy give different inertial forces in {', '.join(different)}.",
                    "Both describe the same inertia: ∂S/∂γ'' = Vᵀ(d/dt ∂T/∂q' - ∂T/∂q).",
                    do="Correct one of them, or remove it.",
                    components=different,
                )

    def _refuse_asymmetry(self):
        """Refuse a balance or forces whose mass matrix is not symmetric, and a `mass` that is not the balance's."""
        if self._inverse_dynamics is None and not self._added.nnz():
            return
        names, n = self.q.jet_names(2), self.q.n
        factor = self.q.gamma(2)[0]  # the difference of two constants would be folded, and its rounding has no size
        pairs = list(itertools.combinations(range(n), 2))
        for i, j in self._different([(self.mass[i, j] * factor, self.mass[j, i] * factor) for i, j in pairs], pairs):
            raise SpecificationError(
                f"The balance less forces has {names[j]} in row {i} and {names[i]} in row {j} with different factors.",
                "The mass matrix ∂r/∂γ'' is symmetric where the rows are generalised forces of the coordinates; "
                "kinetic energy and ideal reactions need it.",
                do="Undo combinations of rows, such as a partial linearisation, or pass gibbs= or kinetic=.",
                components=[names[i], names[j]],
            )
        if self._mass is None:
            return
        slope = ca.jacobian(self._inverse_dynamics, ca.vertcat(*self.q.gamma(2)))
        pairs = [*pairs, *((i, i) for i in range(n))]
        for i, j in self._different([(self._mass[i, j] * factor, slope[i, j] * factor) for i, j in pairs], pairs):
            raise SpecificationError(
                f"The mass matrix has another entry ({i}, {j}) than the factor of {names[j]} in the balance.",
                "`mass` is ∂r/∂γ'' of `balance`.",
                do="Correct one of them, or leave out `mass`.",
                components=[names[i], names[j]],
            )

    def _different(self, couples, labels):
        """Labels of the couples of SX scalars that differ at seeded random points by more than rounding."""
        values, sizes = self.at_random([a - b for a, b in couples]) if couples else (np.zeros((0, 4)), 0.0)
        differs = np.any(np.abs(values) > ENTRY * sizes, axis=1)
        return [label for label, other in zip(labels, differs, strict=True) if other]

    def _refuse_doubled(self):
        """Refuse a balance that contains what is passed beside it, at rest or odd in the velocities as damping is."""
        q, speed, acceleration = self.q, *(ca.vertcat(*self.q.gamma(k)) for k in (1, 2))

        def parts(load):
            load = ca.substitute(load, acceleration, ca.SX.zeros(q.n))
            odd = load - ca.substitute(load, speed, -speed)
            return acceleration[0] * ca.vertcat(ca.substitute(load, speed, ca.SX.zeros(q.n)), odd)  # no constant

        loads = self._inverse_dynamics, q.V.T @ ca.gradient(self.potential, ca.vertcat(*q)), -self._applied
        own, gravity, forces = map(parts, loads)
        some = self._different([(e, 0) for e in own.elements()], range(2 * q.n))
        for name, beside in {"potential": gravity, "forces": forces, "potential and forces": gravity + forces}.items():
            other = self._different([(own[i], beside[i]) for i in some], some)
            if rows := sorted({q.force_names[i % q.n] for i in some if i not in other}):
                raise SpecificationError(
                    f"The balance contains the {name} passed beside it, in {', '.join(rows)}.",
                    "`balance` is r without `potential` and `forces`; these would count twice.",
                    do="Leave them out, as with balance=mechanism.balance, or pass the balance without them.",
                    components=rows,
                )

    def _static_forces(self):
        """What a given balance is at rest, such as gravity, (n,) SX; the rest is inertia and has a kinetic energy."""
        motion = ca.vertcat(*self.q.gamma(1), *self.q.gamma(2))
        static = ca.substitute(self._inverse_dynamics, motion, ca.SX.zeros(motion.numel()))
        return ca.SX.zeros(self.q.n) if vanish(spread(static.elements())).all() else ca.cse(static)

    def _refuse_nonholonomic_frame(self):
        """Refuse a kinetic energy in quasi-velocities if brackets of the columns of V lie outside their span."""
        q = ca.vertcat(*self.q)
        columns = ca.horzsplit(self.q.V)
        brackets = [
            ca.jacobian(b, q) @ a - ca.jacobian(a, q) @ b for i, a in enumerate(columns) for b in columns[i + 1 :]
        ]
        items = [*ca.vec(self.q.V).elements(), *(x for b in brackets for x in b.elements())]
        values, _ = self.at_random(items)
        for point in values.T.astype(float):
            v = point[: self.q.V.numel()].reshape(self.q.n, self.q.nq).T
            rest = point[self.q.V.numel() :].reshape(-1, self.q.nq).T
            outside = rest - v @ np.linalg.lstsq(v, rest, rcond=None)[0]
            if np.abs(outside).max(initial=0.0) > INTEGRABLE * max(1.0, np.abs(rest).max(initial=0.0)):
                raise SpecificationError(
                    "The kinetic energy is in quasi-velocities whose frame V is not integrable.",
                    "Lagrange's equations do not hold for velocities restricted by nonholonomic constraints.",
                    do="Use a Gibbs function, which is valid in any quasi-velocities (3.10), or all velocities with "
                    "material constraints.",
                    velocities=list(self.q.velocity_names),
                )

    def is_zero(self, items):
        """Whether SX scalars vanish at seeded random points, up to rounding errors of their terms.

        Parameters
        ----------
        items : sequence of SX scalars
        """
        values, sizes = self.at_random(items)
        return bool(np.all(np.abs(values) <= ENTRY * sizes))

    def at_random(self, items):
        """Values and sizes of expressions at four seeded random points of t, jets and parameters.

        Parameters
        ----------
        items : sequence of SX scalars

        Returns
        -------
        values, sizes : (len(items), 4) arrays
        """
        symbols = ca.symvar(ca.vertcat(*items)) if len(items) else []
        points = np.random.default_rng(IDENTITY_SEED).uniform(*RANDOM, (len(symbols), 4)).astype(np.longdouble)
        for i, s in enumerate(symbols):  # what is zero by default may be set
            points[i] *= self.parameters.defaults.get(self.parameters.name_of(s)) or 1.0
        return evaluate(Tape(symbols, items), points)

    def _known(self, value, what, size=1):
        """An SX scalar or column in symbols of the mechanism."""
        expression = ca.vertcat(*settled(column(value, what, size)))
        require_known(expression, self, what)
        return self.q.on_spheres(expression)

    def _named(self, values, what):
        items = mapping(values, f"The {what}s").items()
        return {name: self._known(value, f"{what} {name!r}") for name, value in items}

    def _forces(self, forces):
        if forces is None:
            return ca.SX.zeros(self.q.n)
        if not isinstance(forces, dict):
            return self._known(forces, "the forces", self.q.n)
        names, total = self.q.force_names, ca.SX.zeros(self.q.n)
        what = "coordinate" if self.q.plain else "quasi-velocity"
        for name, value in by_name(forces, names, what, "The forces").items():
            total[names.index(name)] += self._known(value, f"the force on {name!r}")
        return total

    def _units(self, units):
        """Units by name: those that are given, and those of actuators that follow from their displacements."""
        q = self.q
        names = [*q.names, *(() if q.plain else q.velocity_names), *self.actuators, *self.outputs]
        names += [*self.parameters.names, *(f"multiplier_{name}" for name in self.constraints)]
        given = q.units | units_by_name(units, names, "signal or parameter")
        for name in q.units:
            if given[name] != q.units[name]:
                raise SpecificationError(
                    f"{name!r} has the units {q.units[name]!r} and {given[name]!r}.",
                    "A coordinate or a quasi-velocity has one unit.",
                    do="Give it in sv.coordinates(..., units=...) or in Mechanism(units=...).",
                    name=name,
                    units=(q.units[name], given[name]),
                )
        rates = [rate_unit(given.get(name, "")) if q.plain else given.get(name, "") for name in q.force_names]
        efforts = {name: _unit_along(self.E[:, i], rates) for i, name in enumerate(self.actuators)}
        return {name: unit for name, unit in efforts.items() if unit} | given

    def _limits(self, limits):
        """(low, high) by name."""
        names = [*self.signals, *(f"multiplier_{name}" for name in self.constraints)]
        return {n: interval(n, c, "limit") for n, c in by_name(limits, names, "signal", "The limits").items()}

    def _directions(self, actuators):
        columns = []
        for name, value in actuators.items():
            items, what = column(value, f"actuator {name!r}"), f"the displacement of {name!r}"
            direction = isinstance(value, (list, tuple, np.ndarray)) or len(items) != 1
            if direction:
                what = f"the direction of {name!r} along {', '.join(self.q.velocity_names)}"
            expression = self._known(items, what, self.q.n if direction else 1)
            require_order(self.q, expression, what, 0)
            if not direction and self.q.order(expression) < 0:
                raise SpecificationError(
                    f"The displacement of {name!r} depends on no coordinate.",
                    "An actuator works on a displacement, or along a direction of n entries.",
                    do="Use a function of q, or a sequence.",
                    name=name,
                )
            columns.append(expression if direction else self.q.V.T @ ca.gradient(expression, self.q.jet(0)))
        return ca.horzcat(*columns) if columns else ca.SX(self.q.n, 0)

    def _refuse_orders(self):
        for what, items, limit in (
            ("The potential", {"": self.potential}, 0),
            ("The kinetic energy", {"": self._kinetic}, 1),
            ("The Gibbs function", {"": self._gibbs}, 2),
            ("The balance", {"": self._inverse_dynamics}, 2),
            ("The forces", {"": self.forces - self._added}, 2),
            ("The material constraint", self.constraints, 2),
            ("The shape", self.shapes, 0),
        ):
            for name, expression in items.items():
                if expression is not None:
                    require_order(self.q, expression, f"{what}{f' {name!r}' if name else ''}", limit)

    def _keep_names_apart(self):
        """Give longer names to actuators, outputs and parameters that bear the name of a signal before them."""
        before = ("t", "energy", *self.q.names, *self.q.velocity_names)
        actuators = distinct("actuator", self.actuators, before, self.actuators)
        outputs = distinct("output", self.outputs, (*before, *actuators.values()), self.outputs)
        self.actuators, self.outputs = tuple(actuators.values()), {outputs[n]: e for n, e in self.outputs.items()}
        parameters = distinct("parameter", self.parameters.names, self.signals)
        self.parameters = self.parameters.renamed(parameters)
        read = [*actuators.items(), *outputs.items(), *parameters.items()]
        self.longer = tuple(long for name, long in read if long != name)


@lru_cache(32)
def _part(identity, places):
    whole = identity.value
    q, part = whole.q, object.__new__(Mechanism)
    coordinates, velocities = ([i for i in range(n) if (kind, i) in places] for kind, n in (("q", q.nq), ("w", q.n)))
    columns = [j for j, name in enumerate(whole.actuators) if whole.driven(name) <= places]

    def rows(vector):
        return None if vector is None else vector[velocities]

    def terms(energy):
        return None if energy is None else without(energy, whole.places, lambda e: not whole.places(e) <= places)

    part.q, part.parameters = q.part(coordinates, velocities), whole.parameters
    part._gibbs, part._kinetic, part.potential = map(terms, (whole._gibbs, whole._kinetic, whole.potential))
    part._inverse_dynamics, part._applied, part._added, part.forces = map(
        rows, (whole._inverse_dynamics, whole._applied, whole._added, whole.forces)
    )
    part._mass = None if whole._mass is None else whole._mass[velocities, velocities]
    part.actuators, part.E = tuple(whole.actuators[j] for j in columns), whole.E[velocities, columns]
    part.constraints, part.followers = (
        {name: e for name, e in rows.items() if whole.places(e) <= places}
        for rows in (whole.constraints, whole.followers)
    )
    part.outputs, part.inputs, part.reported = whole.outputs, whole.inputs, whole.reported
    part.passive = whole.passive
    part.shapes = {name: e for name, e in whole.shapes.items() if whole.places(e) <= places}
    part.units, part.limits, part.longer = whole.units, whole.limits, whole.longer
    groups = {
        "coordinate": (q.names, part.q.names),
        "quasi-velocity": ((), ()) if q.plain else (q.velocity_names, part.q.velocity_names),
        "actuator": (whole.actuators, part.actuators),
        "material constraint": (whole.constraints, part.constraints),
    }
    part.whole = whole
    part.left_out = {what: tuple(n for n in names if n not in kept) for what, (names, kept) in groups.items()}
    return part


def _unit_along(direction, rates):
    """Unit of an actuator along a direction, "" unless that adds or subtracts velocities of one unit."""
    entries = [(rate, entry) for rate, entry in zip(rates, direction.elements(), strict=True) if not entry.is_zero()]
    if not all(entry.is_constant() and abs(float(entry)) == 1 for _, entry in entries):
        return ""
    along = {rate for rate, _ in entries}
    return FORCES.get(along.pop(), "") if len(along) == 1 else ""


def _restored(q, parameters, content):
    mechanism = object.__new__(Mechanism)
    vars(mechanism).update(unpacked(content, q, parameters, {"parameters": parameters}))
    return _latest(mechanism, tuple(q.family.paths.items()))


@lru_cache(32)
def _latest(mechanism, references):
    """The first of equal mechanisms from other processes, so that models derived from it are shared.

    Its coordinates have the same references with the same paths.
    """
    return mechanism


def inverse_directions(E):
    """E⁻¹, (n, n) DM, where each velocity has an actuator along a constant direction; else None.

    Parameters
    ----------
    E : (n, m) SX
        Directions of the actuators.
    """
    if E.shape[0] != E.shape[1] or not E.is_constant():
        return None
    numbers = np.array(ca.evalf(E))
    return ca.DM(np.linalg.inv(numbers)) if np.linalg.matrix_rank(numbers) == len(numbers) else None


def require_no_switch(expression, q, what):
    """Refuse an operation with branches that the time alone decides: what comes from data has its instants, too."""
    if not ca.depends_on(expression, q.t):
        return
    branches = Branches(lambda symbol: q.where(symbol) == q.where(q.t))
    branches.smooth(ca.SX(expression).elements())
    for switch in branches.switches:
        if not any(map(q.moves, ca.symvar(switch.function))):
            raise SpecificationError(
                f"A switch in {what[0].lower()}{what[1:]} is decided by the time alone, where {switch.text}.",
                "Formulas of q.t are smooth; a signal that switches is a path, which knows its instants.",
                do="Write r = q.references(r=first.then(second)).r with paths of sv.paths in place of "
                "if_else(q.t < ..., ...), or sv.paths.polynomials(breaks, coefficients) in place of fmin and fmax.",
                what=what,
                switch=switch.text,
            )


def require_known(expression, mechanism, what):
    """Refuse a symbol that is no coordinate, jet, parameter or t of the mechanism, and a switch in t alone."""
    q, known = mechanism.q, {s.element_hash() for s in mechanism.parameters.symbols}
    require_no_switch(expression, q, what)
    for s in ca.symvar(expression):
        if q.where(s) is None and s.element_hash() not in known:
            if (error := mechanism.no("symbol", s.name(), ())).details.get("left_out"):
                raise error
            names = ["t", *q.names, *q.jet_names(1), *q.jet_names(2), *mechanism.parameters.names]
            hint = unknown(s.name(), names, "symbol")
            raise SpecificationError(
                f"{what} depends on the symbol {s.name()!r}"
                + (", which has the name of a known symbol but is another one." if s.name() in names else "."),
                "Symbols are the coordinates, their derivatives, the parameters and t.",
                nearest=f"{hint.details['match']!r}." if hint.details.get("match") else "",
                do="Use the symbols of sv.coordinates and pass parameters=sv.parameters(...) to the mechanism.",
                name=s.name(),
            )
