"""The Taylor method: coefficients of a motion as one SX function, compiled steps, dense output, jets of any order.

The coefficients follow the scheme of Pryce and Nedialkov's DAETS: at motion index κ row a contributes its Taylor
coefficient κ - o_a, computed with γ_[κ] = 0, and L γ_[κ] = -((κ - o_a)!/κ!) [ψ_a]_(κ - o_a): every coefficient of the
motion by one solve with the same L.
"""

from bisect import bisect_right
from dataclasses import replace
from functools import cache
from math import factorial, perm

import casadi as ca
import numpy as np

from servoctl.codegen.function import TAYLOR_COMPILED, Compiled, compiled
from servoctl.codegen.interpreted import weighted
from servoctl.codegen.paths import BY_INSTANT
from servoctl.dense import steps_of
from servoctl.jets.factors import constants_outside
from servoctl.jets.series import Motion, Series, is_zero, over, shifted
from servoctl.methods.choice import EXPLICIT, Project, RadauIIA
from servoctl.methods.edges import Edges
from servoctl.methods.independent import in_independent, solved_for
from servoctl.methods.motion import SAME_INSTANT, Stepping, breakpoints, interruptible, margin_at
from servoctl.methods.pieces import AT_ONCE, RESOLUTION, End, Tolerance, net
from servoctl.methods.rank import DEGRADED, Fine, Stretch, Weak
from servoctl.methods.sizes import from_start
from servoctl.model.equations import invariant_names
from servoctl.model.pivots import pivot_sizes
from servoctl.reduction.cascade import Running
from servoctl.values import frozen

LOWEST, HIGHEST = 4, 24  # orders: below, steps are too short; above, compiling grows faster than steps
INSIDE = np.array([0.07, 0.19, 0.34, 0.53, 0.71, 0.86, 0.98])  # parts of a step at which its series is checked
FAR_OFF = 30.0  # times the tolerance, which the equations may add to a series over its step
MANY_STEPS = 400  # of this length in the span, from which compiling an implicit method pays
LIMITED = 1.2  # times the longest stable steps: more of them are taken where accuracy limits them, not stability
MOST_DOUBTED = 50  # times that series did not meet the equations, after which they do not suit a motion
OF_PIECE = ca.SX.sym("t_of_piece")  # the instant that selects pieces of paths
SMALLEST = 1e-12  # of a piece: shorter steps are not halved, so that a jump of the equations is passed


class _Group(Running):
    """Rows of one order with their running series, which compute with numbers and parameters outside of them."""

    def __init__(self, motion, order, members, expressions):
        super().__init__(motion, order, expressions)
        constants = {i for i, symbol in enumerate(self.symbols) if motion.q.where(symbol) is None}
        self.members = members
        self.series = Series(constants_outside(self.series.tape, constants), self.series.inputs)


class _Motion(Motion):
    """Coefficients of q and γ up to an index."""

    def __init__(self, equations):
        super().__init__(equations.q)
        self.top, self.gamma = equations.top, {}
        self.coordinates = {0: list(self.q)}
        moving = (self.q.V @ ca.vertcat(*self.q.gamma(1)) + self.q.h).elements()
        self.kinematics = None if self.q.plain else _Group(self, 1, range(self.q.nq), moving)
        places = [self.q.where(e) if e.is_symbolic() else None for e in moving]
        self.velocities = {i: place[2] for i, place in enumerate(places) if place and place[0] == "w"}  # q_i' = γ_j'

    def _move(self, k):
        """q_[k] from q' = V w + h."""
        self._place(k, self.gamma[k] if self.q.plain else self.kinematics.advance())

    def _place(self, k, rates):
        """Set q_[k] from coefficient k - 1 of q', or γ_[k] itself."""
        coordinates = [c if is_zero(c) or self.q.plain else over(c, k) for c in rates]
        for i, j in self.velocities.items():
            coordinates[i] = self.gamma[k][j]
        self.coordinates[k] = coordinates

    def guess(self, k, solved):
        """Set γ_[k] to that of the state, and to zero where it is solved for, and q_[k] with it."""
        state = (s / factorial(k) for s in self.q.gamma(k)) if k < self.top else [0.0] * self.q.n
        self.gamma[k] = [0.0 if i in solved else s for i, s in enumerate(state)]
        self._move(k)

    def settle(self, k, gamma):
        """Set γ_[k] to the solution, and q_[k] with it."""
        self.gamma[k], rates = gamma, gamma
        if not self.q.plain:
            self.kinematics.repeat()
            rates = [c[-1] for c in self.kinematics.series.outputs]
        self._place(k, rates)

    def coordinate(self, i, j):
        return self.coordinates[j][i]

    def velocity(self, i, level, j):
        return shifted(self.gamma[level + j][i], level, j)


