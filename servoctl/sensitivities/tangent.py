"""The tangent of a motion as functions of (t, x, p): derivatives of jets and signals by parameters.

The rows ψ_a and their time derivatives vanish along every motion, whatever the parameters. With z' = ∂z/∂p for the jets
z_j = γ^(j) and D for the time derivative, differentiation by p gives level by level

    L z'_j = -∂(D^j ψ)/∂p - Σ_{i<j} ∂(D^j ψ)/∂z_i z'_i,

with the same matrix L of highest derivatives at every level: the implicit function theorem. All levels follow so where
the program determines the motion. Otherwise the tangent S of the state obeys the variational equation
S' = ∂f/∂X S + ∂f/∂p, and the highest level alone follows from L.
"""

from functools import wraps

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.model.equations import SIGNALS
from servoctl.spec.references import Jets


def parameter_symbols(equations, names):
    """The symbols (k,) of parameters by name."""
    parameters = equations.r.mechanism.parameters
    return ca.vertcat(ca.SX(0, 1), *(parameters.symbols[parameters.names.index(name)] for name in names))


def by_parameters(equations, expressions, names, moved):
    """Derivatives (m, k) of expressions (m,) by parameters by name, also along the references that move with them.

    `moved` are the pairs (reference, parameter) of these, whose derivatives have jets of their own.
    """
    slopes = ca.jacobian(expressions, parameter_symbols(equations, names))
    if not moved:
        return slopes
    jets, symbol = Jets(equations.q, [expressions]), equations.q.family.jet
    rows = [[symbol((r, name), k) if (r, name) in moved else 0 for name in names] for r, k in jets.places]
    rates = ca.vertcat(ca.SX(0, len(names)), *(ca.horzcat(*row) for row in rows))
    return slopes + ca.jacobian(expressions, jets.symbols) @ rates


def start_of(run):
    """The instant [s] and the state (n_x,) from which a run was computed, which need not be its first sample."""
    if run.start is None:
        return float(run.t[0]), run.jets[: len(run.model.state_names), 0]
    return float(run.start.t), np.asarray(run.start.values, dtype=float)


class Tangent:
    """The tangent of the jets Z = (q, γ', ..., γ^(s̄)) of a model in the direction of its parameters.

    `S` (n_x, K) is the tangent of the state, its first k columns by the k parameters `names`, the others by initial
    values; by default it is what the program determines. `jets` (n_z, K) is ∂Z with the same columns.
    References that move with the parameters are those of the pairs `moved`.
    """

    def __init__(self, equations, names, moved, S=None):
        self.e, self.names, self.moved = equations, names, moved
        sizes = [equations.q.nq, *[equations.q.n] * (equations.top - 1)]
        known = [] if S is None else ca.vertsplit(S, np.cumsum([0, *sizes]).tolist())
        for j in range(len(known), equations.top + 1):
            known.append(self._level(j, known))
        self.jets = ca.vertcat(*known)

    def _level(self, j, known):
        """∂γ^(j), or ∂q, from the tangents of the jets below."""
        e = self.e
        rows = ca.vertcat(*(level[j - e.top + ρ] for level, ρ in zip(e.levels, e.raised, strict=True)))
        if j and e.cascade is None:
            return e._solve(-self.along(rows, [e.q.jet(i) for i in range(j)], known))[0]
        rows = rows if j else ca.vertcat(rows, *e.q.invariants.values())
        matrix = ca.jacobian(rows, e.q.jet(j))
        right = -self.along(rows, [e.q.jet(i) for i in range(j)], known[:j])
        return e.r.solved(matrix, right)[0]

    def along(self, expressions, jets, tangents):
        """The derivatives (m, K) of expressions (m,) along tangents of jets, and by the parameters."""
        k, slopes = len(self.names), by_parameters(self.e, expressions, self.names, self.moved)
        columns = tangents[0].shape[1] if tangents else k
        result = ca.horzcat(slopes, ca.SX.zeros(expressions.numel(), columns - k))
        for symbols, tangent in zip(jets, tangents, strict=True):
            if symbols.numel():
                result += ca.jacobian(expressions, symbols) @ tangent
        return result

    def of(self, expressions):
        """The derivatives (m, K) of signals (m,)."""
        return self.along(expressions, [self.e.jets], [self.jets])


def kept(build):
    """A function of a model, and of names and numbers, whose value is built once for each."""

    @wraps(build)
    def found(model, *of):
        return model.once(f"{build.__name__} {of}", lambda: build(model, *of))

    return found


@kept
def tangent_at(model, names, moved, initial, kinds):
    """The compiled tangent of jets and groups of signals at a state and its tangent S: a function of t, (Z, S), p.

    The columns of S are by the parameters `names`, then by `initial` initial values; a flat model has no S. Outputs
    ∂Z, then those of the signals of each group, column by column.
    """
    e = model.equations
    S = ca.SX(0, 0) if model.flat else ca.SX.sym("S", e.state.numel(), len(names) + initial)
    tangent = Tangent(e, names, moved, None if model.flat else S)
    parts = [tangent.jets, *(tangent.of(ca.vertcat(*SIGNALS[kind](e)[1])) for kind in kinds)]
    x, outputs = ca.vertcat(e.jets, ca.vec(S)), [ca.vec(ca.densify(part)) for part in parts]
    f = e.function("tangent", x, outputs, rates=moved)
    return compiled(f, "tangent", ("rk",) if model.flat else ())  # all its samples at once are worth compiling


@kept
def variational(model, names, moved, initial):
    """X' and S' as a function of t, (X, S), p: the equations of motion with their variational equations."""
    e = model.equations
    S = ca.SX.sym("S", e.state.numel(), len(names) + initial)
    tangent, top = Tangent(e, names, moved, S), ca.vertcat(*e.q.gamma(e.top))
    rates = e.rates(top)
    state_rates = e.called(e.ode(), e.state, e.parameters)[: e.state.numel()]
    tangent_rates = ca.substitute(tangent.of(rates), top, state_rates[-e.q.n :])
    x, outputs = ca.vertcat(e.state, ca.vec(S)), [state_rates, ca.vec(ca.densify(tangent_rates))]
    return compiled(e.function("variational", x, outputs, rates=moved), "variational")


@kept
def invariants_by(model, names, moved):
    """The invariants of the state, and their Jacobian in X and in parameters, as a function of (t, X, p)."""
    e = model.equations
    values = ca.vertcat(ca.SX(0, 1), *(expression for _, _, expression in e.invariant_rows))
    slopes = ca.horzcat(ca.jacobian(values, e.state), by_parameters(e, values, names, moved))
    outputs = [values, ca.vec(ca.densify(slopes))]
    return compiled(e.function("invariants_by", e.state, outputs, rates=moved), "invariants_by")
