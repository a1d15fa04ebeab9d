"""The functions of a motion as SX expressions, each built at its first use."""

from functools import cached_property, reduce

import casadi as ca
import numpy as np

from servoctl.checks import distinct
from servoctl.codegen.paths import combined
from servoctl.errors import SpecificationError
from servoctl.jets.branches import size_of_terms, sizes_of_terms
from servoctl.model import saddle
from servoctl.reduction.range_space import RangeSpace, applies
from servoctl.reduction.ranks import clean, column_sizes, eliminate
from servoctl.reduction.rows import row_levels
from servoctl.spec.coordinates import jet_name
from servoctl.spec.references import called, function_of


class Invariants:
    """Invariants of the state X = (q, γ', ..., γ^(s̄-1)): the rows and those of their derivatives without γ^(s̄).

    `top` is s̄. Pivots are chosen at `points` of the manifold of the rows; a `cascade` has the rows by blocks.
    `references` are names of those that the model follows.
    """

    def __init__(self, mechanism, rows, top, points, cascade=None, references=()):
        self.mechanism, self.rows, self.top, self.points, self.references = mechanism, rows, top, points, references
        self.cascade, self._motions = cascade, {}
        q = self.q = mechanism.q
        self.state = ca.vertcat(*q, *(s for k in range(1, top) for s in q.gamma(k)))
        self.parameters = ca.vertcat(*mechanism.parameters.symbols)
        self.raised = [top - row.order for row in rows]

    @cached_property
    def levels(self):
        """For each row its total time derivatives of orders 0 .. s̄ - o_a."""
        if self.cascade is not None:
            return [
                [self._along(row.order + j).levels[a] for j in range(count + 1)]
                for a, (row, count) in enumerate(zip(self.rows, self.raised, strict=True))
            ]
        return row_levels(self.q, self.rows, self.top)

    def _along(self, given, correct=False):
        """The motion of the cascade by its jets up to a given level."""
        if (given, correct) not in self._motions:
            self._motions[given, correct] = self.cascade.along(self.points, given, max(given, self.top), correct)
        return self._motions[given, correct]

    def function(self, name, x, outputs, extra=None, jets="r", rates=()):
        """An SX function of (t, x, p) with one dense column; see `references.function_of`.

        `rates` are pairs (reference, parameter) of derivatives that it takes behind the references.
        """
        p = self.parameters if extra is None else ca.vertcat(self.parameters, extra)
        y = ca.densify(ca.cse(ca.vertcat(*outputs)))
        return function_of(self.q, (*self.references, *rates), name, x, p, y, jets=jets)

    def called(self, f, x, p):
        """The output of one of the model's functions as an expression; see `references.called`."""
        return called(self.q, self.references, f, x, p)

    @cached_property
    def invariant_rows(self):
        """(level, name, SX) of each invariant: ψ_a^(j) for j < s̄ - o_a, and the invariants of the kinematics."""
        rows = [(0, name, e) for name, e in self.q.invariants.items()]
        for row, level in zip(self.rows, self.levels, strict=True):
            rows += [(row.order + j, _level_name(row.name, j), e) for j, e in enumerate(level[:-1])]
        return sorted(rows, key=lambda item: item[0])

    def invariants(self):
        """Outputs (values, Jacobian in X column by column) of the invariants."""
        values = ca.vertcat(*(e for _, _, e in self.invariant_rows))
        return self.function("invariants", self.state, [values, ca.vec(ca.densify(ca.jacobian(values, self.state)))])

    def project(self):
        """The change of the state, least in the metric M (δq = V δγ), that restores the invariants level by level."""
        q, mass, changes = self.q, self.mechanism.mass, []
        for level in range(self.top):
            rows = [a for a, row in enumerate(self.rows) if row.order <= level]
            values = ca.vertcat(*(self.levels[a][level - self.rows[a].order] for a in rows))
            change = ca.SX.zeros(q.n)
            if rows:
                J = self.slopes(rows, values, level)
                saddle = ca.vertcat(ca.horzcat(mass, J.T), ca.horzcat(J, ca.SX.zeros(len(rows), len(rows))))
                numbers = clean(*self.points.matrix(saddle))
                change = eliminate(saddle, ca.vertcat(ca.SX.zeros(q.n), -values), numbers)[0][: q.n]
            if level == 0 and not q.plain:
                change = q.V @ change + self._restore_kinematics()
            changes.append(change)
        return self.function("project", self.state, changes)

    def slopes(self, rows, values, level):
        """∂/∂γ^(level), or ∂/∂q V, of the values of rows at their derivatives of this level."""
        if self.cascade is None:
            return ca.vertcat(*(self.rows[a].gradient(self.q) for a in rows))
        slopes = ca.jacobian(values, self.q.jet(level))
        return slopes if level else slopes @ self.q.V

    def _restore_kinematics(self):
        """The least change of q that restores the invariants of the kinematics."""
        q = self.q
        if not q.invariants:
            return ca.SX.zeros(q.nq)
        c = ca.vertcat(*q.invariants.values())
        J = ca.jacobian(c, q.jet(0))
        return J.T @ eliminate(J @ J.T, -c, clean(*self.points.matrix(J @ J.T)))[0]