class _Rows:
    """The rows of a reduction along a motion, whose coefficients they give index by index.

    A stage is (rows, columns, pivots): the entries of γ_[k] that some rows give.
    """

    def __init__(self, equations):
        self.r, self.top, self.motion = equations.r, equations.top, _Motion(equations)
        self.solved = solved_for(equations)
        every = range(len(self.r.rows))
        self.rows, self.leading, self.stages = self.r.rows, self.r.leading, [(every, every, ())]
        reduced = in_independent(equations)
        if reduced:
            self.rows, self.leading, first = reduced
            self.stages = [first, self.solved[1]]
        self.groups = [_groups(self.motion, self.rows, rows) for rows, _, _ in self.stages]

    def advance(self, k):
        """γ_[k]: below s̄ from the state and the rows that determine a part of it, from s̄ on from all rows."""
        stages = self.stages if k >= self.top else self._below(k)
        if k:
            self.motion.guess(k, [j for _, columns, _ in stages for j in columns])
        for groups, (rows, columns, order) in zip(self.groups, stages, strict=True):
            groups = [group for group in groups if group.order <= k]
            right = _right(groups, k, rows)
            if len(rows):
                self._settle(k, columns, self._solution(rows, columns, order, right))
                for group in groups:
                    group.repeat()

    def _below(self, k):
        """The stages of index k < s̄."""
        rows, columns, order = self.solved.get(k, ([], [], ()))
        return [(rows, columns, order)] if len(self.stages) == 1 else [([], [], ()), (rows, columns, order)]

    def _settle(self, k, columns, solution):
        gamma = list(self.motion.gamma[k])
        for i, x in zip(columns, solution.elements(), strict=True):
            gamma[i] = 0.0 if x.is_zero() else x
        self.motion.settle(k, gamma)

    def _solution(self, rows, columns, order, right):
        matrix = self.leading[list(rows), list(columns)]
        return self.r.solved(matrix, right, order)[0]

    def by_rows(self, outputs):
        """Outputs with the velocities that rows determine in place of those of the state, which need not meet the rows.

        Leading matrices and pivots depend on them, and the solutions of a level on those of lower levels.
        """
        outputs = ca.vertcat(*outputs)
        for k, (_, columns, _) in sorted(self.solved.items(), reverse=True):
            given = ca.vertcat(*(self.motion.q.gamma(k)[i] for i in columns))
            if ca.depends_on(outputs, given):
                solution = ca.vertcat(*(ca.SX(self.motion.gamma[k][i]) * float(factorial(k)) for i in columns))
                outputs = ca.substitute(outputs, given, solution)
        return outputs.elements()


class _Reacting(_Motion):
    """A motion with coefficients of the multipliers μ."""

    def __init__(self, equations):
        super().__init__(equations)
        self.multipliers, self.mu = ca.SX.sym("mu", equations.r.realisation.B.shape[1]), []
        self.indices = {s.element_hash(): i for i, s in enumerate(self.multipliers.elements())}

    def coefficient(self, symbol, j):
        i = self.indices.get(symbol.element_hash())
        return super().coefficient(symbol, j) if i is None else self.mu[j][i]


