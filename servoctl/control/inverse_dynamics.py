"""Inverse dynamics control: exact linearisation of a program on the measured state, with error dynamics by poles.

A residual is differentiated along the plant until an input appears, φ^(r) = b + D v. If the decoupling matrix D has
rank ρ < k, regular feedback makes ρ of these derivatives inputs. Those on which the other rows depend get an integrator
and become controller states, and the others are differentiated further: the dynamic extension algorithm of Descusse and
Moog. Where these rows change along the plan, as on a full turn of a vehicle, inputs get the integrators instead. Ranks
are decided by numbers, at states about a plan. Rows of order 3 and more are fed back by F (`companion`).
"""

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from servoctl.checks import as_complex, by_name, is_number, positive, whole
from servoctl.control.companion import Companion, Sums, fastest_poles, sampled_radius, without_errors
from servoctl.control.conditions import limits
from servoctl.control.feedback import law_step
from servoctl.control.law import Law
from servoctl.control.reference import Reference, of_plan, refuse_transport
from servoctl.control.residuals import in_symbols_of
from servoctl.errors import NotRealisable, SpecificationError, UnstableInternalDynamics
from servoctl.growth import internal_dynamics
from servoctl.jets.identity import spread, vanish
from servoctl.jets.tape import Tape, evaluate
from servoctl.plants.plant import Plant
from servoctl.reduction.ranks import clean, decide, decide_all, eliminate
from servoctl.reduction.realisation import desired_actuation
from servoctl.run import Run
from servoctl.spec.references import Jets

PLAN_POINTS = 129  # states of the plan at which a choice of rows must be regular
WEAK = 0.05  # of its largest size along the plan: a smaller determinant is no choice of rows
LEVEL_STEPS = 12  # Newton steps for the controller states on the plan
RANK_POINTS, AWAY, SEED = 8, 0.02, 20240229  # states for the ranks, and their distance from the plan
SHARE = 1e-9  # of the largest entry, in rows and columns of like size: smaller ones are rounding
RANK_LOST = 1e-6  # of the largest smallest singular value along the plan: below it the rank is lost
MOST_DELAY = 1000  # samples: the poles of a delayed loop are eigenvalues of a matrix of that size
MOST_DERIVATIVES = 4  # of the number of states: derivatives of a residual until an input appears
TIME_CONSTANT = 0.25  # s: several poles there rise in about a second, as suits cranes and arms of human size


def linearise(plan, plant, rows):
    """The extension that a plant needs for exact linearisation of a program; ranks are decided about the plan's states.

    `rows` is the program's `Companion`. Refuses residuals that depend on no input, or not in proportion.
    """
    along = np.linspace(plan.t[0], plan.t[-1], PLAN_POINTS)
    extension = _Extension(plant, rows, _points(plan, plant), (along, _plant_states(plan, plant, along)))
    reduction = plan.model.reduction
    split, wish = reduction.realisation.actuation, desired_actuation(reduction.mechanism, reduction.program)
    if split.shape[0] > split.shape[1] and reduction.mechanism.q.order(split) < 2:
        weights = [ca.SX(reduction.program.weights.get(name, 1.0)) for name in reduction.mechanism.actuators]
        parts = {"split": split, "wish": wish, "weights": ca.vertcat(*weights)}
        extension.share(**in_symbols_of(plant, plan.model, parts))
    while extension.rank() < len(extension.names):
        extension.extend()
    extension.require_rank()
    return extension


def _require_invertible(reduction, plant):
    """Refuse a plant of another mechanism."""
    if plant.mechanism != reduction.mechanism:
        raise SpecificationError(
            "The plant and the plan have different mechanisms.",
            "Exact linearisation inverts the mechanism of the program.",
            do="Make the plant of the plan's mechanism, or use sv.lqr.",
            plant=plant.mechanism.q.names,
            plan=reduction.mechanism.q.names,
        )


def _points(plan, plant):
    """Times (N,), states of the plan (N, n_x), and states somewhat beside it."""
    random = np.random.default_rng(SEED)
    times = np.linspace(plan.t[0], plan.t[-1], RANK_POINTS + 2)[1:-1]
    states = _plant_states(plan, plant, times)
    sizes = np.maximum(np.abs(states).max(axis=0), 1.0)
    return times, states, states + AWAY * sizes * random.uniform(-1, 1, states.shape)


