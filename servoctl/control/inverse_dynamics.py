"""Inverse dynamics control: exact linearisation of a program on the measured state, with error dynamics by poles.

A residual is differentiated along the plant until an input appears, φ^(r) = b + D v. Where the decoupling matrix D has
rank ρ < k, ρ of these derivatives are made inputs by regular feedback, those that the other rows depend on become
states of the law (an integrator goes before each), and the others are differentiated on: the dynamic extension
algorithm of Descusse and Moog. Ranks are decided by numbers, at states about a plan.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from servoctl.checks import positive, whole
from servoctl.control.feedback import law_step
from servoctl.control.law import Law
from servoctl.control.reference import Reference, refuse_transport, require_plan
from servoctl.control.sampling import sampled_radii
from servoctl.errors import NotRealisable, SpecificationError, UnstableInternalDynamics, unknown
from servoctl.internal_dynamics import internal_dynamics
from servoctl.jets.evaluation import evaluate
from servoctl.jets.tape import Tape
from servoctl.methods.stability import sampled_bound
from servoctl.reduction.elimination import eliminate
from servoctl.reduction.knots import require_smooth
from servoctl.reduction.ranks import clean, decide, decide_all

RANK_POINTS, AWAY, SEED = 8, 0.02, 20240229  # states along the plan, and how far beside them ranks are decided
SHARE = 1e-9  # of the largest, in rows and columns of like size: entries below it are rounding
MOST_DERIVATIVES = 4  # derivatives, of the number of states, that may pass before an input appears
GROWN = 2.0  # by how much errors may grow along the plan, as by a passing eigenvalue that is hardly unstable
TIME_CONSTANT = 0.25  # s: a rise in about a second where several poles coincide, as cranes and arms of human size need


@dataclass(frozen=True)
class Linearisation:
    """What an exact linearisation consists of.

    Attributes
    ----------
    orders : dict of str to int
        For each residual the order n_i of its error dynamics: its relative degree, extension included.
    relative_degree : dict of str to int
        First derivative of each residual that holds an input.
    state_names : tuple of str
        The controller state ξ: derivatives of residuals that integrators prescribe.
    step : Compiled
        (t, [x; ξ], row) -> [u; ξ+] with row = [plant's numbers; Ts; what is added to u; coefficients of the error
        dynamics].
    """

    orders: dict
    relative_degree: dict
    state_names: tuple
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
    _require_invertible(mechanism, program, plant)
    extension = _Extension(plant, program.residuals, _points(plan, plant))
    while extension.rank() < len(program.residuals):
        extension.extend()
    return extension.law()


def _require_invertible(mechanism, program, plant):
    """Refuse a plant of another mechanism, and residuals that its state and inputs do not decide."""
    if plant.mechanism is not mechanism:
        raise SpecificationError(
            "The plant and the plan are made of two mechanisms.",
            "Exact linearisation inverts the plant that the program was written for.",
            do="Make the plant of the plan's mechanism, or use sv.lqr.",
        )
    high = [name for name, e in program.residuals.items() if mechanism.q.order(e) > 2]
    if high:
        raise SpecificationError(
            f"The residual {high[0]!r} has order {mechanism.q.order(program.residuals[high[0]])}.",
            "The plant's state and inputs decide derivatives up to γ''.",
            do="Use sv.lqr, which follows plans of any order.",
            name=high[0],
        )


def _points(plan, plant):
    """(t, x) at states of the plan, and the same somewhat beside it: two lists."""
    random = np.random.default_rng(SEED)
    times = np.linspace(plan.t[0], plan.t[-1], RANK_POINTS + 2)[1:-1]
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
        self.xi, self.xi_rate, self.state_names = ca.SX(0, 1), ca.SX(0, 1), []
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
            if len(level) > MOST_DERIVATIVES * self.x.numel():
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
        drift = ca.vertcat(*(self.levels[i][-1] for i in rows))
        drift = ca.substitute(drift, self.v[columns], ca.SX.zeros(len(columns)))
        held = self._needed(D, rows, columns, others)
        new = [ca.SX.sym(self._name(i)) for i in rows]
        solved, _ = eliminate(block, ca.vertcat(*new) - drift, clean(*self.values(block, beside=False)))
        self._substitute(self.v[columns], solved)
        inputs = []
        for i, symbol, integrated in zip(rows, new, held, strict=True):
            self.levels[i][-1] = symbol
            if integrated:
                following = ca.SX.sym(f"d{symbol.name()}")
                self.state_names.append(symbol.name())
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
        ranks = [generic, *(decide(values[:, :, k]) for k in range(values.shape[2]))]
        chosen = {(tuple(sorted(r.rows)), tuple(sorted(r.columns))) for r in ranks if r.rank == rank}

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
        out = [self.u + ahead, self._advanced(period)]
        step = law_step("computed", self.t, ca.vertcat(self.x, self.xi), row, out)
        orders = dict(zip(self.names, counts, strict=True))
        return Linearisation(orders, self.relative_degree, tuple(self.state_names), step)

    def _advanced(self, period):
        """ξ a period later, the measurement held: the series of ξ' in ξ, which ends for chains of integrators."""
        total, term, factor = self.xi, self.xi_rate, period
        for k in range(1, self.xi.numel() + 1):
            total += factor * term
            term = ca.jtimes(term, self.xi, self.xi_rate)
            factor *= period / (k + 1)
        return total


