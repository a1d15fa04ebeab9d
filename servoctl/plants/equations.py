"""The functions of a plant as SX expressions: the full mechanism under inputs, disturbances and further forces."""

from dataclasses import replace
from functools import cached_property, lru_cache
from itertools import product

import casadi as ca
import numpy as np

from servoctl.codegen.folding import folded
from servoctl.codegen.interpreted import Interpreter
from servoctl.errors import SpecificationError
from servoctl.model.equations import Invariants, sized
from servoctl.reduction.appell import plant_solution, require_inertia
from servoctl.reduction.hidden import complete
from servoctl.reduction.manifold import Context, follows, sample
from servoctl.reduction.reduce import NEAR_SPREAD, NEARBY, WINDOW, references, strong
from servoctl.reduction.rows import as_rows, omitted
from servoctl.spec.program import no_program
from servoctl.spec.references import Jets, called, function_of
from servoctl.tolerances import ENTRY, TINY
from servoctl.values import Identity

LATEST = 32  # plants whose equations stay in memory
SMALL = 1e-6  # of the largest terms of a plant's equations: those of a row that may be rounding
CLEAR = 1e-6  # a mass matrix with unit diagonal and a larger least eigenvalue is clearly positive definite


class PlantEquations:
    """Expressions of the state x = (q, γ', lagged inputs) and of p = (parameters, damping, 1/lag, u, d).

    Where they contain references, whose names are `references`, the p of functions begins with the place of the paths
    that a plant follows. Further generalised `forces` (n,) are a serialised function (see `Coordinates.as_function`),
    "" for none; `damped` and `lagged` are indices of velocities with viscous damping and of actuators that lag behind
    their command. Orders and pivots are decided at the parameters `values`, by default those of the mechanism;
    `choices` are these four. In `others` are the same equations with pivots that were decided near states where these
    vanish.
    """

    def __init__(self, mechanism, forces, damped, lagged, values=None, context=None):
        q = self.q = mechanism.q
        self.mechanism, self.choices, self.lagged = mechanism, (forces, damped, lagged, values), lagged
        self.values = mechanism.parameters.values() if values is None else np.array(values)
        parameters = mechanism.parameters.symbols
        self._context = Context(parameters, self.values, WINDOW, {}) if context is None else context
        self.functions, self.others = {}, []
        self.forces = _expression(forces, mechanism)
        self.references = references(mechanism, no_program(), [self.forces])
        self.velocity = ca.vertcat(*q.gamma(1))
        self.lagging = ca.SX.sym("lagging", len(lagged))
        self.state = ca.vertcat(*q, self.velocity, self.lagging)
        self.damping, self.rates = ca.SX.sym("damping", len(damped)), ca.SX.sym("rate", len(lagged))
        self.u, self.d = ca.SX.sym("u", len(mechanism.actuators)), ca.SX.sym("d", q.n)
        self.p = ca.vertcat(*mechanism.parameters.symbols, self.damping, self.rates, self.u, self.d)
        self.resisting = ca.SX.zeros(q.n)
        for c, i in zip(self.damping.elements(), damped, strict=True):
            self.resisting[i] = -c * self.velocity[i]
        self.force = ca.SX(self.u)
        for a, value in zip(lagged, self.lagging.elements(), strict=True):
            self.force[a] = value

    def function(self, name, outputs, x=None, p=None):
        """An SX function of (t, x, p) with one dense column."""
        x, p, y = self.state if x is None else x, self.p if p is None else p, ca.densify(ca.cse(ca.vertcat(*outputs)))
        f = function_of(self.q, self.references, name, x, p, y)
        return ca.Function(name, f.sx_in(), [ca.densify(ca.cse(folded(f)))], f.name_in(), ["y"])

    @cached_property
    def _material(self):
        """Rows of the material constraints, which have full rank, and points of their manifold."""
        rows, _, points, _ = complete(self.q, self._original, self._context)
        require_inertia(self.mechanism, rows, points)
        return rows, points

    @cached_property
    def _original(self):
        """The rows of the material constraints by themselves."""
        return as_rows(self.q, self.mechanism.constraints, "material", self._context)

    def near(self, t, x, values, followed):
        """The same equations with orders and pivots decided near a state x (n_x,) at t [s], with these parameters.

        `followed` are values of jets of references there, by name.
        """
        state = dict(zip((*self.q.names, *self.q.jet_names(1)), map(float, x), strict=False))
        parameters, window = self.mechanism.parameters.symbols, (t - NEARBY, t + NEARBY)
        jets = follows(self.q, followed)
        context = Context(parameters, np.array(values), window, state, NEAR_SPREAD, followed=jets)
        return PlantEquations(self.mechanism, *self.choices[:-1], tuple(values), context)

    def require_inertia(self, values):
        """Raise SpecificationError if the mass matrix is not positive with parameters (n_p,) or (n_p, N)."""
        rows, points = self._material
        cases = _cases(values)
        if self._clearly_positive(self._corners(cases)).all():
            return
        cases = np.unique(cases, axis=1)
        for case in cases.T[~self._clearly_positive(cases)]:
            require_inertia(self.mechanism, rows, replace(points, values=case))

    def _corners(self, cases):
        """Corners of the box around the cases (n_p, N), or the cases.

        Where the mass matrix M is affine in each parameter that varies, it is in each case a convex combination of
        those at the corners. So is M minus a share of its diagonal: where it is positive at the corners, it is in all.
        """
        low, high = cases.min(axis=1), cases.max(axis=1)
        varied = np.flatnonzero(low != high)
        if 2.0 ** len(varied) >= cases.shape[1] or not self._affine[varied].all():
            return cases
        corners = np.repeat(low[:, None], 2 ** len(varied), axis=1)
        corners[varied] = np.array(list(product(*zip(low[varied], high[varied], strict=True)))).T
        return corners

    @cached_property
    def _affine(self):
        """Whether the mass matrix is affine in each parameter, (n_p,)."""
        mass, parameters = ca.vec(self.mechanism.mass), self.mechanism.parameters.symbols
        return np.array([not ca.depends_on(ca.jacobian(mass, s), s) for s in parameters], dtype=bool)

    def _clearly_positive(self, cases):
        """Whether the mass matrix of each case (n_p, N) is far from singular at all points."""
        M = np.moveaxis(self._masses(cases).reshape(self.q.n**2, -1), 0, 1).reshape(-1, self.q.n, self.q.n)
        size = np.sqrt(np.maximum(np.diagonal(M, axis1=1, axis2=2), 0.0))
        sound = np.isfinite(M).all(axis=(1, 2)) & size.all(axis=1)
        least = np.full(len(M), -np.inf)
        M, size = M[sound], size[sound]
        least[sound] = np.linalg.eigvalsh(M / (size[:, :, None] * size[:, None, :])).min(axis=1)
        return (least.reshape(cases.shape[1], -1) > CLEAR).all(axis=1)

    @cached_property
    def _masses(self):
        """A function of the parameters: the mass matrices at all points."""
        return self._at_points(self.mechanism.mass)

    def _at_points(self, matrix):
        """A function of parameters (n_p, N): the entries of a matrix in each case and at each point, (n, N, points)."""
        points, jets = self._material[1], Jets(self.q, [matrix])
        state = ca.vertcat(*self.q, self.velocity, jets.symbols)
        p, y = ca.vertcat(*self.mechanism.parameters.symbols), ca.densify(ca.vec(matrix))
        f = ca.Function("at_points", [self.q.t, state, p], [ca.densify(ca.cse(y))])
        f = Interpreter(ca.Function("at_points", f.sx_in(), [ca.densify(ca.cse(folded(f)))]))
        t, x = np.asarray(points.t, dtype=float), np.vstack([points.jet(0), points.jet(1)]).astype(float)
        x = np.vstack([x, jets.of(points.instants)])

        def values(cases):
            n, y = cases.shape[1], np.empty((matrix.numel(), len(t) * cases.shape[1]))
            f.grid(np.repeat(t, n), np.repeat(x, n, axis=1), np.tile(cases, len(t)), y)
            return y.reshape(-1, len(t), n).swapaxes(1, 2)

        return values

    @property
    def rests(self):
        """Whether the order of a material constraint rests on slopes that may be active elsewhere."""
        return any(row.rests for row in (*self._original, *self._material[0]))

    @cached_property
    def written(self):
        """The material constraints as they are written, by name."""
        return {name: self.q.on_spheres(e) for name, e in self.mechanism.constraints.items()}

    @property
    def omitted(self):
        """What their rows leave out, where it may be active elsewhere, by name."""
        return omitted(self.written, self._original)

    def full(self):
        """The material constraints as they are written, by `sized`."""
        highest, jets = ca.vertcat(*self.q.gamma(2)), ca.vertcat(*self.q, self.velocity)
        parts = (
            {name: ca.substitute(e, highest, self.acceleration) for name, e in part.items()}
            for part in (self.written, self.omitted)
        )
        return self.function("full", sized(*parts, jets, self._material[1].sizes(1), self.q.nq))

    def hold(self, values):
        """Whether orders and pivots may stay as they are with other parameters (n_p,) or (n_p, N)."""
        values = _cases(values)
        if np.array_equal(values, np.broadcast_to(self.values[:, None], values.shape)):
            return True
        if self.rests and not all(map(self._still, values.T)):
            return False
        here, usual = (np.abs(self._pivots(v)).min(axis=2, initial=np.inf) for v in (values, self.values[:, None]))
        return bool(strong(here, usual).all())

    def _still(self, values):
        """Whether the material constraints hold as they are written where their rows do with other parameters."""
        rows, points = self._material
        points = sample(self.q, rows, 2, Context(points.parameters, values, WINDOW, {}), starts=points)
        left, sizes = points.evaluate([*self.written.values()])
        return bool(np.all(np.abs(left) <= ENTRY * sizes))

    @cached_property
    def _pivots(self):
        """A function of the parameters: the pivots of the accelerations at all points."""
        return self._at_points(ca.vertcat(*self._solved[1]))

    @property
    def constrained(self):
        """Whether the state has invariants: material constraints or those of the kinematics."""
        return bool(self.mechanism.constraints or self.q.invariants)

    @property
    def acceleration(self):
        """γ'' with ideal material constraints."""
        return self._solved[0][: self.q.n]

    @cached_property
    def multiplier_names(self):
        """Names of `multipliers`."""
        given = self.mechanism.constraints
        rows = self._material[0] if given else []
        if len(rows) != len(given) or any(not ca.is_equal(row.expression, given.get(row.name, 0), 1) for row in rows):
            return ()
        return tuple(f"multiplier_{row.name}" for row in rows)

    @property
    def multipliers(self):
        """Reactions λ of the material constraints, G_mᵀλ, as "multiplier_NAME"; none where rows were combined."""
        return {name: -self._solved[0][self.q.n + i] for i, name in enumerate(self.multiplier_names)}

    def reactions(self):
        """The values of `multipliers`."""
        return self.function("multipliers", list(self.multipliers.values()))

    @cached_property
    def _system(self):
        """M, G_m, and the right-hand side of [M G_mᵀ; G_m 0] [γ''; -λ] = [forces; ...] in two parts."""
        q, (rows, _) = self.q, self._material
        acceleration, zero = ca.vertcat(*q.gamma(2)), ca.SX.zeros(q.n)
        second = [q.derivatives([row.expression], 2 - row.order)[-1][0] for row in rows]
        second = ca.vertcat(*second) if rows else ca.SX(0, 1)
        driven = self.mechanism.E @ self.force + self.d + self.forces + self.resisting
        force = driven - ca.substitute(self.mechanism.balance, acceleration, zero)
        rest = ca.substitute(second, acceleration, zero)
        return self.mechanism.mass, ca.jacobian(second, acceleration), force, -rest

    @cached_property
    def _solved(self):
        """[γ''; -λ] and the pivots."""
        rows, points = self._material
        solution, pivots = plant_solution(self.mechanism, rows, *self._system[2:], points)
        return ca.cse(solution), pivots

    def unsolved(self):
        """What [γ''; -λ] leaves of its equations, relative to their terms: at most the rounding of a sound solution."""
        M, G, *right = self._system
        matrix, right = ca.blockcat([[M, G.T], [G, ca.SX(G.shape[0], G.shape[0])]]), ca.vertcat(*right)
        terms = ca.fabs(matrix) @ ca.fabs(self._solved[0]) + ca.fabs(right)
        left = ca.fabs(matrix @ self._solved[0] - right)
        # a sum, as the largest of values passes over what is not finite
        return self.function("unsolved", [ca.sum1(left / (terms + SMALL * ca.mmax(terms) + TINY))])

    @cached_property
    def state_rates(self):
        """x'."""
        q = self.q
        lags = self.rates * (self.u[list(self.lagged)] - self.lagging) if self.lagged else ca.SX(0, 1)
        return ca.vertcat(q.V @ self.velocity + q.h, self.acceleration, lags)

    def ode(self):
        """x' of the state."""
        return self.function("plant", [self.state_rates])

    def ode_power(self):
        """x' of the state, extended by the work of all forces without a potential."""
        x = ca.vertcat(self.state, ca.SX.sym("work"))
        return self.function("plant_power", [self.state_rates, ca.sum1(self._powers)], x)

    @property
    def _powers(self):
        """Powers of the inputs, of the disturbances, and of friction and other forces."""
        w = self.velocity
        other = self.mechanism.forces + self.forces + self.resisting
        return ca.vertcat(ca.dot(w, self.mechanism.E @ self.force), ca.dot(w, self.d), ca.dot(w, other))

    def power(self):
        """Energy and the three powers."""
        return self.function("power", [self.mechanism.energy, self._powers])

    @cached_property
    def unbalanced(self):
        """Why dE/dt is not the power of inputs, disturbances and other forces; "" if it is."""
        q, m = self.q, self.mechanism
        inertial = q.dt(m.energy) - ca.dot(self.velocity, m.balance + m.forces)
        if not m.is_zero([inertial]):
            return "the inertia terms depend on time or on more than wᵀMw/2"
        for row in self._material[0]:
            rate = q.derivatives([row.expression], 1 - row.order)[-1][0]
            if not m.is_zero([rate - ca.jtimes(rate, self.velocity, self.velocity)]):  # the reaction does work
                return f"the material constraint {row.name!r} moves by itself"
        return ""

    def jacobian(self):
        """∂x'/∂x and ∂x'/∂u, column by column."""
        matrix = ca.jacobian(self.state_rates, ca.vertcat(self.state, self.u))
        return self.function("jacobian", [ca.vec(ca.densify(matrix))])

    def directions(self):
        """E and V, column by column."""
        return self.function("directions", [ca.vec(ca.densify(self.mechanism.E)), ca.vec(ca.densify(self.q.V))])

    def accelerations(self):
        """γ''."""
        return self.function("accelerations", [self.acceleration])

    def outputs(self):
        """The mechanism's named outputs; for those of order 3 and above inputs and disturbances are held."""
        outputs, jets = list(self.mechanism.outputs.values()), [self.acceleration]
        for _ in range(2, max(map(self.q.order, outputs), default=0)):
            followed = Jets(self.q, [jets[-1]])
            symbols, rates = ca.vertcat(self.state, followed.symbols), ca.vertcat(self.state_rates, followed.rates)
            jets.append(ca.jacobian(jets[-1], self.q.t) + ca.jtimes(jets[-1], symbols, rates))
        symbols = ca.vertcat(*(s for k in range(2, 2 + len(jets)) for s in self.q.gamma(k)))
        return self.function("outputs", [ca.substitute(e, symbols, ca.vertcat(*jets)) for e in outputs])

    def constraints(self):
        """Names and values of the invariants of the state, level by level."""
        if not self.constrained:
            return [], self.function("constraints", [ca.SX(0, 1)])
        rows = self._invariants.invariant_rows
        return [name for _, name, _ in rows], self.function("constraints", [e for _, _, e in rows])

    def constraints_jacobian(self):
        """Derivatives of the invariants of the state in x, column by column."""
        values = ca.vertcat(*(e for _, _, e in self._invariants.invariant_rows))
        return self.function("constraints_jacobian", [ca.vec(ca.densify(ca.jacobian(values, self.state)))])

    def project(self, extra=0):
        """The least change of the state that restores its invariants; None without invariants.

        `extra` further states behind those of the plant do not change.
        """
        if not self.constrained:
            return None
        f = self._invariants.project()
        n = f.numel_in(1)
        change = called(self.q, self.references, f, self.state[:n], ca.vertcat(*self.mechanism.parameters.symbols))
        untouched = ca.SX.zeros(self.lagging.numel() + extra)
        return self.function("project", [change, untouched], ca.vertcat(self.state, ca.SX.sym("extra", extra)))

    @cached_property
    def _invariants(self):
        rows, points = self._material
        return Invariants(self.mechanism, rows, 2, points, references=self.references)