def _plant_states(plan, plant, times):
    """States of a plant (N, n_x) along a plan."""
    lagging = [np.interp(times, plan.t, plan[name]) for name in plant.lagged]
    return np.column_stack([plan.state(times).T, *lagging])


def _without_units(matrices):
    """Matrices (k, m, N) with rows and columns scaled by factors common to all, so that entries are near 1."""
    largest = np.abs(matrices).max(axis=2).astype(float)
    rows, columns = np.nonzero(largest)
    k, m = largest.shape
    sums = np.zeros((len(rows), k + m))
    sums[range(len(rows)), rows] = sums[range(len(rows)), k + columns] = 1.0
    factors = np.exp(-np.linalg.lstsq(sums, np.log(largest[rows, columns]), rcond=None)[0])
    return matrices * np.multiply.outer(factors[:k], factors[k:])[:, :, None]


class _Extension:
    """A plant with integrators before some of its inputs, and its program's residuals differentiated along it.

    The controller state ξ, with the names `state_names`, are derivatives of residuals behind integrators, or inputs.
    `relative_degree` are the orders of the residuals without the extension.
    """

    def __init__(self, plant, rows, points, along):
        e = plant.equations
        self.q, self.rows, self._paths = rows.q, rows.rows, rows.paths
        q, self.powers, self.parameters, self.inputs = rows.q, rows.powers, plant.parameters, plant.inputs
        self.t, self.x, self.names, self.points, self.along = q.t, e.state, tuple(rows.rows), points, along
        self.numbers = e.p[: e.p.numel() - e.u.numel() - q.n]
        undisturbed = [ca.substitute(part, e.d, ca.SX.zeros(q.n)) for part in (e.state_rates, e.acceleration)]
        self.x_rate, acceleration = undisturbed
        self.v, self.u = ca.SX(e.u), ca.SX(e.u)  # new inputs, and the plant's inputs by them
        self.xi, self.xi_rate, self.state_names = ca.SX(0, 1), ca.SX(0, 1), []
        self.weights = None  # of inputs that share at the end
        self.turns = False  # whether the rows that see some inputs change along the plan
        jets = ca.vertcat(*q.gamma(2))
        self.levels = [[ca.substitute(ca.SX(row), jets, acceleration)] for row in self.rows.values()]
        for name, level in zip(self.names, self.levels, strict=True):
            self._require_affine(name, level[0])
            self._differentiate(level)
        self.relative_degree = self.orders

    @property
    def orders(self):
        """Orders of the error dynamics by residual: their relative degrees with the extension so far."""
        return {name: len(level) - 1 for name, level in zip(self.names, self.levels, strict=True)}

    @property
    def needed(self):
        """The least numbers of poles by residual: its relative degree, or the k of a row ψ = D^k F, at least one.

        Behind integrators or lags a row with accelerations is known by the model alone; one pole more measures it.
        """
        by_model = {name: self.q.order(row) > 1 for name, row in self.rows.items()}
        return {name: max(self.powers[name], r + (r > 0 and by_model[name]), 1) for name, r in self.orders.items()}

    def _require_affine(self, name, row):
        """Refuse a row whose accelerations do not enter in proportion."""
        bent = ca.hessian(row, self.v)[0].nonzeros()
        if bent and not vanish(spread(bent)).all():
            raise SpecificationError(
                f"{name!r} is not affine in the accelerations.",
                "What is fed back by accelerations is solved for the inputs, once and for all.",
                do="Use sv.lqr, which follows plans of any program.",
                name=name,
            )

    def require_rank(self):
        """Refuse a decoupling that loses its rank somewhere along the plan, for rows that are fed back by F.

        A square matrix does so between two points, too, where the sign of its determinant changes.
        """
        if not any(self.powers.values()):
            return
        times, states = self.along
        values = self._at(self.decoupling, times, states, self.controller_states(times, states))[0]
        matrices = np.moveaxis(_without_units(values).astype(float), 2, 0)
        sizes = np.linalg.svd(matrices, compute_uv=False)[:, -1]
        signs = np.sign(np.linalg.det(matrices)) if values.shape[0] == values.shape[1] else np.ones(len(times))
        lost, turned = ~(sizes > RANK_LOST * sizes.max()), signs[1:] != signs[:-1]
        if lost.any() or turned.any():
            where = times[[np.argmin(sizes)]] if lost.any() else times[np.argmax(turned) :][:2]
            raise SpecificationError(
                f"The decoupling matrix of {', '.join(self.names)} is singular "
                + ("at " if lost.any() else "between ")
                + " and ".join(f"t = {t:.6g} s" for t in where)
                + " of the plan.",
                "The decoupling matrix of what is fed back has full rank along the whole plan.",
                do="Use sv.lqr, which follows plans of any program, or keep the plan off this place.",
                names=self.names,
                t=float(where[0]),
            )

    def _rate(self, expression):
        """The total derivative along the extended plant."""
        jets = Jets(self.q, [expression])
        variables = ca.vertcat(self.t, self.x, self.xi, jets.symbols)
        rates = ca.vertcat(1, self.x_rate, self.xi_rate, jets.rates)
        return ca.cse(ca.jtimes(expression, variables, rates))

    def _differentiate(self, level):
        """Differentiate a residual's last level until an input appears in it."""
        while not np.any(clean(*self.values(ca.jacobian(level[-1], self.v)))):
            if len(level) > MOST_DERIVATIVES * self.x.numel():
                name = self.names[self.levels.index(level)]
                raise NotRealisable(
                    f"No derivative of the residual {name!r} up to order {len(level) - 1} depends on an input.",
                    "The inputs realise a residual through one of its derivatives.",
                    do="Choose other residuals or actuators.",
                    name=name,
                    order=len(level) - 1,
                )
            # v still occurs in the expression, in terms that cancel; ca.jtimes would carry it along
            level[-1] = ca.substitute(level[-1], self.v, ca.SX.zeros(self.v.shape))
            level.append(self._rate(level[-1]))

    def values(self, matrix, beside=True):
        """Values of a matrix at states beside the plan, or on it, and their sizes: (rows, columns, N) each."""
        times, on, off = self.points
        random = np.random.default_rng(SEED + 1).uniform(-1, 1, (len(times), self.xi.numel()))
        return self._at(matrix, times, *((off, random) if beside else (on, self.controller_states(times, on))))

    def _at(self, matrix, times, states, xi):
        v = np.zeros((len(times), self.v.numel()))
        numbers = np.tile(self.parameters, (len(times), 1))
        jets = self.jets([matrix])
        inputs = np.concatenate([times[:, None], states, xi, v, numbers, jets.at(times).T], axis=1).T
        symbols = ca.vertcat(self.t, self.x, self.xi, self.v, self.numbers, jets.symbols).elements()
        tape = Tape(symbols, ca.densify(ca.vec(matrix)).elements())
        shape = (matrix.shape[1], matrix.shape[0], len(times))
        return tuple(a.reshape(shape).swapaxes(0, 1) for a in evaluate(tape, inputs.astype(np.longdouble)))

    def controller_states(self, times, states):
        """ξ (N, n_ξ) at states (N, n_x) of the plan, where all residuals and their derivatives vanish."""
        xi = np.zeros((len(times), self.xi.numel()))
        if self.turns:
            levels = ca.vertcat(*(e for level in self.levels for e in level[:-1]))
            jets = self.jets([levels])
            symbols, r = [self.t, self.x, self.xi, self.numbers, jets.symbols], jets.at(times).T
            f = ca.Function("levels", symbols, [levels, ca.densify(ca.jacobian(levels, self.xi))])
            for k, (t, x) in enumerate(zip(times, states, strict=True)):
                for _ in range(LEVEL_STEPS):
                    values, slopes = f(t, x, xi[k], self.parameters, r[k])
                    xi[k] -= np.linalg.lstsq(np.array(slopes), np.array(values)[:, 0], rcond=None)[0]
        return xi

    def jets(self, expressions):
        """The jets of references in expressions, along the paths of the plan."""
        return Jets(self.q, expressions, self._paths)

    @property
    def decoupling(self):
        """D = ∂φ^(r)/∂v, (k, m) SX."""
        return ca.jacobian(ca.vertcat(*(level[-1] for level in self.levels)), self.v)

    def rank(self):
        """The rank of the decoupling matrix at states about the plan."""
        return decide_all(*self.values(self.decoupling))[0].rank

    def share(self, split, wish, weights):
        """Redundant actuators share as in the plan: the multipliers μ are the inputs, u = u_wish + split μ.

        Where some inputs get integrators in any case, the others share at the end.
        """
        if self.rank() < len(self.names) and self._choice()[-1]:
            self.wish, self.weights = wish, weights
            return
        v = ca.SX.sym("v", split.shape[1])
        self._substitute(self.v, wish + split @ v)
        self.v = v

    def _choice(self):
        """D, rows and columns of a regular block, which of these rows need integrators, and whether they turn."""
        D = self.decoupling
        rows, columns = self._pivots(D)
        integrated = self._needed(D, rows, columns, [i for i in range(D.shape[0]) if i not in rows])
        return D, rows, columns, integrated, bool(all(integrated)) and self._turns(D[rows, columns])

    def extend(self):
        """Make derivatives of ρ residuals inputs, with an integrator before those that other residuals depend on."""
        D, rows, columns, integrated, turns = self._choice()
        others = [i for i in range(D.shape[0]) if i not in rows]
        rest = [j for j in range(D.shape[1]) if j not in columns]
        if turns:
            self._integrate_inputs(D, columns, rest)
            return
        block = D[rows, columns]
        drift = ca.vertcat(*(self.levels[i][-1] for i in rows))
        drift = ca.substitute(drift, self.v[columns], ca.SX.zeros(len(columns)))
        new = [ca.SX.sym(f"{self.names[i]}_{len(self.levels[i]) - 1}") for i in rows]
        solved, _ = eliminate(block, ca.vertcat(*new) - drift, clean(*self.values(block, beside=False)))
        self._substitute(self.v[columns], solved)
        inputs = []
        for i, symbol, needed in zip(rows, new, integrated, strict=True):
            self.levels[i][-1] = symbol
            if needed:
                self.levels[i].append(self._integrated(symbol))
            inputs.append(self.xi_rate[-1] if needed else symbol)
        self.v = ca.vertcat(*inputs, self.v[rest])
        for i in others:
            self._differentiate(self.levels[i])

    def _integrated(self, symbol):
        """The rate of a new controller state."""
        rate = ca.SX.sym(f"d{symbol.name()}")
        self.state_names.append(symbol.name())
        self.xi, self.xi_rate = ca.vertcat(self.xi, symbol), ca.vertcat(self.xi_rate, rate)
        return rate

    def _turns(self, block):
        """Whether a regular block of the decoupling matrix loses its rank somewhere along the plan."""
        times, states = self.along
        values = self._at(block, times, states, self.controller_states(times, states))[0].astype(float)
        sizes = np.abs(np.linalg.det(np.moveaxis(_without_units(values), 2, 0)))
        return sizes.min() < WEAK * sizes.max()

    def _integrate_inputs(self, D, columns, rest):
        """Put integrators before the inputs of independent columns of D, w = v_c + K v_r with D_r = D_c K.

        The rows that see these inputs may change along the plan: no row is chosen.
        """
        self.turns = True
        new = [ca.SX.sym(f"extended_{self.xi.numel() + i}") for i in range(len(columns))]
        w, square = ca.vertcat(*new), D[:, columns].T @ D[:, columns]
        if rest:
            right = D[:, columns].T @ (D[:, rest] @ self.v[rest])
            w -= eliminate(square, right, clean(*self.values(square)))[0]
        self._substitute(self.v[columns], w)
        self.v = ca.vertcat(*(self._integrated(symbol) for symbol in new), self.v[rest])
        for level in self.levels:
            self._differentiate(level)

    def _needed(self, D, rows, columns, others):
        """Whether other rows depend on the derivative of a pivot row, (ρ,) bool."""
        values, sizes = self.values(D)
        best = decide_all(values, sizes)[1]
        numbers = _without_units(clean(values, sizes))[:, :, best].astype(float)
        shares = np.linalg.solve(numbers[np.ix_(rows, columns)].T, numbers[np.ix_(others, columns)].T)
        return np.abs(shares).max(axis=1) > SHARE * np.abs(shares).max()

    def _pivots(self, D):
        """Rows and columns of the regular block whose smallest determinant at states of the plan is largest."""
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
        """Replace symbols in all expressions of the extended plant."""
        parts = [self.x_rate, self.u, self.xi_rate, *(e for level in self.levels for e in level)]
        parts = [ca.cse(ca.substitute(part, old, new)) for part in parts]
        self.x_rate, self.u, self.xi_rate = parts[:3]
        rest = iter(parts[3:])
        self.levels = [[next(rest) for _ in level] for level in self.levels]

    def step(self, counts, limits, first):
        """The linearisation by a decoupling matrix of full rank: (t, [x; z], column) -> [u; z+].

        z is the controller state ξ and that of the `Sums`, to which the arguments are passed. The column is [plant's
        parameters; Ts; increment of u; coefficients of the error dynamics; jets of references; their jets half a sample
        before]. Returns the step, the former jets and the sums.
        """
        D, c = self.decoupling, [ca.SX.sym(f"c_{name}", n) for name, n in counts.items()]
        period, ahead = ca.SX.sym("Ts"), ca.SX.sym("ahead", self.u.numel())
        sums = Sums(self, counts, period, limits, first)
        tops = [ca.substitute(level[-1], self.v, ca.SX.zeros(self.v.shape)) for level in self.levels]
        chains = zip(c, sums.now, self.levels, strict=True)
        errors = [ca.dot(ci, ca.vertcat(*reversed(now.elements()), *level[:-1])) for ci, now, level in chains]
        target = -ca.vertcat(*(top + error for top, error in zip(tops, errors, strict=True)))
        self._substitute(self.v, self._solved(D, target))
        command = self.u + ahead
        outputs = [command, self._advanced(period), *sums.after(command)]
        jets = self.jets(outputs)
        column = ca.vertcat(self.numbers, period, ahead, *c, jets.symbols, sums.before)
        state = ca.vertcat(self.x, self.xi, sums.state)
        return law_step("computed", self.t, state, column, outputs), jets, sums

    def _solved(self, D, target):
        """v with D v = target: the only one, or the one of least norm, of the inputs if they still have to share."""
        if self.weights is None:
            # D Dᵀ needs no choice of pivots
            square = D if D.shape[0] == D.shape[1] and not self.turns else D @ D.T
            solved = eliminate(square, target, clean(*self.values(square, beside=False)))[0]
            return solved if square is D else D.T @ solved
        # least (u - u_wish)ᵀ W (u - u_wish) with u = u_0 + S v; its matrix is regular with DᵀD, as D v is given
        S, W = ca.jacobian(self.u, self.v), ca.diag(self.weights)
        normal = S.T @ W @ S + D.T @ D
        gradient = S.T @ W @ (self.wish - ca.substitute(self.u, self.v, ca.SX.zeros(self.v.shape)))
        both = eliminate(normal, ca.horzcat(gradient, D.T), clean(*self.values(normal)))[0]
        nearest, free = both[:, 0], both[:, 1:]
        square = D @ free
        return nearest + free @ eliminate(square, target - D @ nearest, clean(*self.values(square)))[0]

    def _advanced(self, period):
        """ξ a period later with x held: its Taylor series, which is finite for chains of integrators."""
        total, term, factor = self.xi, self.xi_rate, period
        for k in range(1, self.xi.numel() + 1):
            total += factor * term
            term = ca.jtimes(term, self.xi, self.xi_rate)
            factor *= period / (k + 1)
        return total