def computed(plan, plant, rate=100.0, poles=None, delay=0):
    """The actuation by the plant's equations at the measured state, with error dynamics by poles.

    Each residual obeys Π(D - λ_i) φ = 0 as long as the machine is the plant: φ is differentiated along the plant until
    the inputs decouple, through dynamic extension where their decoupling matrix has no full rank. Between samples the
    inputs are held, from `delay` samples after the measurement on: by how much the plan's actuation changes until the
    middle of that time is added.

    Parameters
    ----------
    plan : Run
        Ranks are decided about its states.
    plant : Plant
        What the controller believes of the machine, of the plan's mechanism, without transport delay.
    rate : float
        Samples per second [Hz].
    poles : float or dict of str to sequence of complex, optional
        One time constant T [s] (all poles at -1/T), default 0.25 s, or the poles [1/s] of each residual, as many as its
        relative degree with the extension (`law.info["orders"]`).
    delay : int
        Samples by which the loop will be late: the plan's actuation is taken as much ahead, and the poles are checked
        for it.

    Returns
    -------
    Law

    Raises
    ------
    UnstableInternalDynamics
        If what the program leaves free is unstable along the plan: linearisation would hide it, not stabilise it.
    SpecificationError
        If the sampled error dynamics are unstable with these poles at this rate, poles are of another number, or a path
        is not smooth enough: a lagging actuator's command holds one derivative more than the plan's actuation.
    NotRealisable
        If a residual depends on no input.
    """
    rate = positive("rate", rate)
    require_plan(plan, plant)
    refuse_transport(plant, "The linearisation is")
    delay = whole("delay", delay)
    _require_stable(plan)
    linear = linearise(plan, plant)
    _require_smooth(plan, linear.orders)
    poles = _poles(poles, linear.orders)
    for name, values in poles.items():
        _require_slow(name, values, rate, delay)
    coefficients = [np.poly(values).real[:0:-1] for values in poles.values() if len(values)]
    ahead = Reference(plan, plant, rate).ahead(delay)
    columns = ([plant.parameters, [1.0 / rate], u, *coefficients] for u in ahead.T)
    info = {"orders": linear.orders, "relative degree": linear.relative_degree, "poles": poles}
    info["error dynamics"] = ", ".join(f"{name} of order {order}" for name, order in linear.orders.items())
    return Law(
        name="computed", measures=plant.state_names, inputs=plant.inputs, rate=rate, t0=float(plan.t[0]),
        step=linear.step, schedule=np.column_stack([np.concatenate(column) for column in columns]),
        state=np.zeros(len(linear.state_names)), state_names=linear.state_names,
        initial_input=np.array([plan[name][0] for name in plant.inputs]), plan=plan, info=info,
    )  # fmt: skip