class Equations(Invariants):
    """Expressions of a reduction, in the state X and the jets Z = (X, γ^(s̄))."""

    def __init__(self, reduction):
        r = self.r = reduction
        super().__init__(r.mechanism, r.rows, r.top, r.points, r.cascade, r.references)
        self.jets = ca.vertcat(self.state, *self.q.gamma(self.top))
        self.coefficients = [
            [ca.SX.sym(f"c{a}_{j}") for j in range(count)] for a, count in enumerate(self.raised)
        ]  # of the error dynamics of each row

    def _solve(self, right):
        """L⁻¹ right and the pivots of L."""
        return self.r.solve(right)

    @property
    def sparse(self):
        """Whether the sparse elimination of [M -B; G 0] gives γ^(s̄), instead of the rows of (3.18).

        The rows of a flat program are constraints alone: they give γ^(s̄) without the inertia.
        """
        many = not self.r.orthogonal and self.r.free > 0 and self.q.n > saddle.FEW
        return self.range_space or (many and applies(self.r))

    @property
    def range_space(self):
        """Whether the inertia is eliminated first."""
        return isinstance(self.r.realisation, RangeSpace)

    @cached_property
    def saddle(self):
        """γ'', μ and the pivots of [M -B; G 0]."""
        return saddle.solve(self)

    @cached_property
    def _leading(self):
        """The pivots of L."""
        if self.cascade is not None:
            return self._along(self.top - 1 if self.r.free else 0).pivots
        return self._solve(ca.SX(self.q.n, 0))[1]

    def rest(self, rows, poles=False):
        """Some rows raised to order s̄, at γ^(s̄) = 0; with their error dynamics if `poles`."""
        raised = ca.vertcat(ca.SX(0, 1), *(self.levels[a][-1] for a in rows))
        rests = ca.substitute(raised, self.q.jet(self.top), ca.SX.zeros(self.q.n)).elements()
        if not poles:
            return rests
        errors = (zip(self.coefficients[a], self.levels[a][:-1], strict=True) for a in rows)
        return [row + sum(c * e for c, e in pairs) for row, pairs in zip(rests, errors, strict=True)]

    def dense(self, poles=False):
        """γ^(s̄) from the rows, L γ^(s̄) = -rest."""
        if self.cascade is not None:
            return self._along(self.top - 1).jet(self.top) if not poles else self._by_blocks_with_poles()
        return self._solve(-ca.vertcat(*self.rest(range(len(self.levels)), poles)))[0]

    def _by_blocks_with_poles(self):
        """γ^(s̄) by the cascade, with error dynamics."""
        pairs = zip(self.coefficients, self.levels, strict=True)
        errors = {a: sum(c * e for c, e in zip(some, lower[:-1], strict=True)) for a, (some, lower) in enumerate(pairs)}
        return self.cascade.along(self.points, self.top - 1, self.top, errors=errors).jet(self.top)

    @cached_property
    def all_pivots(self):
        """Pivots by which the equations divide: a list of (name, SX)."""
        leading = self.saddle[2] if self.sparse else self._leading
        return [*self.r.pivots, *((f"leading matrix {i + 1}", p) for i, p in enumerate(leading))]

    @cached_property
    def pivots(self):
        """Pivots that depend on the motion, which must not vanish: a list of (name, SX)."""
        return [(name, p) for name, p in self.all_pivots if any(self.q.where(s) is not None for s in ca.symvar(p))]

    @property
    def pivot_sizes(self):
        """Largest size of each pivot at the points where the pivots were chosen, (n_g,) array."""
        values, _ = self.r.points.evaluate([p for _, p in self.pivots])
        return np.abs(values).max(axis=1, initial=0.0).astype(float)

    @property
    def column_sizes(self):
        """Column sizes (n,) (see `ranks.column_sizes`) of L and of Bᵀ at the points where ranks were decided."""
        matrices = (self.r.points.matrix(m)[0] for m in self._monitored())
        return [column_sizes(m).max(axis=1, initial=0.0).astype(float) for m in matrices]

    @property
    def jet_sizes(self):
        """Sizes of the jets by name: those given for the choice of pivots, else the largest at the points.

        The latter up to their usual sizes.
        """
        names = [name for k in range(self.top + 1) for name in self.q.jet_names(k)]
        largest = np.vstack([self.r.points.jet(k) for k in range(self.top + 1)])
        sizes = np.minimum(np.abs(largest).max(axis=1, initial=0.0), self.r.points.sizes(self.top)).astype(float)
        return {name: size for name, size in zip(names, sizes, strict=True) if size > 0} | self.r.context.sizes

    def rates(self, top):
        """X' for given γ^(s̄)."""
        moving = self.q.V @ self.q.jet(1) + self.q.h
        return ca.vertcat(moving, *(s for k in range(2, self.top) for s in self.q.gamma(k)), top)

    def ode(self, poles=False):
        """Outputs (X', pivots): D^ρψ = 0 for each row, or its error dynamics Π(D - λ)ψ = 0 if `poles`."""
        if self.sparse:
            solution = saddle.solve(self, poles)[0] if poles else self.saddle[0]
        else:
            solution = self.dense(poles)
        extra = ca.vertcat(*(c for row in self.coefficients for c in row)) if poles else None
        name = "ode_poles" if poles else "ode"
        return self.function(name, self.state, [self.rates(solution), *(p for _, p in self.pivots)], extra)

    def ode_jacobian(self, poles=False):
        """∂X'/∂X, column by column, with the inputs of `ode`."""
        f = self.ode(poles)

        def slopes(x, _, y):
            return ca.cse(ca.vec(ca.densify(ca.jacobian(y[: x.numel()], x))))

        return combined(f"{f.name()}_jacobian", slopes, f)

    def path(self):
        """For flat programs: outputs (δq, q', q'', pivots) as functions of (t, q), δq a Newton step.

        With quasi-velocities (δq, q', q'', γ', γ'', pivots).
        """
        q, n = self.q, self.q.n
        if self.cascade is not None:
            return self._path_by_blocks()
        zero = ca.SX.zeros(n)
        w, dw = q.jet(1), q.jet(2)
        first = ca.vertcat(*(level[1] for level in self.levels))
        second = ca.vertcat(*(level[2] for level in self.levels))
        velocity, _ = self._solve(-ca.substitute(first, w, zero))
        acceleration, _ = self._solve(-ca.substitute(second, dw, zero))
        acceleration = ca.substitute(acceleration, w, velocity)
        jets = [] if q.plain else [velocity, acceleration]
        moving = [ca.vertcat(*q.d(1)), ca.vertcat(*q.d(2)), *(p for _, p in self.pivots)]
        rate, second, *pivots = (
            ca.substitute(e, ca.vertcat(w, dw), ca.vertcat(velocity, acceleration)) for e in moving
        )
        return self.function("path", q.jet(0), [self._newton(), rate, second, *jets, *pivots])

    def _path_by_blocks(self):
        """`path` by the cascade."""
        q, motion = self.q, self._along(0, correct=True)
        steady = [any(q.where(s) is not None for s in ca.symvar(p)) for p in self._along(0).pivots]
        of_rows = [p for name, p in self.pivots if not name.startswith("leading matrix")]
        pivots = [*of_rows, *(p for p, moves in zip(motion.pivots, steady, strict=True) if moves)]
        jets = [] if q.plain else [motion.jet(1), motion.jet(2)]
        outputs = [ca.vertcat(*motion.newton), motion.rates(1), motion.rates(2), *jets, *pivots]
        return self.function("path", q.jet(0), outputs)

    def _newton(self):
        q = self.q
        residual = ca.vertcat(*(row.expression for row in self.r.rows))
        if q.nq == q.n:
            return q.V @ self._solve(-residual)[0]
        if len(q.invariants) != q.nq - q.n:
            raise SpecificationError(
                f"{q.nq} coordinates have {q.n} quasi-velocities and {len(q.invariants)} invariants.",
                f"A flat program is solved for all coordinates, which takes {q.nq - q.n} invariants of the kinematics.",
                do='Pass them, such as with_quasi_velocities(..., invariants={"unit": ca.dot(e, e) - 1}), '
                "or choose an integrating method.",
                coordinates=q.nq,
                velocities=q.n,
                invariants=tuple(q.invariants),
            )
        residual = ca.vertcat(residual, *q.invariants.values())
        matrix = ca.jacobian(residual, q.jet(0))
        return self.r.solved(matrix, -residual)[0]

    def matrices(self):
        """L and Bᵀ, column by column, whose ranks must not change, and the diagonal of M, which scales columns."""
        matrices = [ca.vec(ca.densify(m)) for m in self._monitored()]
        return self.function("matrices", self.state, [*matrices, ca.densify(ca.diag(self.r.mechanism.mass))])

    def _monitored(self):
        """L and Bᵀ."""
        return ca.vertcat(*(row.gradient(self.q) for row in monitored_rows(self.r))), self.r.realisation.B.T

    def balanced(self):
        """The mechanism's balance less inputs and material reactions, of (t, [Z; inputs; multipliers]), and its sizes.

        Three numbers a row: what is left, the largest term, and the sum of all terms, multiplied out.
        """
        r, q = self.r, self.q
        mechanism, acceleration, k = r.mechanism, q.jet(2), len(r.program.residuals)
        by_actuators, B = r.program.by == "actuators", r.realisation.B
        counts = {"input": r.actuation.shape[0], "multiplier": k, "reaction": B.shape[1] - k}
        inputs, wanted, reactions = (ca.SX.sym(name, count) for name, count in counts.items())
        E = mechanism.E if by_actuators else ca.SX.eye(q.n)
        of_program = E @ r.realisation.actuation if by_actuators else B[:, :k]
        columns = ca.horzcat(mechanism.mass, -E, -B[:, k:])
        values = ca.vertcat(acceleration, inputs, reactions)
        still = ca.substitute(mechanism.balance, acceleration, ca.SX.zeros(q.n))
        left = still + columns @ values
        terms = [still, *(columns[:, j] * values[j] for j in range(columns.shape[1]))]
        sums = ca.vertcat(*map(size_of_terms, left.elements())) + ca.fabs(of_program) @ ca.fabs(wanted)
        largest = reduce(ca.fmax, map(ca.fabs, terms))
        return self.function("balanced", ca.vertcat(self.jets, inputs, wanted, reactions), [left, largest, sums])

    def full(self):
        """The full equations as they are written, by `sized`, of (t, Z, p)."""
        parts = (self.r.full, self.r.omitted)
        parts = ({name: self._without_higher(e) for name, e in part.items()} for part in parts)
        usual = self.points.sizes(self.top) * self.points.factorials(self.top)
        return self.function("full", self.jets, sized(*parts, self.jets, usual, self.q.nq))

    def signals(self, kind, rate=0):
        """Names of a group of `SIGNALS`, and their `rate`-th time derivatives as a function of (t, Z, p).

        The jets Z extend beyond s̄ as far as these depend on them.
        """
        names, expressions = SIGNALS[kind](self)
        expressions = ca.vertcat(*expressions).elements()
        if rate:
            expressions = self.q.derivatives(expressions, rate)[rate]
            names, kind = [jet_name(name, rate) for name in names], f"{kind}_rate{rate}"
        values = ca.vertcat(ca.SX(0, 1), *expressions)  # SX without expressions, too
        places = filter(None, map(self.q.where, ca.symvar(values)))
        highest = max((level for of, level, _ in places if of == "w"), default=0)
        above = (s for k in range(self.top + 1, highest + 1) for s in self.q.gamma(k))
        return names, self.function(kind, ca.vertcat(self.jets, *above), [values])

    def _actuation(self):
        return list(self.r.mechanism.actuators), [self.r.actuation]

    def _reaction(self):
        names = self.q.force_names
        return [f"reaction_{name}" for name in names], [self.r.actuation]

    def _multipliers(self):
        names = [*self.r.program.residuals, *self.r.mechanism.constraints]
        multipliers = self.r.multipliers
        if self.r.program.by == "actuators":  # the multipliers of the program are then the actuation
            names, multipliers = [*self.r.mechanism.constraints], multipliers[len(self.r.program.residuals) :]
        return [f"multiplier_{name}" for name in names], [multipliers]

    def _outputs(self):
        mechanism = self.r.mechanism
        outputs = {name: e for name, e in mechanism.outputs.items() if name not in mechanism.inputs}
        return list(outputs), list(outputs.values())

    def _given_inputs(self):
        """Inputs that drive the mechanism as functions of time."""
        mechanism = self.r.mechanism
        return list(mechanism.inputs), [mechanism.outputs[name] for name in mechanism.inputs]

    def _references(self):
        q, read = self.q, reference_names(self.r)
        return list(read.values()), [q.family.jet(name, 0) for name in read]

    def _energy(self):
        return ["energy"], [self.r.mechanism.energy]

    def _inputs(self):
        """Inputs of the plant: the actuation, or the reaction of an ideal program."""
        return ["inputs"], [self.r.actuation]

    def _all_multipliers(self):
        """All multipliers μ of the reaction B μ."""
        return ["all_multipliers"], [self.r.multipliers]

    def _power(self):
        """dE/dt, the power of forces without a potential, its terms, what of dE/dt no force does, the terms of E."""
        r, q = self.r, self.q
        w, force = q.jet(1), self._force()
        rate = q.dt(r.mechanism.energy)
        law = rate - ca.dot(w, r.mechanism.balance + r.mechanism.forces)
        sums = ca.dot(ca.fabs(w), ca.fabs(force)), size_of_terms(r.mechanism.energy)
        return ["rate", "work", "size", "law", "terms"], [rate, ca.dot(w, force), sums[0], law, sums[1]]

    def _force(self):
        """Forces without a potential, inputs and reactions, (n,) SX."""
        r = self.r
        return r.mechanism.forces + r.mechanism.balance - r.balance + r.realisation.B @ r.multipliers

    def _reach(self):
        """The reaction of an ideal program, and the directions of actuators and material constraints."""
        k = len(self.r.program.residuals)
        directions = ca.horzcat(self.r.mechanism.E, self.r.realisation.B[:, k:])
        return ["reach"], [self.r.actuation, ca.vec(ca.densify(directions))]

    def _balance(self):
        names = self.q.force_names
        return [f"balance_{name}" for name in names], [self.r.mechanism.balance]

    def _coordinate_rates(self):
        names = [f"d{name}" for name in self.q.names] + [f"d2{name}" for name in self.q.names]
        return names, [*self.q.d(1), *self.q.d(2)]

    def _residuals(self):
        """Given residuals, material constraints and hidden rows, at every level up to order s̄."""
        names, expressions, rows = [], [], residual_rows(self.r)
        deep = {} if self.cascade is None else dict(zip(map(id, self.rows), self.levels, strict=True))
        others = [row for row in rows.values() if id(row) not in deep]
        deep |= zip(map(id, others), row_levels(self.q, others, self.top), strict=True)
        for name, row in rows.items():
            names += [(name, j) for j in range(len(deep[id(row)]))]
            expressions += deep[id(row)]
        reported, invariants = self.r.mechanism.reported, self.q.invariants
        names += [(name, 0) for name in reported]
        expressions += reported.values()
        expressions = [*map(self._without_higher, expressions), *invariants.values()]
        return [*names, *((name, 0) for name in invariants)], expressions

    def of_state(self, expression):
        """An expression of any jets as one of the state."""
        highest = self.saddle[0] if self.sparse else self.dense()
        return ca.substitute(self._without_higher(expression), self.q.jet(self.top), highest)

    def _without_higher(self, expression):
        """An expression with the jets above s̄, which the rows determine, replaced by their values.

        A row of the program that hidden rows replace may have an order above s̄.
        """
        places = filter(None, map(self.q.where, ca.symvar(expression)))
        highest = max((level for of, level, _ in places if of == "w"), default=0)
        if self.cascade is not None and highest > self.top:
            motion, above = self.cascade.along(self.points, self.top, highest), range(self.top + 1, highest + 1)
            jets = [ca.vertcat(*(e for k in above for e in part(k).elements())) for part in (self.q.jet, motion.jet)]
            return ca.substitute(expression, *jets)
        for k in range(highest, self.top, -1):
            jet = self.q.jet(k)
            pairs = zip(self.r.rows, self.raised, strict=True)
            raised = ca.vertcat(*(self.q.derivatives([r.expression], n + k - self.top)[-1][0] for r, n in pairs))
            solution, _ = self._solve(-ca.substitute(raised, jet, ca.SX.zeros(self.q.n)))
            expression = ca.substitute(expression, jet, solution)
        return expression


