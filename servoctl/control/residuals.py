"""Residuals of a program as functions of a plant's state, matched by name."""

from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from servoctl.checks import named, rows_read
from servoctl.codegen.function import compiled
from servoctl.codegen.paths import Followed
from servoctl.errors import SpecificationError, unknown
from servoctl.jets.branches import without_turns
from servoctl.model.jets import extended
from servoctl.spec.integrals import integrals
from servoctl.spec.references import Jets, function_of, orders_in


def _require_order(name, orders, order, valid):
    """Refuse a name without a residual, or of one whose order is too high; `valid` has all orders by name."""
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


class Residuals:
    """Residuals of a model's program at the states and parameters of a plant.

    A residual of order 3 or more, which is the k-th derivative of F and a function of time, is read by F. `names`
    selects some, and may name outputs of the mechanism and states: their residual, as that of F, is the deviation from
    the plan, without whole turns of angles. `order` is the highest: 1 for functions of the state (q, γ'), 2 with
    accelerations; None for all, of F again the deviation.
    `rows` are residuals by name in place of the program's.

    Attributes
    ----------
    names, orders : tuple
        Names and orders of the residuals.
    order : int
        The order of the jets that they take, which are at least accelerations where `order` is None.
    expressions, symbols : SX, list of SX
        The residuals in the plant's symbols, and the parameters on which they depend, followed by values along the
        plan and by jets of references.
    places : tuple of int
        Indices of these parameters among those of the plant.
    parameters : (n_p,) array
        The plant's numbers of these parameters, 0 for values along the plan and for jets of references.
    jets : Jets
        The jets of references, which `expression` takes as numbers: laws have them in their schedule.
    planned : tuple of str
        Names of the residuals that are deviations from the plan.
    integrated : dict of str to str
        The rows, by name of the residuals, that are read by F.
    measures : tuple of str
        The states on which the residuals depend.
    """

    def __init__(self, model, plant, names=None, order=1, rows=None):
        mechanism = model.reduction.mechanism
        residuals, powers = as_read(model) if rows is None else (rows, {})
        q, planned, along, integrated = mechanism.q, _planned(mechanism), {}, {name: name for name in powers}
        if names is not None:  # which are signals, or else rows
            read = rows_read(residuals, mechanism.signals)
            integrated = {name: row for name, row in read.items() if row in powers}
            along = {name: ca.SX.sym(f"plan {name}") for name in (*planned, *integrated) if name in names}
            rows = {name: residuals[row] for name, row in read.items()}
            valid = {name: q.order(e) for name, e in (rows | planned).items()}
            residuals = {name: (rows | planned)[name] for name in valid if name in names}
        elif order is None:
            along = {name: ca.SX.sym(f"plan {name}") for name in powers}
        orders = {name: q.order(e) for name, e in residuals.items()}
        self.order = order = max(2, *orders.values()) if order is None else order
        for name in names or ():
            _require_order(name, orders, order, valid)
        self.names = tuple(name for name in orders if orders[name] <= order)
        self.orders = tuple(max(orders[name], 0) for name in self.names)
        chosen = in_symbols_of(plant, model, {name: residuals[name] for name in self.names})
        self._read = ca.vertcat(*chosen.values())  # angles without the planned ones may be whole turns off
        self.expressions = ca.vertcat(
            *(without_turns(ca.SX(e - along[name])) if name in along else e for name, e in chosen.items())
        )
        self._q, self._state = plant.mechanism.q, plant.equations.state
        parameters = plant.mechanism.parameters.symbols
        self.places = tuple(i for i, s in enumerate(parameters) if ca.depends_on(self.expressions, s))
        self.paths = paths_along(model, plant)
        self.jets = Jets(self._q, [self.expressions], self.paths)
        self.symbols = [*(parameters[i] for i in self.places), *along.values(), *self.jets.symbols.elements()]
        self.parameters = np.append(plant.parameters[list(self.places)], np.zeros(len(along) + len(self.jets)))
        self.planned = tuple(along)
        self.integrated = {name: row for name, row in integrated.items() if name in self.names}
        states = zip(plant.state_names, self._state.elements(), strict=True)
        self._measured = {name: s for name, s in states if ca.depends_on(self.expressions, s)}
        self.measures, self._built = tuple(self._measured), {}

    def expression(self, t, y, measures, p):
        """φ as an SX column of the symbols t, y (named by `measures`) and p."""
        old = [self._q.t, *self._measured.values(), *self.symbols]
        new = [t, *(y[measures.index(name)] for name in self.measures), *ca.vertsplit(p)]
        return ca.substitute(self.expressions, ca.vertcat(*old), ca.vertcat(*new))

    def _function(self, name, outputs):
        """A compiled function of (t, states, p), with accelerations below the states for order 2."""
        if name not in self._built:
            x = ca.vertcat(self._state, *(s for k in range(2, self.order + 1) for s in self._q.gamma(k)))
            y, p = ca.densify(ca.cse(ca.vertcat(*outputs()))), self.symbols[: len(self.symbols) - len(self.jets)]
            f = function_of(self._q, self._names, name, x, ca.vertcat(ca.SX(0, 1), *p), y)
            self._built[name] = compiled(f, name)
        return self._built[name]

    @cached_property
    def _names(self):
        return tuple(orders_in(self._q, [self.expressions]))

    @cached_property
    def _p(self):
        """The parameters of compiled functions, after the place of the paths that references follow."""
        numbers = self.parameters[: len(self.parameters) - len(self.jets)]
        if not self._names:
            return numbers
        self._followed = Followed([self.paths[name].held() for name in self._names])
        return np.append(self._followed.address, numbers)

    def levels(self, t, x, plan):
        """Residuals, and the derivative of those of order 0: (2, N) and (1, N) arrays by name.

        `x` (n_x, N) are states of the plant at t (N,); for order 2 and more with the further jets below the states. Of
        those read by F it is F minus F along the plan.
        """
        counts = [1 if n in self.integrated else max(2 - k, 1) for n, k in zip(self.names, self.orders, strict=True)]

        def outputs():
            items = zip(self.expressions.elements(), counts, strict=True)
            return [level[0] for e, count in items for level in self._q.derivatives([e], count - 1)]

        numbers, planned = self._p[: len(self._p) - len(self.planned), None], self.along(plan, t).values()
        p = np.vstack([np.tile(numbers, len(t)), *planned])
        values = self._function("residual_levels", outputs).grid(t, x, p)
        ends = np.cumsum([0, *counts])
        return {n: values[a:b] for n, a, b in zip(self.names, ends[:-1], ends[1:], strict=True)}

    def along(self, plan, t):
        """F along a plan by name, (N,) each."""
        read = as_read(plan.model)[0]
        return {name: Along(plan, read[row]).jets(t, 0)[0, 0] for name, row in self.integrated.items()}

    def jacobian(self, t, x):
        """∂φ/∂x along states of the plant, (N, k, n_x)."""

        def outputs():
            return [ca.vec(ca.densify(ca.jacobian(self._read, self._state)))]

        values = self._function("residual_jacobian", outputs).grid(t, x, self._p)
        return values.reshape(self._state.numel(), len(self.names), len(t)).transpose(2, 1, 0)