def taylor_coefficients(equations, last):
    """Normalised Taylor coefficients of q and γ with index 1 .. last ≥ s̄ + 1 at a state, as a function of (t, X, p).

    p ends with the instant that selects the pieces of paths. Outputs are q_[1], ..., q_[last] (if q' ≠ γ'), γ_[1],
    ..., γ_[last], and pivots.
    """
    r = equations.r
    if r.cascade is not None:
        motion = r.cascade.along(r.points, equations.top - 1, last)
        return _coefficients(equations, motion.place, motion.gamma, last)
    if equations.range_space:
        motion = _with_multipliers(equations, last)
        return _coefficients(equations, motion.coordinates, motion.gamma, last)
    rows = _by_rows(equations, last)
    return _coefficients(equations, rows.motion.coordinates, rows.motion.gamma, last, rows.by_rows)


def _by_rows(equations, last):
    """The rows with their motion by L γ_[k] = ..."""
    rows = _Rows(equations)
    for k in range(last + 1):
        rows.advance(k)
    return rows


def _with_multipliers(equations, last):
    """The motion by M γ_[k] - B μ_[k-2] (k - 2)!/k! = ..., G γ_[k] = ..."""
    r, motion = equations.r, _Reacting(equations)
    for k in range(1, equations.top):
        motion.guess(k, ())
    rows = [row for row in r.rows if row.kind != "dynamics"]
    forces = (r.balance - r.realisation.B @ motion.multipliers).elements()
    groups, balance = _groups(motion, rows, range(len(rows))), _Group(motion, 2, range(len(forces)), forces)
    for group in groups:
        for _ in range(group.order, motion.top):
            group.advance()
    for k in range(2, last + 1):
        motion.guess(k, ())
        motion.mu.append([0.0] * len(motion.indices))
        gamma, mu, _ = r.realisation.solve(_right([balance], k, balance.members), _right(groups, k, range(len(rows))))
        motion.mu[-1] = (mu * float(k * (k - 1))).elements()
        motion.settle(k, [0.0 if x.is_zero() else x for x in gamma.elements()])
        for group in (*groups, balance):
            group.repeat()
    return motion


def _groups(motion, rows, places):
    """The rows at some places, by order."""
    members = {}
    for a in places:
        members.setdefault(rows[a].order, []).append(a)
    return [_Group(motion, order, some, [rows[a].expression for a in some]) for order, some in sorted(members.items())]


def _right(groups, k, places):
    """-((k - o)!/k!) ψ_[k-o] of the rows at some places, all in groups, with γ_[k] = 0."""
    right = {}
    for group in groups:
        scale = -factorial(k - group.order) / factorial(k)
        right |= {a: ca.SX(c) * scale for a, c in zip(group.members, group.advance(), strict=True)}
    return ca.vertcat(*(right[a] for a in places))


def _coefficients(equations, coordinates, gamma, last, finished=list):
    """What `taylor_coefficients` returns, from coefficients by index."""
    coefficients = [] if equations.q.plain else [ca.SX(c) for k in range(1, last + 1) for c in coordinates[k]]
    coefficients += [ca.SX(c) for k in range(1, last + 1) for c in gamma[k]]
    outputs = finished([*coefficients, *(g for _, g in equations.pivots)])
    return equations.function("taylor", equations.state, outputs, OF_PIECE, BY_INSTANT)


def settled(equations):
    """The state with the velocities that rows determine, and γ^(s̄), as a function of (t, X, p).

    Near the end of a step the series of these velocities errs more than what is integrated, its derivatives even more.
    """
    rows = _by_rows(equations, equations.top)
    gamma = [ca.SX(c) * float(factorial(k)) for k in range(1, equations.top + 1) for c in rows.motion.gamma[k]]
    outputs = rows.by_rows([*equations.q, *gamma])
    return equations.function("settled", equations.state, outputs, OF_PIECE, BY_INSTANT)