EQUATIONS = {  # arguments of `compiled`: the function, its loops, its projection
    "ode": lambda e: (e.ode(), ("rk",)),
    "ode_projected": lambda e: (e.ode(), ("rk",), e.project()),
    "ode_poles": lambda e: (e.ode(poles=True), ("rk",)),
    "ode_jacobian": lambda e: (e.ode_jacobian(),),
    "ode_poles_jacobian": lambda e: (e.ode_jacobian(poles=True),),
    "path": lambda e: (e.path(), ("newton",), None, None, {"pivots": len(e.pivots)}),
    "invariants": lambda e: (e.invariants(),),
    "matrices": lambda e: (e.matrices(),),
    "balanced": lambda e: (e.balanced(),),
    "full": lambda e: (e.full(),),
    "accelerations": lambda e: (saddle.accelerations(e),),
}


SIGNALS = {  # names and expressions of each group
    "actuation": Equations._actuation,
    "reaction": Equations._reaction,
    "multipliers": Equations._multipliers,
    "outputs": Equations._outputs,
    "given_inputs": Equations._given_inputs,
    "references": Equations._references,
    "energy": Equations._energy,
    "balance": Equations._balance,
    "coordinate_rates": Equations._coordinate_rates,
    "residuals": Equations._residuals,
    "inputs": Equations._inputs,
    "all_multipliers": Equations._all_multipliers,
    "power": Equations._power,
    "reach": Equations._reach,
}