def computed(
    plan: Run,
    plant: Plant,
    rate: float = 100.0,
    poles: float | Mapping[str, Sequence[complex]] | None = None,
    delay: int = 0,
) -> Law:
    """Inverse dynamics at the measured state, with error dynamics by poles.

    Each residual obeys Π(D - λ_i) φ = 0 if the machine is the plant: φ is differentiated along the plant until the
    inputs decouple, with dynamic extension if their decoupling matrix is singular. A residual of order 3 or more is the
    k-th derivative of some F, and F minus F along the plan is in its place. Where accelerations are in what is fed
    back, they are the differences of measured velocities. The command is held from `delay` samples after the
    measurement on; the change of the plan's actuation until the middle of the hold is added.

    Parameters
    ----------
    plan : Run
        Ranks are decided about its states.
    plant : Plant
        The controller's model of the machine, of the plan's mechanism, without transport delay.
    rate : float
        Samples per second [Hz].
    poles : float or dict of str to sequence of complex, optional
        One time constant T [s] (all poles at -1/T), default 0.25 s, or the poles [1/s] by residual, as many as its
        relative degree with the extension, or as k, at least one (`law.info["orders"]`, the least number), or one more.
        Behind lags and integrators a residual with accelerations takes one pole more. As far as they are more than the
        relative degree, sums of errors are fed back, which stop while a command exceeds the limits of `plant`.
    delay : int
        Delay of the loop in samples, for which the poles are checked.

    Returns
    -------
    Law

    Raises
    ------
    UnstableInternalDynamics
        If the internal dynamics are unstable along the plan: linearisation would hide them, not stabilise them.
    SpecificationError
        If the sampled error dynamics are unstable, the number of poles is wrong, a residual of order 3 or more has no
        F, what is fed back has no value or no rank somewhere along the plan, or a path is not smooth enough: the
        command of a lagging actuator needs one derivative more than the plan's actuation.
    NotRealisable
        If a residual depends on no input.
    """
    plant = of_plan(plan, plant)
    reference = Reference(plan, plant, rate)
    refuse_transport(plant, "The linearisation is")
    delay = whole("delay", delay, most=MOST_DELAY)
    _require_invertible(plan.model.reduction, plant)
    rows = Companion(plan, plant, reference.t)
    internal = _stable(without_errors(plan) if any(rows.powers.values()) else plan)
    linear = linearise(plan, plant, rows)
    _require_smooth(plan, linear)
    orders, degrees = linear.needed, linear.orders
    poles = _poles(poles, orders)
    for name, values in poles.items():
        _require_slow(name, values, reference.rate, delay, degrees[name])
    coefficients = [np.poly(values).real[:0:-1] for values in poles.values()]
    state = linear.controller_states(*(values[:1] for values in linear.along))[0]
    counts = {name: len(values) for name, values in poles.items()}
    step, jets, sums = linear.step(counts, limits(plant, reference.period), reference.initial_input)
    state = np.append(state, sums.start)
    before = sums.jets.at(reference.t - reference.period / 2)
    rows = zip(reference.ahead(delay).T, jets.at(reference.t).T, before.T, strict=True)
    columns = ([plant.parameters, [reference.period], u, *coefficients, r, b] for u, r, b in rows)
    info = {"orders": orders, "relative degree": linear.relative_degree, "poles": poles}
    info["error dynamics"] = ", ".join(f"{name} of order {len(values)}" for name, values in poles.items())
    if internal.verdict == "neutral":
        info["free"] = f"{', '.join(internal.names)}: not fed back, free to drift"
    return Law(
        name="computed",
        measures=plant.state_names,
        inputs=plant.inputs,
        rate=reference.rate,
        t0=float(plan.t[0]),
        step=step,
        schedule=np.column_stack([np.concatenate(column) for column in columns]),
        state=state,
        state_names=(*linear.state_names, *sums.names),
        initial_input=reference.initial_input,
        plan=plan,
        info=info,
        integrators=tuple(range(len(state) - sums.count, len(state))),
    )


