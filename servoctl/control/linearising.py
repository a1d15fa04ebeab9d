"""Exact linearisation of a program along its plant: Lie derivatives, and dynamic extension where inputs decouple late.

A residual is differentiated along the plant until an input appears, φ^(r) = b + D v. Where the decoupling matrix D has
rank ρ < k, ρ of these derivatives are made inputs by regular feedback, those that the other rows depend on become
states of the law (an integrator goes before each), and the others are differentiated on: the dynamic extension
algorithm of Descusse and Moog. Ranks are decided by numbers, at states about a plan.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from servoctl.control.feedback import law_step
from servoctl.errors import NotRealisable, SpecificationError
from servoctl.jets.evaluation import evaluate
from servoctl.jets.tape import Tape
from servoctl.reduction.elimination import eliminate
from servoctl.reduction.ranks import clean, decide, decide_all

POINTS, AWAY, SEED = 8, 0.02, 20240229  # states along the plan, and how far beside them ranks are decided
SHARE = 1e-9  # of the largest, in rows and columns of like size: entries below it are rounding
MOST = 4  # derivatives, of the number of states, that may pass before an input appears


@dataclass(frozen=True)
class Linearisation:
    """What an exact linearisation consists of.

    Attributes
    ----------
    orders : dict of str to int
        For each residual the order n_i of its error dynamics: its relative degree, extension included.
    relative_degree : dict of str to int
        First derivative of each residual that holds an input.
    memory_names : tuple of str
        What the law keeps: derivatives of residuals that integrators prescribe.
    step : Compiled
        (t, [x; ξ], row) -> [u; ξ+] with row = [plant's numbers; Ts; what is added to u; coefficients of the error
        dynamics].
    """

    orders: dict
    relative_degree: dict
    memory_names: tuple
    step: object


def linearise(plan, plant):
    """Exact linearisation of the plan's program by the inputs of a plant.

    Parameters
    ----------
    plan : Run
        Its program, and states about which ranks are decided.
    plant : Plant
        Of the same mechanism: what the law believes of the machine.

    Returns
    -------
    Linearisation

    Raises
    ------
    SpecificationError
        If a residual has an order above 2, or the plant is of another mechanism.
    NotRealisable
        If a residual depends on no input.
    """
    model = plan.model
    mechanism, program = model.reduction.mechanism, model.reduction.program
    _refuse(mechanism, program, plant)
    extension = _Extension(plant, program.residuals, _points(plan, plant))
    while extension.rank() < len(program.residuals):
        extension.extend()
    return extension.law()


def _refuse(mechanism, program, plant):
    if plant.mechanism is not mechanism:
        raise SpecificationError(
            "The plant and the plan are made of two mechanisms.",
            "Exact linearisation inverts the plant that the program was written for.",
            nearest="sv.plant(mechanism, m_load=115.0): other numbers of the same mechanism.",
            do="Make the plant of the plan's mechanism, or use `lqr`.",
        )
    high = [name for name, e in program.residuals.items() if mechanism.q.order(e) > 2]
    if high:
        raise SpecificationError(
            f"The residual {high[0]!r} has order {mechanism.q.order(program.residuals[high[0]])}.",
            "The plant's state and inputs decide derivatives up to γ''.",
            nearest="lqr(plan, plant, rate=...), which follows plans of any order.",
            do="Use it.",
            name=high[0],
        )


def _points(plan, plant):
    """(t, x) at states of the plan, and the same somewhat beside it: two lists."""
    random = np.random.default_rng(SEED)
    times = np.linspace(plan.t[0], plan.t[-1], POINTS + 2)[1:-1]
    states = np.array([plan.state(t) for t in times])
    size = np.maximum(np.abs(states).max(axis=0), 1.0)
    lagging = np.array([[np.interp(t, *_ascending(plan.t, plan[name])) for name in plant.lagged] for t in times])
    states = np.concatenate([states, lagging.reshape(len(times), -1)], axis=1)
    size = np.concatenate([size, np.maximum(np.abs(lagging).max(axis=0, initial=0.0), 1.0)[: lagging.shape[1]]])
    return times, states, states + AWAY * size * random.uniform(-1, 1, states.shape)


def _ascending(t, values):
    order = np.argsort(t)
    return t[order], values[order]


def _without_units(matrices):
    """Matrices (k, m, N) whose rows and columns are scaled, all by the same factors, so that entries are near 1."""
    largest = np.abs(matrices).max(axis=2).astype(float)
    rows, columns = np.nonzero(largest)
    k, m = largest.shape
    sums = np.zeros((len(rows), k + m))
    sums[range(len(rows)), rows] = sums[range(len(rows)), k + columns] = 1.0
    factors = np.exp(-np.linalg.lstsq(sums, np.log(largest[rows, columns]), rcond=None)[0])
    return matrices * np.multiply.outer(factors[:k], factors[k:])[:, :, None]


class _Extension:
    """A plant with integrators before some of its inputs, and its program's residuals differentiated along it."""

    def __init__(self, plant, residuals, points):
        e = plant.equations
        q, self.parameters = e.q, plant.parameters
        self.t, self.x, self.names, self.points = q.t, e.state, tuple(residuals), points
        self.numbers = e.p[: e.p.numel() - e.u.numel() - q.n]
        undisturbed = [ca.substitute(part, e.d, ca.SX.zeros(q.n)) for part in (e.state_rates, e.acceleration)]
        self.x_rate, acceleration = undisturbed
        self.v, self.u = ca.SX(e.u), ca.SX(e.u)  # new inputs, and the plant's inputs by them
        self.xi, self.xi_rate, self.memory_names = ca.SX(0, 1), ca.SX(0, 1), []
        jets = ca.vertcat(*q.gamma(2))
        self.levels = [[ca.substitute(ca.SX(residual), jets, acceleration)] for residual in residuals.values()]
        for level in self.levels:
            self._differentiate(level)
        self.relative_degree = {name: len(level) - 1 for name, level in zip(self.names, self.levels, strict=True)}

    def _rate(self, expression):
        """The total derivative along the extended plant."""
        held = ca.vertcat(self.t, self.x, self.xi)
        rate = ca.vertcat(1, self.x_rate, self.xi_rate)
        return ca.cse(ca.jtimes(expression, held, rate))

    def _differentiate(self, level):
        """Differentiate a residual's last level until an input appears in it."""
        while not np.any(clean(*self.values(ca.jacobian(level[-1], self.v)))):
            if len(level) > MOST * self.x.numel():
                name = self.names[self.levels.index(level)]
                raise NotRealisable(
                    f"No derivative of the residual {name!r} up to the order {len(level) - 1} holds an input.",
                    "A residual is realised by inputs that it depends on.",
                    do="Choose other residuals or actuators.",
                    name=name,
                )
            level[-1] = ca.substitute(level[-1], self.v, ca.SX.zeros(self.v.shape))  # names it, depends not on it
            level.append(self._rate(level[-1]))

    def values(self, matrix, beside=True):
        """Numbers of a matrix at the states beside the plan, or on it: values and sizes, (rows, columns, N)."""
        times, on, off = self.points
        states = off if beside else on
        random = np.random.default_rng(SEED + 1)
        xi = random.uniform(-1, 1, (len(times), self.xi.numel())) * beside
        v = np.zeros((len(times), self.v.numel()))
        numbers = np.tile(self.parameters, (len(times), 1))
        inputs = np.concatenate([times[:, None], states, xi, v, numbers], axis=1).T
        symbols = ca.vertcat(self.t, self.x, self.xi, self.v, self.numbers).elements()
        tape = Tape(symbols, ca.densify(ca.vec(matrix)).elements())
        shape = (matrix.shape[1], matrix.shape[0], len(times))
        return tuple(a.reshape(shape).swapaxes(0, 1) for a in evaluate(tape, inputs.astype(np.longdouble)))

    @property
    def decoupling(self):
        """D = ∂φ^(r)/∂v, (k, m) SX."""
        return ca.jacobian(ca.vertcat(*(level[-1] for level in self.levels)), self.v)

    def rank(self):
        """The rank of the decoupling matrix at states about the plan."""
        return decide_all(*self.values(self.decoupling))[0].rank

    def extend(self):
        """Make derivatives of ρ residuals inputs, with an integrator before those that other residuals depend on."""
        D = self.decoupling
        rows, columns = self._pivots(D)
        others = [i for i in range(D.shape[0]) if i not in rows]
        rest = [j for j in range(D.shape[1]) if j not in columns]
        block = D[rows, columns]
        own = ca.vertcat(*(self.levels[i][-1] for i in rows))
        own = ca.substitute(own, self.v[columns], ca.SX.zeros(len(columns)))
        held = self._needed(D, rows, columns, others)
        new = [ca.SX.sym(self._name(i)) for i in rows]
        solved, _ = eliminate(block, ca.vertcat(*new) - own, clean(*self.values(block, beside=False)))
        self._substitute(self.v[columns], solved)
        inputs = []
        for i, symbol, integrated in zip(rows, new, held, strict=True):
            self.levels[i][-1] = symbol
            if integrated:
                following = ca.SX.sym(f"d{symbol.name()}")
                self.memory_names.append(symbol.name())
                self.xi, self.xi_rate = ca.vertcat(self.xi, symbol), ca.vertcat(self.xi_rate, following)
                self.levels[i].append(following)
            inputs.append(following if integrated else symbol)
        self.v = ca.vertcat(*inputs, self.v[rest])
        for i in others:
            self._differentiate(self.levels[i])

    def _name(self, i):
        return f"{self.names[i]}_{len(self.levels[i]) - 1}"

    def _needed(self, D, rows, columns, others):
        """Which of the pivot rows' derivatives the other rows depend on."""
        values, sizes = self.values(D)
        best = decide_all(values, sizes)[1]
        numbers = _without_units(clean(values, sizes))[:, :, best].astype(float)
        shares = np.linalg.solve(numbers[np.ix_(rows, columns)].T, numbers[np.ix_(others, columns)].T)
        return np.abs(shares).max(axis=1) > SHARE * np.abs(shares).max()

    def _pivots(self, D):
        """Rows and columns of the regular block that stays best at the states of the plan."""
        rank = self.rank()
        values = _without_units(clean(*self.values(D, beside=False))).astype(float)
        generic = decide_all(_without_units(clean(*self.values(D))), 0.0)[0]
        found = [generic, *(decide(values[:, :, k]) for k in range(values.shape[2]))]
        chosen = {(tuple(sorted(r.rows)), tuple(sorted(r.columns))) for r in found if r.rank == rank}

        def worst(pair):
            blocks = values[np.ix_(*map(list, pair), range(values.shape[2]))]
            return np.abs(np.linalg.det(np.moveaxis(blocks, 2, 0))).min()

        rows, columns = max(sorted(chosen), key=worst)
        return list(rows), list(columns)

    def _substitute(self, old, new):
        """Replace symbols in everything that names them."""
        parts = [self.x_rate, self.u, self.xi_rate, *(e for level in self.levels for e in level)]
        parts = [ca.cse(ca.substitute(part, old, new)) for part in parts]
        self.x_rate, self.u, self.xi_rate = parts[:3]
        rest = iter(parts[3:])
        self.levels = [[next(rest) for _ in level] for level in self.levels]

    def law(self):
        """The linearisation, once the decoupling matrix has full rank."""
        D, counts = self.decoupling, [len(level) - 1 for level in self.levels]
        c = [ca.SX.sym(f"c_{name}", count) for name, count in zip(self.names, counts, strict=True)]
        tops = [ca.substitute(level[-1], self.v, ca.SX.zeros(self.v.shape)) for level in self.levels]
        errors = (ca.dot(ci, ca.vertcat(*level[:-1])) for ci, level in zip(c, self.levels, strict=True))
        wanted = -ca.vertcat(*(top + error for top, error in zip(tops, errors, strict=True)))
        square = D if D.shape[0] == D.shape[1] else D @ D.T
        solved = eliminate(square, wanted, clean(*self.values(square, beside=False)))[0]
        self._substitute(self.v, solved if square is D else D.T @ solved)
        period, ahead = ca.SX.sym("Ts"), ca.SX.sym("ahead", self.u.numel())
        row = ca.vertcat(self.numbers, period, ahead, *c)
        out = [self.u + ahead, self._memory(period)]
        step = law_step("computed", self.t, ca.vertcat(self.x, self.xi), row, out)
        orders = dict(zip(self.names, counts, strict=True))
        return Linearisation(orders, self.relative_degree, tuple(self.memory_names), step)

    def _memory(self, period):
        """ξ a period later, the measurement held: the series of ξ' in ξ, which ends for chains of integrators."""
        total, term, factor = self.xi, self.xi_rate, period
        for k in range(1, self.xi.numel() + 1):
            total += factor * term
            term = ca.jtimes(term, self.xi, self.xi_rate)
            factor *= period / (k + 1)
        return total
