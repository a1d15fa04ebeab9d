"""Taylor coefficients of a motion as one SX function (the scheme of Pryce and Nedialkov's DAETS).

At motion index κ row a contributes its Taylor coefficient κ - o_a, computed with γ_[κ] = 0, and
L γ_[κ] = -((κ - o_a)!/κ!) [ψ_a]_(κ - o_a): every coefficient of the motion by one solve with the same L.
"""

from math import factorial

import casadi as ca

from servoctl.codegen.function import compiled
from servoctl.jets.motion import Motion, shifted
from servoctl.jets.series import Series, is_zero
from servoctl.jets.tape import Tape
from servoctl.reduction.elimination import eliminate
from servoctl.reduction.ranks import clean


class _Group:
    """Rows of one order with their running series."""

    def __init__(self, motion, order, members, expressions):
        self.motion, self.order, self.members = motion, order, members
        self.symbols = ca.symvar(ca.vertcat(*expressions))
        self.inputs = [[] for _ in self.symbols]
        tape = Tape(self.symbols, expressions)
        self.series = Series(tape, self.inputs, self._decided(tape))

    def _decided(self, tape):
        """Values of what depends on time alone, at the instant by which branches are taken."""
        place = self.motion.q.where
        timed = [place(s) is None or place(s)[0] == "t" for s in self.symbols]
        at = [[self.motion.branch if (place(s) or ("",))[0] == "t" else s] for s in self.symbols]
        values, alone = Series(tape, at), []
        values.advance()
        for node in tape.nodes:
            alone.append(timed[node.data] if node.kind == "input" else all(alone[a] for a in node.args))
        return {i: values.c[i][0] for i, own in enumerate(alone) if own}

    def advance(self, k):
        """Coefficient k - order of the rows, from the motion's coefficients up to k."""
        for i, symbol in enumerate(self.symbols):
            self.inputs[i].append(self.motion.coefficient(symbol, k - self.order))
        self.series.advance()
        return [c[-1] for c in self.series.outputs]

    def correct(self, k):
        """The same again after γ_[k] was found."""
        j = k - self.order
        self.series.replace_last({i: self.motion.coefficient(s, j) for i, s in enumerate(self.symbols)})


class _Motion(Motion):
    """Coefficients of q and γ found so far."""

    def __init__(self, equations):
        super().__init__(equations.q)
        self.top, self.branch = equations.top, ca.SX.sym("t_branch")
        self.gamma = {k: [s / factorial(k) for s in self.q.gamma(k)] for k in range(1, self.top)}
        self.coordinates = {0: list(self.q)}
        moving = (self.q.V @ ca.vertcat(*self.q.gamma(1)) + self.q.h).elements()
        self.kinematics = None if self.q.plain else _Group(self, 1, range(self.q.nq), moving)
        for k in range(1, self.top):
            self._move(k)

    def _move(self, k):
        """q_[k] from q' = V w + h."""
        if self.q.plain:
            self.coordinates[k] = self.gamma[k]
        else:
            self.coordinates[k] = [c if is_zero(c) else c / k for c in self.kinematics.advance(k)]

    def guess(self, k):
        """γ_[k] = 0, and q_[k] as it then is."""
        self.gamma[k] = [0.0] * self.q.n
        self._move(k)

    def settle(self, k, gamma):
        """γ_[k] as found, and q_[k] with it."""
        self.gamma[k] = gamma
        if self.q.plain:
            self.coordinates[k] = gamma
        else:
            self.kinematics.correct(k)
            self.coordinates[k] = [c[-1] if is_zero(c[-1]) else c[-1] / k for c in self.kinematics.series.outputs]

    def coordinate(self, i, j):
        return self.coordinates[j][i]

    def velocity(self, i, level, j):
        return shifted(self.gamma[level + j][i], level, j)


def taylor_coefficients(equations, last):
    """Normalised Taylor coefficients of q and γ with index 1 .. last at a state.

    Parameters
    ----------
    equations : Equations
    last : int
        At least s̄ + 1.

    Returns
    -------
    casadi.Function
        Of (t, X, p) with the instant by which paths take their branches appended to p; outputs q_[1], ..., q_[last]
        (left out where q' = γ'), γ_[1], ..., γ_[last], guards.
    """
    r, q = equations.r, equations.q
    motion = _Motion(equations)
    groups = []
    for order in sorted({row.order for row in r.rows}):
        members = [a for a, row in enumerate(r.rows) if row.order == order]
        groups.append(_Group(motion, order, members, [r.rows[a].expression for a in members]))
        for k in range(order, equations.top):
            groups[-1].advance(k)
    numbers = clean(*r.points.matrix(r.leading))
    for k in range(equations.top, last + 1):
        motion.guess(k)
        right = [None] * q.n
        for group in groups:
            scale = -factorial(k - group.order) / factorial(k)
            for a, c in zip(group.members, group.advance(k), strict=True):
                right[a] = ca.SX(c) * scale
        solution, _ = eliminate(r.leading, ca.vertcat(*right), numbers)
        motion.settle(k, [0.0 if x.is_zero() else x for x in solution.elements()])
        for group in groups:
            group.correct(k)
    coefficients = [] if q.plain else [ca.SX(c) for k in range(1, last + 1) for c in motion.coordinates[k]]
    coefficients += [ca.SX(c) for k in range(1, last + 1) for c in motion.gamma[k]]
    outputs = [*coefficients, *(g for _, g in equations.guards)]
    return equations.function("taylor", equations.state, outputs, motion.branch)


def series_loop(model, last):
    """The compiled Taylor coefficients of a model with index up to `last`, with their loop.

    Parameters
    ----------
    model : Model
    last : int
        Highest index κ of the coefficients γ_[κ].

    Returns
    -------
    Compiled
    """

    def build():
        e, q = model.equations, model.reduction.mechanism.q
        sizes = {"nq": q.nq, "n": q.n, "top": e.top, "last": last, "plain": int(q.plain)}
        f = taylor_coefficients(e, last)
        return compiled(f, f"taylor_{last}", ("taylor",), project=e.project(), sizes=sizes)

    return model.once(f"taylor {last}", build)
