"""Residuals of a program as functions of a plant's state, matched by name."""

from functools import lru_cache

import casadi as ca
import numpy as np

from servoctl.checks import named, rows_read
from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, unknown
from servoctl.jets.branches import cse


class Residuals:
    """Residuals of a model's program at the states and parameters of a plant.

    `names` selects some, and may name outputs of the mechanism and states: their residual is the deviation from the
    plan. `order` is the highest: 1 for functions of the state (q, γ'), 2 with accelerations.

    Attributes
    ----------
    names, orders, parameter_names : tuple
        Names and orders of the residuals, and names of the plant's parameters on which they depend.
    expressions, symbols : SX, list of SX
        The residuals, and the parameters on which they depend; values along the plan are the last of them.
    parameters : (n_p,) array
        The plant's numbers of these parameters, 0 for values along the plan.
    planned : tuple of str
        Names of the residuals that are deviations from the plan.
    measures : tuple of str
        The states on which the residuals depend.
    """

    def __init__(self, model, plant, names=None, order=1):
        mechanism, residuals = model.reduction.mechanism, program_residuals(model)
        self._q, planned, along = mechanism.q, _planned(mechanism), {}
        if names is not None:  # which are signals, or else rows
            along = {name: ca.SX.sym(f"plan {name}") for name in planned if name in names}
            rows = {name: residuals[row] for name, row in rows_read(residuals, mechanism.signals).items()}
            valid = {name: self._q.order(e) for name, e in (rows | planned).items()}
            residuals = {name: (rows | planned)[name] - along.get(name, 0) for name in valid if name in names}
        orders = {name: self._q.order(e) for name, e in residuals.items()}
        for name in names or ():
            if name not in orders:
                raise unknown(name, valid, "residual, output or state")
            if orders[name] > order:
                raise SpecificationError(
                    f"The residual {name!r} has order {orders[name]}.",
                    "What is fed back is a function of the state (q, γ').",
                    nearest=", ".join(repr(n) for n, order in valid.items() if order <= 1),
                    do="Leave it out.",
                    name=name,
                    order=orders[name],
                )
        self.names = tuple(name for name in orders if orders[name] <= order)
        self.orders = tuple(max(orders[name], 0) for name in self.names)
        self.expressions = ca.vertcat(*(residuals[name] for name in self.names))
        numbers = dict(zip(plant.mechanism.parameters.names, plant.parameters.tolist(), strict=False))
        self.symbols = [s for s in mechanism.parameters.symbols if _depends(self.expressions, s)]
        self.parameter_names = tuple(map(mechanism.parameters.name_of, self.symbols))
        for name in self.parameter_names:
            named(name, numbers, "parameter of the plant")
        self.planned = tuple(along)
        self.parameters = np.array([numbers[name] for name in self.parameter_names] + [0.0] * len(along))
        self.symbols = [*self.symbols, *along.values()]
        self.measures = tuple(s.name() for s in self._states(self.expressions))
        for name in self.measures:
            named(name, plant.state_names, "state of the plant")
        self._plant, self._order = plant, order
        self._built = {}

    def _states(self, expression):
        return [s for s in (*self._q, *self._q.gamma(1)) if _depends(expression, s)]

    def expression(self, t, y, measures, p):
        """φ as an SX column of the symbols t, y (named by `measures`) and p."""
        states = self._states(self.expressions)
        old = [self._q.t, *states, *self.symbols]
        new = [t, *(y[measures.index(s.name())] for s in states), *ca.vertsplit(p)]
        return ca.substitute(self.expressions, ca.vertcat(*old), ca.vertcat(*new))

    def _function(self, key, outputs):
        if key not in self._built:
            state = ca.vertcat(*self._q, *(s for k in range(self._order) for s in self._q.gamma(k + 1)))
            p = ca.vertcat(*self.symbols) if self.symbols else ca.SX(0, 1)
            y = ca.densify(cse(ca.vertcat(*outputs(state))))
            self._built[key] = compiled(ca.Function(key, [self._q.t, state, p], [y]), key)
        return self._built[key]

    def _ordered(self, x):
        """States (and accelerations, for order 2) in the plan's order, from an array in the plant's order."""
        names = (*self._q.names, *(name for k in range(self._order) for name in self._q.jet_names(k + 1)))
        columns = (*self._plant.state_names, *self._plant.mechanism.q.jet_names(2))
        rows = [columns.index(name) if name in columns else -1 for name in names]
        return np.where(np.array(rows)[:, None] < 0, 0.0, x[rows])

    def levels(self, t, x):
        """Residuals, and the derivative of those of order 0: (2, N) and (1, N) arrays by name.

        `x` (n_x, N) are states of the plant at t (N,); for order 2 with accelerations below the states.
        """

        def outputs(_state):
            items = self.expressions.elements()
            return [
                level[0]
                for e, order in zip(items, self.orders, strict=True)
                for level in self._q.derivatives([e], max(1 - order, 0))
            ]

        values = self._function("residual_levels", outputs).grid(t, self._ordered(x), self.parameters)
        counts = [max(2 - order, 1) for order in self.orders]
        ends = np.cumsum([0, *counts])
        return {n: values[a:b] for n, a, b in zip(self.names, ends[:-1], ends[1:], strict=True)}

    def jacobian(self, t, x):
        """∂φ/∂x along states of the plant, (N, k, n_x)."""
        k = len(self.names)

        def outputs(state):
            return [ca.vec(ca.densify(ca.jacobian(self.expressions, state)))]

        values = self._function("residual_jacobian", outputs).grid(t, self._ordered(x), self.parameters)
        values = values.reshape(-1, k, len(t)).transpose(2, 1, 0)
        jacobian = np.zeros((len(t), k, self._plant.n_x))
        for i, name in enumerate((*self._q.names, *self._q.jet_names(1))):
            if name in self._plant.state_names:
                jacobian[:, :, self._plant.state_names.index(name)] = values[:, :, i]
        return jacobian


def _planned(mechanism):
    """What may be compared with its value along a plan, by name: states and outputs."""
    states = {s.name(): s for s in (*mechanism.q, *mechanism.q.gamma(1))}
    return states | mechanism.outputs


@lru_cache(32)
def known_residuals(model, plant):
    """All residuals up to order 2, whose functions are derived once for a model and a plant."""
    return Residuals(model, plant, order=2)


def program_residuals(model):
    """Residuals of the program of a model, by name; of a plant under inputs those that it reports."""
    return model.reduction.program.residuals or model.reduction.mechanism.reported


def in_symbols_of(plant, model, expressions=None):
    """Expressions of a model's mechanism, by default its program's residuals, in the plant's symbols, by name.

    Equal mechanisms, such as copies that were pickled apart, have different symbols of the same names.
    """
    mechanism = model.reduction.mechanism
    expressions = program_residuals(model) if expressions is None else expressions
    if mechanism.q is plant.mechanism.q and mechanism.parameters is plant.mechanism.parameters:
        return dict(expressions)
    new, old = _symbols(plant.mechanism), _symbols(mechanism)
    both = [name for name in old if name in new]
    old, new = (ca.vertcat(*(symbols[name] for name in both)) for symbols in (old, new))
    return {name: ca.substitute(e, old, new) for name, e in expressions.items()}


def _symbols(mechanism):
    q, p = mechanism.q, mechanism.parameters
    return {s.name(): s for s in (q.t, *q, *q.gamma(1), *q.gamma(2))} | dict(zip(p.names, p.symbols, strict=True))


def _depends(expression, symbol):
    return bool(ca.depends_on(expression, symbol))
