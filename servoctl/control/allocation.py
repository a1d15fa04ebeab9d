"""Small quadratic programs that allocate inputs under limits, and what they need of a plant at a state."""

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import ServoError, SpecificationError, unknown

SOLVERS = ("daqp", "qrqp")
QUIET = {"daqp": {}, "qrqp": {"print_iter": False, "print_header": False, "print_info": False}}


class Effects:
    """What inputs do at once: o = c + O u for expressions that depend on accelerations.

    Parameters
    ----------
    plant : Plant
    expressions : dict of str to SX
        Outputs of the mechanism or residuals of a program, of t, q, γ' and γ''.

    Raises
    ------
    SpecificationError
        If an expression is not affine in the inputs.
    """

    def __init__(self, plant, expressions):
        self.names, self._plant = tuple(expressions), plant
        e = plant.equations
        values = ca.vertcat(ca.SX(0, 1), *expressions.values())
        values = ca.substitute(values, ca.vertcat(*e.q.gamma(2)), e.acceleration)
        values = ca.substitute(values, e.d, ca.SX.zeros(e.q.n))
        slopes = ca.jacobian(values, e.u)
        bent = ca.jacobian(ca.vec(slopes), e.u)
        if bent.nnz() and not plant.mechanism.is_zero(bent.nonzeros()):
            raise SpecificationError(
                f"One of {', '.join(self.names)} is not affine in the inputs.",
                "Bounds are linear inequalities of the inputs at each state.",
                nearest="Forces of constraint and accelerations, which are affine.",
                do="Bound another output.",
            )
        self._acting = [bool(slopes[i, :].nnz()) for i in range(len(self.names))]
        still = ca.substitute(values, e.u, ca.SX.zeros(e.u.numel()))
        numbers = e.p[: e.p.numel() - e.u.numel() - e.q.n]
        parts = ca.densify(ca.cse(ca.vertcat(still, ca.vec(ca.densify(slopes)))))
        self._function = compiled(ca.Function("effects", [e.q.t, e.state, numbers], [parts]), "effects")

    def acts(self, name):
        """Whether an input changes this expression at once."""
        return self._acting[self.names.index(name)]

    def __call__(self, t, x):
        """c (j,) and O (j, m) at a state.

        Parameters
        ----------
        t : float
            [s]
        x : (n_x,) array
        """
        j, m = len(self.names), len(self._plant.inputs)
        y = self._function(t, x, self._plant.parameters)
        return y[:j], y[j:].reshape(m, j).T


class SmallQP:
    """min xᵀH x/2 + gᵀx subject to low <= x <= high and least <= A x <= most.

    Parameters
    ----------
    n, rows : int
        Numbers of unknowns and of rows of A.
    solver : {"daqp", "qrqp"}
    """

    def __init__(self, n, rows, solver="daqp"):
        if solver not in SOLVERS:
            raise unknown(solver, SOLVERS, "solver of quadratic programs")
        shapes = {"h": ca.Sparsity.dense(n, n), "a": ca.Sparsity.dense(rows, n)}
        self._solve = ca.conic("qp", solver, shapes, {"error_on_fail": False} | QUIET[solver])

    def __call__(self, H, g, low, high, A, least, most):
        """The solution (n,), or None where there is none."""
        try:
            found = self._solve(h=H, g=g, a=A, lba=least, uba=most, lbx=low, ubx=high)
        except RuntimeError as error:  # CasADi's only type
            raise ServoError(
                f"The quadratic program failed: {str(error).splitlines()[0][:100]}.",
                "Its data are finite numbers.",
                do="Check weights and limits.",
            ) from error
        return np.asarray(found["x"]).ravel() if self._solve.stats()["success"] else None