def _require_smooth(plan, orders):
    """Refuse paths that are less smooth than what is differentiated of them."""
    reduction = plan.model.reduction
    if reduction.timed and any(order > reduction.needs.get(name, 0) for name, order in orders.items()):
        require_smooth(reduction.switches, plan.model.parameters, orders, (plan.t[0], plan.t[-1]))


def _require_stable(plan):
    internal = internal_dynamics(plan.model, plan)
    if internal.verdict == "unstable" and internal.growth > GROWN:
        worst = float(internal.eigenvalues.real.max())
        raise UnstableInternalDynamics(
            f"The program leaves {len(internal.names)} states free ({', '.join(internal.names)}), with an eigenvalue "
            f"of {worst:.6g} 1/s along the plan.",
            "Exact linearisation makes them unobservable and does not stabilise them.",
            do="Use sv.lqr, which stabilises the whole state about the plan, or choose another output.",
            eigenvalue=worst,
            states=internal.names,
        )


def _poles(poles, orders):
    """Poles of each residual by name."""
    if poles is None or np.ndim(poles) == 0 and not isinstance(poles, dict):
        constant = TIME_CONSTANT if poles is None else positive("time constant", poles)
        return {name: np.full(order, -1.0 / constant) for name, order in orders.items()}
    if not isinstance(poles, dict):
        raise SpecificationError(
            f"poles={poles!r} was given.",
            "Poles are one time constant, or go by residual.",
            do="Give {" + ", ".join(f"{name!r}: {order} poles" for name, order in orders.items()) + "}.",
        )
    for name in poles:
        if name not in orders:
            raise unknown(name, orders, "residual")
    by_residual = {}
    for name, order in orders.items():
        try:
            values = np.atleast_1d(poles.get(name, ())).astype(complex)
        except (TypeError, ValueError):
            values = np.full(order, np.nan)
        if values.shape != (order,) or not np.isfinite(values).all() or not _paired(values):
            raise SpecificationError(
                f"The poles of {name!r} are {poles.get(name)!r}.",
                f"Its error dynamics have order {order}: as many poles, complex ones in conjugate pairs.",
                do=f"Give them, as {[-4.0] * order}.",
                name=name,
                order=order,
            )
        by_residual[name] = values
    return by_residual


def _paired(poles):
    """Whether complex poles come in conjugate pairs."""
    return np.allclose(np.sort_complex(poles), np.sort_complex(poles.conj()), rtol=1e-9, atol=0)


def _require_slow(name, poles, rate, delay):
    """Refuse poles whose error dynamics are unstable under a zero-order hold."""
    order = len(poles)
    if np.any(poles.real >= 0):
        mirrored = -np.abs(poles.real) + 1j * poles.imag
        raise SpecificationError(
            f"The poles of {name!r} are {poles}.",
            "Error dynamics decay where each pole has a negative real part.",
            nearest=f"{mirrored}." if np.all(poles.real) else "",
            do="Change the sign.",
            name=name,
        )
    radius = sampled_radius(poles, rate, delay) if order else 0.0
    if not radius < 1.0:
        fastest, bound = float(np.abs(poles).max()), sampled_bound(order, delay)
        late = f" with {delay} samples of delay" if delay else ""
        raise SpecificationError(
            f"The fastest pole of {name!r}, {fastest:.4g} 1/s, is sampled at {rate:g} Hz{late}: |p| Ts = "
            f"{fastest / rate:.4g}, and the held feedback multiplies errors by {radius:.4g} each sample.",
            f"{order} equal poles -p are stable under a zero-order hold{late} for p Ts < {bound:.4f}.",
            nearest=f"Poles slower than {bound * rate:.4g} 1/s, or a rate above {fastest / bound:.4g} Hz.",
            do="Change one of them.",
            name=name,
            bound=bound,
            radius=radius,
        )


def sampled_radius(poles, rate, delay=0):
    """The largest factor per sample of ρ integrators whose poles (ρ,) [1/s] are placed by held, delayed feedback."""
    n = len(poles)
    A, B, K = np.eye(n, k=1)[None], np.eye(n)[None, :, -1:], np.poly(poles).real[None, None, :0:-1]
    return float(sampled_radii(A, B, K, 1.0 / rate, np.array([delay / rate]))[0])