def _expression(forces, mechanism):
    if not forces:
        return ca.SX.zeros(mechanism.q.n)
    return mechanism.q.from_function(ca.Function.deserialize(forces), mechanism.parameters.symbols)[0]


def _cases(values):
    """Parameters (n_p,) or (n_p, N) as columns (n_p, N)."""
    values = np.asarray(values, dtype=float)
    return values if values.ndim == 2 else values[:, None]


def plant_equations(mechanism, *choices):
    """The `PlantEquations` of a mechanism, derived once for all plants that differ only in numbers."""
    return _latest(Identity(mechanism), choices)


def equations_at(equations, values):
    """The same equations with parameters (n_p,) or (n_p, N), derived again at the first case that requires it.

    Cases that need different equations are refused.
    """
    if equations.hold(values):
        return equations
    cases = _cases(values).T
    case = next(case for case in cases if not equations.hold(case))
    again = plant_equations(equations.mechanism, *equations.choices[:-1], tuple(case.tolist()))
    if len(cases) > 1 and not again.hold(values):
        names = equations.mechanism.parameters.names
        raise SpecificationError(
            "The orders of material constraints, or the pivots, of some cases are not those of the others.",
            "The cases of one call share the equations of the plant.",
            do="Run the cases in groups of similar numbers, or one by one with sv.sweep.",
            case=dict(zip(names, case.tolist(), strict=True)),
        )
    return again


@lru_cache(LATEST)
def _latest(identity, choices):
    return PlantEquations(identity.value, *choices)