def _require_smooth(plan, linear):
    """Refuse paths with fewer derivatives than the error dynamics need."""
    reduction, q = plan.model.reduction, plan.model.reduction.mechanism.q
    for name, residual in reduction.program.residuals.items():
        for reference, k in Jets(q, [residual]).places:
            _require_class(plan, name, max(linear.orders[name] - linear.powers[name], 0) + k, reference)


def _require_class(plan, name, order, reference):
    """Refuse a path with fewer continuous derivatives than a residual's error dynamics need."""
    for has in range(-1, order):
        rough = plan.model.paths[reference].held().breaks_below(has + 1, plan.t[0], plan.t[-1])
        if not len(rough):
            continue
        raise SpecificationError(
            f"The path of {reference!r} in {name!r} needs C^{order}, has {f'C^{has}' if has >= 0 else 'a jump'} at "
            f"t = {rough[0]:.6g}.",
            f"The command contains its derivative {order}, which must be continuous.",
            do=f"Use sv.paths.rest_to_rest(..., smoothness={order}), or a spline of that class.",
            name=name,
            reference=reference,
            needs=order,
            has=has,
            t=float(rough[0]),
        )


def _stable(plan):
    """The internal dynamics of a plan; refuses those that are not known to be stable."""
    internal = internal_dynamics(plan)
    if internal.verdict not in ("unstable", "inconclusive"):
        return internal
    worst, names = float(internal.eigenvalues.real.max(initial=-np.inf)), ", ".join(internal.names)
    facts = {"verdict": internal.verdict, "growth": internal.growth, "eigenvalue": worst, "states": internal.names}
    raise UnstableInternalDynamics(
        f"The internal dynamics of {names} are inconclusive: {internal.cause}."
        if internal.verdict == "inconclusive"
        else f"The internal dynamics of {names} are unstable: along the plan errors grow by {internal.growth:.3g} in "
        f"{internal.length:.3g} s (frozen eigenvalues up to {worst:.6g} 1/s).",
        "Exact linearisation makes them unobservable and does not stabilise them.",
        do="Use sv.lqr, which stabilises the whole state about the plan, or choose another output.",
        **facts,
    )