def series_loop(model, last):
    """The compiled Taylor coefficients of a model, up to γ_[last], with their loop."""

    def build():
        e, q = model.equations, model.reduction.mechanism.q
        solved = solved_for(e)
        sizes, others = {"nq": q.nq, "n": q.n, "top": e.top, "last": last, "plain": int(q.plain)}, {}
        if solved:
            free = (int(i not in solved.get(k, ((), (), ()))[1]) for k in range(1, e.top) for i in range(q.n))
            sizes, others = sizes | {"free": tuple(free)}, {"settled": settled(e)}
        others |= {name: model.function(given).expression for name, given in (("rates", "ode"), ("invariants",) * 2)}
        sizes |= {"invariants": len(invariant_names(model)), "rates": others["rates"].numel_out(0)}
        f = taylor_coefficients(e, last)
        return compiled(f, f"taylor_{last}", ("taylor",), project=e.project(), others=others, sizes=sizes)

    return model.once(f"taylor {last}", build)


def order_for(rtol):
    """The order of least work for a tolerance: 1 - ln(rtol)/2 (Jorba and Zou 2005), and four more.

    Their order counts operations as quadratic in it; here a step also has work that does not grow, and compiled
    operations of higher order wait less for each other.
    """
    return int(np.clip(np.ceil(5.0 - 0.5 * np.log(rtol)), LOWEST, HIGHEST))


def last_index(model, method):
    """The highest index of the coefficients that a Taylor method needs for its order and for its jets."""
    top = model.reduction.top
    order = order_for(method.rtol) if method.order is None else method.order
    return max(order + top - 1, max(method.jets or 0, top) + 1)


@cache
def _integrated_levels(free, n):
    """Entries of γ by the highest level at which they are integrated, 0 where only q is.

    `free` are 1 for each entry of γ', ..., γ^(s̄-1) that is integrated, else 0.
    """
    levels = np.array(free).reshape(-1, n)
    highest = (levels * np.arange(1, len(levels) + 1)[:, None]).max(axis=0)
    return {int(level): np.flatnonzero(highest == level) for level in np.unique(highest)}


class Unsuited(Exception):
    """A default does not suit a motion, for which its settings name another method."""

    def __init__(self, why, method):
        super().__init__(why)
        self.method = method


def leave_if_unsuited(steps, method, limit, t, x, interpreted):
    """Leave a motion to a method that suits it better, after steps with ends t (S + 1,) [s], which lead to x (n_x,).

    That is where stability limits them, or where the span takes many steps that are not compiled. A Jacobian that is
    long to compile is compiled only where stability asks for it, and the span takes more steps than it has operations.
    A motion that stays says that stability limits its steps. Pieces between switches have models of their own.
    """
    told = "stability" in steps.motion.note or steps.method not in ("Taylor", *EXPLICIT)
    if method is None and told:
        return
    length = abs(t[-1] - t[0]) / (len(t) - 1)
    like_last = steps.length / length
    like_all = steps.motion.counters["steps"] * steps.length / abs(t[-1] - steps.span[0]) if interpreted else 0.0
    if max(like_last, like_all) < MANY_STEPS:
        return
    operations = steps.model.function("ode_jacobian").operations if isinstance(method, RadauIIA) else 0
    last = t[-1:], x[:, None], steps.model.p[:, None], np.array([length])
    if stiff(steps.model, *last, np.copysign(steps.length, t[-1] - t[0]), limit)[0]:
        why = f"stability, not accuracy, limits the steps of {steps.method} to {abs(t[-1] - t[-2]):.2g} s"
        if method is not None and (operations <= TAYLOR_COMPILED or like_last >= operations):
            raise Unsuited(why, method)
        if not told:
            steps.motion.say(f"{why}, and its forces may err by far: try method='RadauIIA'")
    elif like_all > MANY_STEPS and 0 < operations <= TAYLOR_COMPILED and steps.family is None:
        raise Unsuited(f"its steps are compiled, and {steps.method} takes more than {MANY_STEPS} in Python", method)


