"""Step functions of laws, from expressions: u = u_ff - K (y - y_ref) - K_i z, with residuals summed in z."""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError, unknown


def law_step(name, t, x, row, outputs):
    """A compiled step function of a law, from expressions.

    Parameters
    ----------
    name : str
        A C identifier.
    t : SX
        Symbol of the instant t_k.
    x, row : (n,) SX
        Symbols of measurement and memory, and of the law's numbers at the sample.
    outputs : sequence of SX
        Command, next memory, further signals.

    Returns
    -------
    Compiled
        (t_k, [y; z], row_k) -> [u; z+; further signals], with the C function that loops take.
    """
    y = ca.densify(ca.cse(ca.vertcat(*outputs)))
    return compiled(ca.Function(name, [t, x, row], [y], ["t", "x", "p"], ["y"]), name, ("law",))


def affine_law(measures, n_u, feedback=True, residuals=None):
    """u = u_ff - K (y - y_ref) - K_i z,  z+ = z + Ts φ(t, y).

    Parameters
    ----------
    measures : tuple of str
        Names of the measured states y.
    n_u : int
        Number of inputs.
    feedback : bool
        Without it the law is u_ff alone.
    residuals : Residuals, optional
        What is integrated.

    Returns
    -------
    Compiled
        Its row is [u_ff; y_ref; K row by row; K_i row by row; Ts; parameters of φ], of which it has what it needs.
    """
    t, u_ff = ca.SX.sym("t"), ca.SX.sym("u_ff", n_u)
    if not feedback:
        return law_step("feedforward", t, ca.SX.sym("x", 0), u_ff, [u_ff])
    n_y = len(measures)
    n_z = len(residuals.names) if residuals else 0
    y, z, y_ref = ca.SX.sym("y", n_y), ca.SX.sym("z", n_z), ca.SX.sym("y_ref", n_y)
    K, K_i = ca.SX.sym("K", n_y, n_u), ca.SX.sym("K_i", n_z, n_u)
    u = u_ff - K.T @ (y - y_ref) - K_i.T @ z
    row = [u_ff, y_ref, ca.vec(K), ca.vec(K_i)]
    if not n_z:
        return law_step("affine", t, y, ca.vertcat(*row), [u])
    period, p = ca.SX.sym("Ts"), ca.SX.sym("p", residuals.parameters.size)
    phi = residuals.expression(t, y, measures, p)
    return law_step("affine", t, ca.vertcat(y, z), ca.vertcat(*row, period, p), [u, z + period * phi])


def estimating_law(states, where, n_u, residuals=None):
    """An affine law on an estimated state.

    δx⁺ = δx̂ + L (y - y_ref - C δx̂),  u = u_ff - K δx⁺ - K_i z,  δx̂+ = A δx⁺ + B δu,  z+ = z + Ts φ(t, x_ref + δx⁺).

    Parameters
    ----------
    states : tuple of str
        Names of the plant's states.
    where : sequence of int
        Which of them are measured.
    n_u : int
        Number of inputs.
    residuals : Residuals, optional
        What is integrated.

    Returns
    -------
    Compiled
        Its row is [u_ff; x_ref; K, K_i, L, A, B row by row; Ts; parameters of φ].
    """
    n_x, n_y, n_z = len(states), len(where), len(residuals.names) if residuals else 0
    t, y, estimate, z = (ca.SX.sym("t"), *(ca.SX.sym(s, n) for s, n in (("y", n_y), ("e", n_x), ("z", n_z))))
    u_ff, x_ref = ca.SX.sym("u_ff", n_u), ca.SX.sym("x_ref", n_x)
    shapes = {"K": (n_u, n_x), "K_i": (n_u, n_z), "L": (n_x, n_y), "A": (n_x, n_x), "B": (n_x, n_u)}
    symbols = {name: ca.SX.sym(name, columns, rows) for name, (rows, columns) in shapes.items()}  # transposed
    K, K_i, L, A, B = (matrix.T for matrix in symbols.values())
    corrected = estimate + L @ (y - x_ref[where] - estimate[where])
    du = -K @ corrected - K_i @ z
    row = [u_ff, x_ref, *map(ca.vec, symbols.values())]
    outputs = [u_ff + du, A @ corrected + B @ du]
    if n_z:
        period, p = ca.SX.sym("Ts"), ca.SX.sym("p", residuals.parameters.size)
        row += [period, p]
        outputs.append(z + period * residuals.expression(t, x_ref + corrected, states, p))
    return law_step("estimating", t, ca.vertcat(y, estimate, z), ca.vertcat(*row), outputs)