def _poles(poles, orders):
    """Poles of each residual by name."""
    if poles is None or is_number(poles):
        constant = TIME_CONSTANT if poles is None else positive("time constant", poles)
        return {name: np.full(order, -1.0 / constant) for name, order in orders.items()}
    if not isinstance(poles, dict):
        raise SpecificationError(
            f"poles is {repr(poles)[:150]}.",
            "It is one time constant [s], or poles by residual.",
            do="Pass {" + ", ".join(f"{name!r}: {order} poles" for name, order in orders.items()) + "}.",
            orders=orders,
        )
    poles, by_residual = by_name(poles, orders, "residual", "The poles"), {}
    for name, order in orders.items():
        values = as_complex(poles.get(name, ()))
        if values.shape not in ((order,), (order + 1,)) or not np.isfinite(values).all() or not _paired(values):
            raise SpecificationError(
                f"The poles of {name!r} are {poles.get(name)!r}.",
                f"It takes {order} or {order + 1} poles; complex ones in pairs.",
                do=f"Pass {order}, as {[-4.0] * order}.",
                name=name,
                order=order,
            )
        by_residual[name] = values
    return by_residual


def _paired(poles):
    """Whether the set of poles is its own conjugate."""
    return np.allclose(np.sort_complex(poles), np.sort_complex(poles.conj()), rtol=1e-9, atol=0)