class Along:
    """An expression F along a plan as the path of a reference: values and derivatives of any order at any instant."""

    def __init__(self, plan, F):
        self._plan, self._F = plan, F

    def held(self):
        """Itself: outside the plan it is held."""
        return self

    def jets(self, t, order):
        """Derivatives 0 to `order`, (order + 1, 1, N), at times (N,)."""
        plan, model, mechanism = self._plan, self._plan.model, self._plan.model.reduction.mechanism
        q, p = mechanism.q, ca.vertcat(ca.SX(0, 1), *mechanism.parameters.symbols)
        levels = ca.vertcat(*(level[0] for level in q.derivatives([self._F], order)))
        symbols, jets = ca.vertcat(*(q.jet(i) for i in range(q.order(levels) + 1))), Jets(q, [levels], model.paths)
        t, places = np.unique(np.clip(t, *plan.span), return_inverse=True)
        z, size = plan.at(t), symbols.numel()
        if len(z) < size:
            z = np.hstack([extended(one, t[inside], z[:, inside], size) for one, inside in plan.by_model(t)])
        f = ca.Function("along", [q.t, symbols, p, jets.symbols], [levels])
        return np.array(f(t[None], z[:size], model.parameters, jets.at(t)))[:, None, places]


def paths_along(model, plant):
    """The paths of all references of a program at a plant, by name: of its own it has other paths, as parameters."""
    return model.paths | plant.paths


def _planned(mechanism):
    """What may be compared with its value along a plan, by name: states and outputs."""
    states = {s.name(): s for s in (*mechanism.q, *mechanism.q.gamma(1))}
    return states | mechanism.outputs


@lru_cache(32)
def known_residuals(model, plant):
    """All residuals, whose functions are derived once for a model and a plant."""
    return Residuals(model, plant, order=None)


def as_read(model):
    """Residuals of a model's program, or their F in their place, and k by name of the latter."""
    q, program, residuals = model.reduction.mechanism.q, model.reduction.program, program_residuals(model)
    found = integrals(q, program)
    return residuals | found, {name: q.order(residuals[name]) - q.order(F) for name, F in found.items()}


def program_residuals(model):
    """Residuals of the program of a model, by name; of a plant under inputs those that it reports."""
    return model.reduction.program.residuals or model.reduction.mechanism.reported


def in_symbols_of(plant, model, expressions=None):
    """Expressions of a model's mechanism, by default its program's residuals, in the plant's symbols, by name.

    Equal mechanisms, such as copies that were pickled apart, have different symbols of the same names. What the plant
    does not have is refused.
    """
    mechanism = model.reduction.mechanism
    expressions = program_residuals(model) if expressions is None else expressions
    if mechanism.q is plant.mechanism.q and mechanism.parameters is plant.mechanism.parameters:
        return dict(expressions)
    every = ca.vertcat(ca.SX(0, 1), *map(ca.vec, expressions.values()))
    new, old = (_symbols(one, max(2, mechanism.q.order(every))) for one in (plant.mechanism, mechanism))
    names = [name for name, symbol in old.items() if ca.depends_on(every, symbol)]
    for name in names:
        named(name, new, "state or parameter of the plant")
    jets, family = Jets(mechanism.q, [every]), plant.mechanism.q.family
    for name, _ in jets.places:
        named(name, family.names, "reference of the plant's coordinates")
    old = ca.vertcat(*(old[name] for name in names), jets.symbols)
    new = ca.vertcat(*(new[name] for name in names), *(family.jet(*place) for place in jets.places), ca.SX(0, 1))
    return {name: ca.substitute(e, old, new) for name, e in expressions.items()}


def _symbols(mechanism, order):
    q, p = mechanism.q, mechanism.parameters
    jets = (s for k in range(1, order + 1) for s in q.gamma(k))
    return {s.name(): s for s in (q.t, *q, *jets)} | dict(zip(p.names, p.symbols, strict=True))