def stiff(model, t, x, p, steps, span, limit):
    """Where stability limits steps of mean lengths (N,) [s] over a span [s]: of decaying modes up to |hλ| = limit.

    They lead to states x (n_x, N) at t (N,), with parameters p (n_p, N). A series of order p has a limit of about p/e.
    """
    many, result = np.flatnonzero(abs(span) >= MANY_STEPS * steps), np.zeros(len(steps), dtype=bool)
    jacobians = model.function("ode_jacobian").grid(t[many], x[:, many], p[:, many]).T.reshape(-1, len(x), len(x))
    known = np.isfinite(jacobians).all(axis=(1, 2))
    modes = np.linalg.eigvals(jacobians[known]) * np.sign(span)
    fastest = -modes.real.min(axis=1, initial=0.0, where=np.abs(modes.imag) < -modes.real)
    result[many[known]] = LIMITED * steps[many[known]] * fastest > limit
    return result


class TaylorSteps(Stepping):
    """One integration by the Taylor method, whose absolute tolerance is `atol`, not that of `method`.

    With atol (n_x,) in place of a number, entries of a level are compared in their own tolerances.
    """

    most = 100  # steps per call of the loop
    rank_lost = "the radius of convergence shrinks to nothing"
    advice = "Check whether the motion escapes or meets a point where it is not smooth."

    def __init__(self, model, drift, method, atol, progress):
        self.tolerances = method.rtol, atol
        self.every = drift.every if isinstance(drift, Project) else 0
        self.projects = self.every > 0
        self.settings, self.doubted = method, 0
        super().__init__(model, "Taylor", drift, progress)

    def _use(self, model):
        self.model, self.n_x, self.p = model, len(model.state_names), np.append(model.p, np.nan)
        self.last = last = last_index(model, self.settings)
        self.f, self.rates = series_loop(model, last), model.function("ode")
        self.most = AT_ONCE if self.f.too_long else type(self).most
        self.nq, self.n, self.top = model.nq, model.n, model.reduction.top
        self.plain = model.reduction.mechanism.q.plain
        self.n_c = (0 if self.plain else self.nq * last) + self.n * last

    def run(self, t0, x0, t1, t_eval, knots):
        """Integrate as `Stepping.run`: in one compiled call where nothing along the motion needs a decision."""
        with interruptible(self.motion):
            if self._in_one_call(t0, x0, t1, t_eval, knots):
                return self.motion
        return self.motion if self.motion.interrupted else super().run(t0, x0, t1, t_eval, knots)

    def _in_one_call(self, t0, x0, t1, t_eval, knots):
        """Take a motion whose steps and pivots are all in order; False if one of them must be inspected."""
        model, watched = self.model, (self.family, self.events)
        plain = not (self.every or self.settings.jets) and np.ndim(self.tolerances[1]) == 0
        if not plain or any(what is not None for what in watched):
            return False
        _, *ends = breakpoints((t0, t1), knots)
        to_knot = len(knots) > 0 and np.abs(np.subtract(knots, t1)).min() <= margin_at(t1, (t0, t1))
        p, net = np.append(model.p, np.nan), (INSIDE, abs(t1 - t0) / RESOLUTION * (1 + SAME_INSTANT), to_knot)
        task = t0, x0, ends if len(ends) > 1 else float(t1)
        whole = self.f.whole(task, p, self.tolerances, self.most, t_eval, net)
        if whole is None or len(whole[0]) > self.most:
            return False
        rows, jets, (farthest, longest, states, least, most, drifted) = whole
        if "settled" not in self.f.others:
            top = self.rates.grid(t_eval, jets[: self.n_x], model.p)[self.n_x - self.n : self.n_x]
            off = np.abs(top - jets[-self.n :])[:, ~np.isin(t_eval, [*ends[:-1], t1] if to_knot else ends[:-1])]
            farthest, jets[-self.n :] = np.maximum(farthest, off.max(axis=1, initial=0.0)), top
        if self._far_off(farthest, float(longest[0]), states) or not np.isfinite(farthest).all():
            return False
        if (least < DEGRADED * np.maximum(most, pivot_sizes(model))).any():
            return False
        log, tolerance = _Log(self.f, self.n_x, p, rows), Tolerance(model, x0, *self.tolerances)
        tolerance.accept(log.states)
        if (
            Edges(tolerance, abs(t1 - t0)).first(model, log.t, lambda: lambda k, t: log.jets(k, t, self.top - 1))
            is not None
        ):
            return False
        self.motion.fill(model, t_eval, jets)
        self.motion.largest, self.motion.drifted = states, float(drifted[0])
        self.motion.count(steps=len(rows) - 1, nfev=len(rows) - 1)
        self.motion.keep(model, rows[:, 0], self._dense(log), (np.nan,))
        self.progress(t1)
        return True

    def _ends(self, cuts):
        """The end alone: the compiled loop ends steps at knots."""
        self.ends, self.forward = np.array(cuts), 1.0 if cuts[-1] >= cuts[0] else -1.0
        return cuts[-1:]

    def _outputs(self, t, x):
        return self.f(t, x, self._on_piece(t))

    def _on_piece(self, t):
        """The parameters, and an instant of the pieces of paths that follow t."""
        k = min(max(self._next(t), 1), len(self.cuts) - 1)
        self.p[-1] = (self.cuts[k - 1] + self.cuts[k]) / 2
        return self.p

    def _until(self, a, b):
        """The cuts after a, and b, at which steps end."""
        ends = self.ends[self._next(a) : self._next(b)]
        return ends if len(ends) and ends[-1] == b else np.append(ends, b) if len(ends) else float(b)

    def _next(self, t):
        """The place of the first cut after t."""
        return bisect_right(self.cuts, self.forward * t, key=lambda cut: self.forward * cut)

    def _pivots_of(self, outputs):
        return outputs[self.n_c :]

    def _top(self, t, x):
        """Zeros for γ^(s̄): it only starts the search for other pivots, and its value would cost a series."""
        return np.zeros(self.n)

    def _piece(self, a, x, b, times):
        self._begin_piece(a, self._pivots(a, x))
        until = b
        while a != b and self.motion.stop is None:
            p, ends = self._on_piece(a), self._until(a, until)
            rows = self.f.taylor(a, x, ends, p, *self.tolerances, self.most, self.every)
            log = _Log(self.f, self.n_x, p, rows)
            taken, good = len(rows) - 1, self._believed(log, abs(b - a))
            if good < taken:
                self._doubt(log.t[good])
                until = (log.t[good] + log.t[good + 1]) / 2  # the next step ends there
                log = log.first(good)
            t, states = log.t, log.states
            failed, until = good == taken < self.most and t[-1] != until, until if good < taken else b
            if not (good or failed):
                continue
            outcome = self._inspected(self._stretch(log))
            fine, steps = isinstance(outcome, Fine), outcome.steps
            self.motion.count(steps=steps, nfev=steps)
            if isinstance(outcome, End) and outcome.event:  # which is the last sample
                times = np.union1d(times, outcome.t)[:: 1 if t[-1] >= t[0] else -1]
            times = self._sample(log, times, t[steps] if fine else outcome.t)
            if isinstance(outcome, End):
                self._turn(outcome, b)
                return outcome.t, outcome.x
            a, x = (outcome.t, outcome.x) if isinstance(outcome, Weak) else (t[steps], states[:, steps].copy())
            self.progress(a)
            if steps == self.most:
                order, method = self.last - self.top + 1, getattr(self.settings, "for_stiff", None)
                leave_if_unsuited(self, method, order / np.e, t, x, interpreted=self.f.too_long)
            if not fine:
                self._follow(outcome)
            elif failed:
                self._fail(a, x, "its steps vanish or are not finite")
        if len(times) and self.motion.stop is None:
            row = np.concatenate([[a], x, self._outputs(a, x)])
            self._sample(_Log(self.f, self.n_x, self._on_piece(a), np.array([row, row])), times, a)
        return a, x

    def _doubt(self, t):
        """Leave the motion to an adaptive method if its series have often missed the equations."""
        self.doubted += 1
        method = getattr(self.settings, "without_series", None)
        if method is not None and self.doubted > MOST_DOUBTED:
            raise Unsuited(f"near t = {t:.4g} s the equations are no series over the steps of {self.method}", method)

    def _believed(self, log, span):
        """The number of steps whose series meet the equations, at instants within them.

        A series at one state knows nothing of what is flat there, such as exp(-(100 (t - 3))²) at t = 0.
        """
        t, h, n = log.t, np.diff(log.t), self.n
        if not len(h):
            self.inside = np.zeros((len(log.outputs) - self.n_c, 0))
            return 0
        k, at, inside = self._instants(log)
        jets = log.jets(k, at, self.top)
        values = self.rates.grid(at, jets[: self.n_x], self.model.p)
        rates, pivots = values[self.n_x - n : self.n_x], values[self.n_x :]
        self.inside = np.repeat(log.outputs[self.n_c :], len(INSIDE), axis=1)
        self.inside[:, inside] = pivots[:, : inside.sum()]
        off, top = np.abs(rates - jets[-n:]), np.abs(jets[-n:])
        rtol, (atol, weights) = self.tolerances[0], weighted(self.tolerances[1])
        h, last, wrong = np.abs(h), self.f.sizes["last"], np.zeros(len(k), bool)
        farthest, states = off.max(axis=1), np.abs(from_start(self.model, log.states, self.x0)).max(axis=1)
        for level, (entries, largest) in self._far_off(farthest, h.max(), np.fmax(states, self.motion.largest)).items():
            part, missed, highest = perm(last, level) / perm(last, self.top - 1), off[entries], top[entries]
            if weights is not None and (level or self.plain):
                w = weights[self._level(level), None][entries]
                missed, highest = w * missed, w * highest
            part = h[k] ** (self.top - level) * part
            sizes = np.maximum(largest, (part * highest).max(axis=0))
            error = (part * missed).max(axis=0)
            wrong |= (error > FAR_OFF * (atol + rtol * sizes)) & (h[k] > SMALLEST * span)
        return int(k[wrong].min(initial=len(t) - 1))

    def _far_off(self, farthest, longest, states):
        """Levels at which series may miss the equations: entries of γ, and the largest state of the level.

        `farthest` (n,) is how far γ^(s̄) is off at most, `longest` the longest step, `states` (n_x,) the
        largest states, `from_start`.
        """
        rtol, (atol, weights), last, result = self.tolerances[0], weighted(self.tolerances[1]), self.f.sizes["last"], {}
        for level, entries in _integrated_levels(self.f.sizes.get("free", (1,) * (self.n_x - self.nq)), self.n).items():
            raised, part = self.top - level, perm(last, level) / perm(last, self.top - 1)
            state, missed = states[self._level(level)], farthest[entries]
            if weights is not None and (level or self.plain):
                w = weights[self._level(level)]
                state, missed = w * state, w[entries] * missed
            if not longest**raised * part * missed.max() <= FAR_OFF * (atol + rtol * state.max()):
                result[level] = entries, state.max()
        return result

    def _level(self, level):
        """The places in the state of q, or of γ^(level)."""
        return slice(self.nq + (level - 1) * self.n, self.nq + level * self.n) if level else slice(0, self.nq)

    def _instants(self, log):
        """Steps and instants in them at which series are compared with the equations; which of INSIDE these include."""
        t, h = log.t, np.diff(log.t)
        each, further, _ = net(t, self.length / RESOLUTION, 1)
        k = np.concatenate([np.repeat(np.arange(len(h)), len(INSIDE)), each])
        at = np.concatenate([(t[:-1, None] + INSIDE * h[:, None]).ravel(), further])
        within = at != t[k]
        if self.knots:  # where paths have other pieces
            within &= ~np.isin(at, [end for end in t.tolist() if end in self.knots])
        return k[within], at[within], within[: len(INSIDE) * len(h)]

    def _stretch(self, log):
        """The steps to be inspected, with the pivots at their ends and where their series were."""
        t, states, pivots = log.t, log.states, log.outputs[self.n_c :]
        n_g, count = pivots.shape
        inside = self.inside[:, : count * len(INSIDE)].reshape(n_g, count, len(INSIDE))
        ends = np.column_stack([pivots[:, 1:], self._pivots(t[-1], states[:, -1])]) if count else pivots
        every, parts = np.concatenate([inside, ends[:, :, None]], axis=2), np.append(INSIDE, 1.0)
        return Stretch(t, states, parts, every, lambda k, s: log.jets(k, s, self.top - 1), resumes=True)

    def _sample(self, log, pending, end):
        """Keep the steps, record the pending samples up to `end` and return those that remain."""
        t = log.t
        if len(t) < 2:
            return pending
        direction = 1.0 if t[-1] >= t[0] else -1.0
        dense = self._dense(log)
        self.motion.keep(self.model, t, dense, (np.nan,), end)
        due = direction * pending <= direction * end
        times = pending[due]
        if len(times):
            jets = dense(steps_of(t, times), times, self.p)
            self.motion.add(self.model, times, jets)
        return pending[~due]

    def _dense(self, log):
        """What gives the jets within the steps of a log."""
        by_rows, jets = "settled" in self.f.others, self.settings.jets or 0
        levels = max(jets, self.top - (not by_rows))
        # more accurate than as a derivative of the series
        rates = self.rates if levels < self.top or self.doubted else None
        return _Expanded(log, levels, by_rows, rates)