def sized(written, omitted, jets, usual, nq):
    """Equations by name, and what rows omit of them: values, sizes of their terms, and these at jets of usual size.

    There rates, the jets behind the nq coordinates, have at least their usual sizes, and an equation without rates has
    the change that usual coordinates make. What is omitted is taken there, too: a row takes another order also where
    its motion rests.
    """
    q, rates, names = jets[:nq], jets[nq:], [*written]
    sizes, out = (ca.vertcat(ca.SX(0, 1), *part) for part in (sizes_of_terms([*written.values()]), omitted.values()))
    moving = ca.if_else(ca.fabs(rates) < usual[nq:], usual[nq:], rates)
    at_usual, out = ca.substitute([sizes, out], [rates], [moving])
    for i, (name, equation) in enumerate(written.items()):
        if name in omitted or not ca.depends_on(equation, rates):
            at_usual[i] += ca.fabs(ca.jacobian(equation, q)) @ usual[:nq]
    of_out = at_usual[[names.index(name) for name in omitted]]
    return [*written.values(), out, sizes, of_out, at_usual, of_out]


def _level_name(name, j):
    return name if j == 0 else f"D{'' if j == 1 else j}({name})"


def residual_rows(reduction):
    """Rows whose residuals a run reports, by name."""
    hidden = {f"hidden: {row.name}": row for row in reduction.rows if row.derivation}
    return {**reduction.original, **hidden}