def _require_slow(name, poles, rate, delay, degree):
    """Refuse poles whose error dynamics, of a relative degree, are unstable under a zero-order hold."""
    order = len(poles)
    if np.any(poles.real >= 0):
        mirrored = -np.abs(poles.real) + 1j * poles.imag
        raise SpecificationError(
            f"The poles of {name!r} are {poles}.",
            "Error dynamics decay where each pole has a negative real part.",
            nearest=f"{mirrored}." if np.all(poles.real) else "",
            do="Choose poles in the left half plane.",
            name=name,
            poles=poles,
        )
    radius = sampled_radius(poles, rate, delay, degree)
    if not radius < 1.0:
        fastest, bound = float(np.abs(poles).max()), fastest_poles(order, degree, delay)
        late = f" with {delay} samples of delay" if delay else ""
        raise SpecificationError(
            f"The fastest pole of {name!r}, {fastest:.4g} 1/s, is sampled at {rate:g} Hz{late}: |p| Ts = "
            f"{fastest / rate:.4g}, and the held feedback multiplies errors by {radius:.4g} each sample.",
            f"{order} equal poles -p are stable under a zero-order hold{late} for p Ts < {bound:.4f}.",
            nearest=f"Poles slower than {bound * rate:.4g} 1/s, or a rate above {fastest / bound:.4g} Hz.",
            do="Change one of them.",
            name=name,
            pole=fastest,
            rate=rate,
            bound=bound,
            radius=radius,
        )