@frozen(eq=False)
class _Expanded:
    """Jets within the steps of a log, up to a level; γ^(s̄) by `rates`, where these are not None."""

    log: "_Log"
    levels: int
    by_rows: bool
    rates: object

    @property
    def nbytes(self):
        """Memory of the series."""
        return self.log.rows.nbytes

    def __call__(self, k, t, p):
        """Jets (n_z, N) at instants t (N,) within steps k (N,)."""
        n_x, n = self.log.n_x, self.log.f.sizes["n"]
        jets = replace(self.log, p=p).jets(k, t, self.levels, self.by_rows)
        if self.rates is None:
            return jets
        top = self.rates.grid(t, jets[:n_x], p[:-1])[n_x - n : n_x]
        return np.concatenate([jets[:n_x], top, jets[n_x + n :]])


@frozen
class _Log:
    """Steps of the method with the series at their starts, as `Compiled.taylor` returns them."""

    f: Compiled
    n_x: int
    p: np.ndarray
    rows: np.ndarray

    @property
    def t(self):
        """Ends of the steps (S + 1,) [s]."""
        return self.rows[:, 0]

    @property
    def states(self):
        """X (n_x, S + 1) there."""
        return self.rows[:, 1 : 1 + self.n_x].T

    @property
    def outputs(self):
        """Coefficients and pivots (n_y, S) at the starts."""
        return self.rows[:-1, 1 + self.n_x :].T

    def first(self, count):
        """The first steps alone."""
        return replace(self, rows=self.rows[: count + 1])

    def jets(self, k, t, top, by_rows=False):
        """Jets q, γ', ..., γ^(top) at times t (N,) in the steps k (N,), (nq + top n, N); see `Compiled.jets`."""
        return self.f.jets(self.rows, k, t, self.p, top, by_rows)