def residual_names(reduction):
    """Names of the rows whose residuals a run reports."""
    return (*residual_rows(reduction), *reduction.mechanism.reported, *reduction.mechanism.q.invariants)


def reference_names(reduction):
    """The names by which references are read, by their own: x_reference beside a coordinate x."""
    return distinct("reference", reduction.references, reduction.mechanism.signals)


def signal_groups(reduction):
    """The group of each signal that is no jet, {signal name: key of `SIGNALS`}."""
    mechanism, program = reduction.mechanism, reduction.program
    names = mechanism.q.force_names
    groups = dict.fromkeys(mechanism.outputs, "outputs") | dict.fromkeys(mechanism.inputs, "given_inputs")
    groups |= dict.fromkeys(reference_names(reduction).values(), "references") | {"energy": "energy"}
    if program.by == "actuators":
        groups = dict.fromkeys(mechanism.actuators, "actuation") | groups
    else:
        groups |= dict.fromkeys((f"reaction_{name}" for name in names), "reaction")
        groups |= dict.fromkeys((f"multiplier_{name}" for name in program.residuals), "multipliers")
    groups |= dict.fromkeys((f"multiplier_{name}" for name in mechanism.constraints), "multipliers")
    if not mechanism.q.plain:
        rates = (f"{d}{name}" for d in ("d", "d2") for name in mechanism.q.names)
        groups |= dict.fromkeys(rates, "coordinate_rates")
    return groups