class Residuals:
    """Residuals of a program as functions of a plant's state, matched by name.

    Parameters
    ----------
    model : Model
        Of the plan.
    plant : Plant
        Its states and parameters are used: what the controller believes of the machine.
    names : sequence of str, optional
        Which residuals; default all whose order allows it.
    order : int
        The highest: 1 for functions of the state (q, γ'), 2 where accelerations are given beside it.

    Raises
    ------
    NameUnknown
        If a residual is none of the program's, or needs a state or a parameter that the plant lacks.
    SpecificationError
        If a residual that was named depends on accelerations.
    """

    def __init__(self, model, plant, names=None, order=1):
        mechanism, program = model.reduction.mechanism, model.reduction.program
        self._q = mechanism.q
        orders = {name: self._q.order(e) for name, e in program.residuals.items()}
        for name in names or ():
            if name not in orders:
                raise unknown(name, orders, "residual")
            if orders[name] > order:
                raise SpecificationError(
                    f"The residual {name!r} has order {orders[name]}.",
                    "A residual that is fed back is a function of the state (q, γ').",
                    nearest=", ".join(repr(n) for n, order in orders.items() if order <= 1),
                    do="Leave it out.",
                    name=name,
                )
        self.names = tuple(name for name in orders if orders[name] <= order and (names is None or name in names))
        self.orders = tuple(max(orders[name], 0) for name in self.names)
        self._expressions = ca.vertcat(*(program.residuals[name] for name in self.names))
        own = plant.mechanism.parameters
        self._symbols = [s for s in mechanism.parameters.symbols if _depends(self._expressions, s)]
        for s in self._symbols:
            if s.name() not in own.names:
                raise unknown(s.name(), own.names, "parameter of the plant")
        self.parameters = np.array([plant.parameters[own.names.index(s.name())] for s in self._symbols])
        self.measures = tuple(s.name() for s in self._states(self._expressions))
        for name in self.measures:
            if name not in plant.state_names:
                raise unknown(name, plant.state_names, "state of the plant")
        self._plant, self._order = plant, order
        self._built = {}

    def _states(self, expression):
        return [s for s in (*self._q, *self._q.gamma(1)) if _depends(expression, s)]

    def expression(self, t, y, measures, p):
        """φ as an SX column of the symbols t, y (named by `measures`) and p."""
        found = self._states(self._expressions)
        old = [self._q.t, *found, *self._symbols]
        new = [t, *(y[measures.index(s.name())] for s in found), *ca.vertsplit(p)]
        return ca.substitute(self._expressions, ca.vertcat(*old), ca.vertcat(*new))

    def _function(self, key, outputs):
        if key not in self._built:
            state = ca.vertcat(*self._q, *(s for k in range(self._order) for s in self._q.gamma(k + 1)))
            p = ca.vertcat(*self._symbols) if self._symbols else ca.SX(0, 1)
            y = ca.densify(ca.cse(ca.vertcat(*outputs(state))))
            self._built[key] = compiled(ca.Function(key, [self._q.t, state, p], [y]), key)
        return self._built[key]

    def _ordered(self, x):
        """States, and accelerations where they are given, in the plan's order, from an array in the plant's."""
        names = (*self._q.names, *(name for k in range(self._order) for name in self._q.jet_names(k + 1)))
        own = (*self._plant.state_names, *self._plant.mechanism.q.jet_names(2))
        rows = [own.index(name) if name in own else -1 for name in names]
        return np.where(np.array(rows)[:, None] < 0, 0.0, x[rows])

    def levels(self, t, x):
        """Residuals and those of their derivatives that the state decides.

        Parameters
        ----------
        t : (N,) array
        x : (n_x, N) array
            States of the plant; for residuals of order 2 with accelerations behind them, (n_x + n, N).

        Returns
        -------
        dict of str to (levels, N) array
            Two levels for a residual of order 0, one for the others.
        """

        def outputs(_state):
            items = self._expressions.elements()
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
            return [ca.vec(ca.densify(ca.jacobian(self._expressions, state)))]

        values = self._function("residual_jacobian", outputs).grid(t, self._ordered(x), self.parameters)
        values = values.reshape(-1, k, len(t)).transpose(2, 1, 0)
        found = np.zeros((len(t), k, self._plant.n_x))
        for i, name in enumerate((*self._q.names, *self._q.jet_names(1))):
            if name in self._plant.state_names:
                found[:, :, self._plant.state_names.index(name)] = values[:, :, i]
        return found


def _depends(expression, symbol):
    return bool(ca.depends_on(expression, symbol))