def invariant_names(model):
    """(level, name) of each invariant of the state, in the order of the function "invariants"."""
    return model.once("invariant names", lambda: [(level, name) for level, name, _ in model.equations.invariant_rows])


def balances(reduction):
    """The coordinate or quasi-velocity, by index, of each row of L that is a row TᵀM of (3.18), by index."""
    names = [f"balance of {name}" for name in reduction.mechanism.q.force_names]
    rows = enumerate(monitored_rows(reduction))
    return {a: names.index(row.name) for a, row in rows if row.name in names and row.order == 2 and not row.derivation}


def monitored_rows(reduction):
    """Rows of L; where G M⁻¹B is definite the constraints alone, whose rank is that of all."""
    rows = reduction.rows
    return [row for row in rows if row.kind != "dynamics"] if reduction.realisation.definite else rows


def leading_names(reduction):
    """Names of the rows of L, then of Bᵀ."""
    constraints = [row for row in reduction.rows if row.kind != "dynamics"]
    program = [row.name for row in constraints if row.kind == "program"]
    material = [row.name for row in constraints if row.kind == "material"]
    directions = program if reduction.program.by == "ideal" else list(reduction.mechanism.actuators)[: len(program)]
    return [row.name for row in monitored_rows(reduction)], [*directions, *material]


def gradient_jets(reduction, name):
    """Names of the jets on which the leading gradient of a row depends."""
    q = reduction.mechanism.q
    for row in (*reduction.rows, *reduction.original.values()):
        if row.name == name:
            places = [q.where(s) for s in ca.symvar(row.gradient(q))]
            return [q.jet_names(level)[i] for kind, level, i in filter(None, places) if kind in "qw"]
    return []
