"""The companion of a program: of each row of order 3 or more, F minus F along the plan stands in its place.

A row ψ = D^k F + ρ(t) of such an order contains derivatives of the inputs: set to zero in the model, by dynamic
extension, it has no error that could be fed back. With e = F - F_plan it is ψ = e^(k), and e is fed back:

    F^(r) = F_plan^(r) - Σ_(j<n) c_j D^(j-n+r) e,    Π(D - λ_i) = D^n + Σ_(j<n) c_j D^j,    n >= max(k, r, 1),

where r is F's relative degree and negative powers of D are sums of e over the samples.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.checks import whole_of
from servoctl.codegen.function import compiled
from servoctl.control.residuals import Along, as_read, in_symbols_of, paths_along
from servoctl.control.sampling import discretised
from servoctl.errors import SpecificationError
from servoctl.jets.branches import without_turns
from servoctl.model.equations import Equations
from servoctl.model.model import Model

SUFFIX = " along the plan"  # of the reference that F follows
FASTEST, HALVINGS = 4.0, 50  # p·h at which every sampled loop is unstable; bisections
LONG = 24  # samples of delay, beyond which 1/(p·h) is linear in the delay up to 1e-3 of it


class Companion:
    """Rows that a law feeds back, in a plant's symbols, with coordinates `q` that have F along the plan as references.

    `rows` are expressions by name, `paths` of all references by name, `powers` the k by name: 0 for rows that are fed
    back themselves. Refuses rows of order 3 or more without F, and F without a value at instants t (N,) of the plan.
    """

    def __init__(self, plan, plant, t):
        model, (read, powers) = plan.model, as_read(plan.model)
        follow = {name + SUFFIX: Along(plan, read[name]) for name in powers}
        for name, row in read.items():
            if (order := model.reduction.mechanism.q.order(row)) > 2:
                raise SpecificationError(
                    f"The residual {name!r} has order {order}, and no F is known of which it is a derivative.",
                    "Set to zero in a model it would be no feedback; F minus F along the plan is what can be fed back.",
                    do=f"Use sv.lqr, which follows plans of any order, or state integrals={{{name!r}: F}}.",
                    name=name,
                    order=order,
                )
            if name in powers and (lost := ~np.isfinite(follow[name + SUFFIX].jets(t, 0)[0, 0])).any():
                raise SpecificationError(
                    f"What {name!r} is a derivative of has no value at t = {t[lost][0]:.6g} s of the plan.",
                    "It is fed back along the whole plan; a curvature has no value at a speed of zero.",
                    do="Follow the plan by sv.lqr, or begin it where the value is finite.",
                    name=name,
                    t=float(t[lost][0]),
                )
        rows = in_symbols_of(plant, model, read)  # in symbols that `beside` shares
        self.q = plant.mechanism.q.beside(**dict.fromkeys(follow))[0] if follow else plant.mechanism.q
        self.rows = rows | {n: without_turns(ca.SX(rows[n] - self.q.family.jet(n + SUFFIX, 0))) for n in powers}
        self.paths, self.powers = paths_along(model, plant) | follow, dict.fromkeys(rows, 0) | powers


def without_errors(plan):
    """The motion of a plan whose linearisation leaves out errors of F and of its k - 1 derivatives, as invariants.

    Its internal dynamics are those of the companion.
    """
    read, powers = as_read(plan.model)

    def held(model):
        equations, q = Equations(model.reduction), model.reduction.mechanism.q
        further = [(name, level[0]) for name, k in powers.items() for level in q.derivatives([read[name]], k - 1)]
        further = [(0, name, equations.of_state(level)) for name, level in further]
        equations.invariant_rows = [*equations.invariant_rows, *further]
        functions = {"invariants": compiled(equations.invariants(), "invariants")}
        functions["invariant names"] = [row[:2] for row in equations.invariant_rows]
        functions = model._functions | functions
        return Model(model.reduction, model._store, model.parameters, functions, paths=model.paths)

    models = {id(model): model for model in (plan.model, *(piece.model for piece in plan.steps))}
    models = {key: held(model) for key, model in models.items()}
    steps = tuple(replace(piece, model=models[id(piece.model)]) for piece in plan.steps)
    return replace(plan, model=models[id(plan.model)], steps=steps)


class Sums:
    """The sums of errors that a law feeds back, as parts of its step; made for an extension of a plant.

    `counts` are the numbers of poles by row. `now` has the sums of each row, as they are fed back, SX columns. Where
    accelerations are in a row, its error is the mean over the last sample: (w_k - w_(k-1))/Ts with w = γ', at the state
    in its middle. `limits` are the lowest and the highest input and its largest change, (m,) each, and `first` (m,) the
    inputs before the first command. `state` are symbols of the controller state, `names` their names, `start` its
    first values, `before` symbols of jets of references half a sample before, which are `jets`; `count` is the number
    of sums.
    """

    def __init__(self, extension, counts, period, limits, first):
        q = self._q = extension.q
        self._period, self._limits = period, limits
        self._within, self._velocities = ca.SX.sym("within"), ca.SX.sym("w_before", q.n)
        numbers = {name: counts[name] - r for name, r in extension.orders.items()}
        limited = bool(any(numbers.values()) and np.isfinite(limits[-1]).any())
        self._last = ca.SX.sym("u_before", len(first) * limited)
        rows = {name: row for name, row in extension.rows.items() if numbers[name] and q.order(row) == 2}
        self.jets = extension.jets(list(rows.values()))
        self.before = ca.SX.sym("before", len(self.jets))
        means, self.now, self._steps, sums = self._means(rows), [], [], {}
        for name, (e, *_) in zip(extension.names, extension.levels, strict=True):
            names = [f"integral{f' {i + 1}' * bool(i)} of {name}" for i in range(numbers[name])]
            now = ca.SX.sym("sums", len(names))
            sums |= zip(names, now.elements(), strict=True)
            step = period * ca.vertcat(ca.SX(0, 1), *[means.get(name, e), *now.elements()][: len(names)])
            if name in means:  # of the last sample; nothing at the first one, and while an input was at its limit
                now, step = now + ca.if_else(self._within, step, 0), 0 * step
            self.now.append(now)
            self._steps.append(step)
        w, names = extension.along[1][0][q.nq : q.nq + q.n], q.velocity_names * bool(means) + extension.inputs * limited
        self.names = [*["inputs within limits"] * bool(means), *(f"{name} before" for name in names), *sums]
        symbols = [self._within, self._velocities] * bool(means) + [self._last]
        self.state = ca.vertcat(ca.SX(0, 1), *symbols, *sums.values())
        self.start = [*[0.0, *w] * bool(means), *list(first) * limited, *np.zeros(len(sums))]
        self._measured, self._limited, self.count = bool(means), limited, len(sums)

    def _means(self, rows):
        """Rows by name with the mean accelerations of the last sample, at the state in its middle."""
        q, h, w = self._q, self._period, ca.vertcat(*self._q.gamma(1))
        middle = q.jet(0) - h / 2 * (q.V @ (3 * w + self._velocities) / 4 + q.h)
        old = ca.vertcat(q.t, q.jet(0), w, *q.gamma(2), self.jets.symbols)
        velocities, accelerations = (w + self._velocities) / 2, (w - self._velocities) / h
        new = ca.vertcat(q.t - h / 2, middle, velocities, accelerations, self.before)
        return {name: ca.substitute(row, old, new) for name, row in rows.items()}

    def after(self, command):
        """The next state: sums of errors are held while a command (m,) exceeds limits of size or of change."""
        low, high, change = np.nan_to_num(self._limits)  # the largest doubles in place of infinity
        acting = ca.fmin(ca.fmax(command, low), high)
        if self._limited:
            acting = ca.fmin(ca.fmax(acting, self._last - change), self._last + change)
        within = ca.sum1(ca.fabs(acting - command)) == 0
        held = [within, ca.vertcat(*self._q.gamma(1))] * self._measured + [acting] * self._limited
        sums = (now + ca.if_else(within, step, 0) for now, step in zip(self.now, self._steps, strict=True))
        return [*held, *sums]


# --- chains of integrators and sums under sampled feedback


def sampled_radius(poles, rate, delay=0, chain=None):
    """Spectral radius of feedback with poles (n,) [1/s] that is held and delayed.

    Of n integrators the last `chain`, default all, are those of the machine, exact under the hold; the others are sums
    over the samples, and so is the only one of a row of relative degree 0. The unit of time is that of the poles, and
    eigenvalues are those of changes over a sample: slow poles are all near 1.
    """
    n, unit = len(poles), np.exp(np.mean(np.log(np.abs(poles))))
    r, h = n if chain is None else max(chain, 1), unit / rate
    exact, held = (part[0] for part in discretised(np.eye(r, k=1)[None], np.eye(r)[None, :, -1:], h))
    change = np.eye(n + delay, k=-1) - np.eye(n + delay)
    change[:n] = h * np.eye(n, n + delay, k=1)
    change[n - r : n] = 0.0
    change[n - r : n, n - r : n] = exact - np.eye(r)
    command = np.append(-np.poly(poles / unit).real[:0:-1], np.zeros(delay))
    change[n : n + 1] = command - np.eye(1, n + delay, k=n)
    change[n - r : n] += held * (np.eye(n + delay)[-1] if delay else command)
    return float(np.abs(1.0 + np.linalg.eigvals(change)).max()) if np.isfinite(change).all() else np.inf


def fastest_poles(n, chain, delay):
    """The fastest n equal poles, as p h, that `sampled_radius` finds stable."""
    if delay > LONG:
        half, whole = (1 / fastest_poles(n, chain, samples) for samples in (LONG // 2, LONG))
        return 1 / (whole + (whole - half) * (delay - LONG) / (LONG // 2))
    low, high = 0.0, FASTEST
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if sampled_radius(np.full(n, -middle), 1.0, delay, chain) < 1 else (low, middle)
    return low


def sampled_bound(rho, delay=0):
    """The fastest poles that sampled feedback may place on a chain of integrators, as p·h.

    ρ equal poles -p are placed on a ρ-fold integrator, and the feedback is held for the period h: the loop is stable
    if and only if p·h is below this number.

    Parameters
    ----------
    rho : int
        Number of integrators ρ, at least 1.
    delay : int
        Delay of the feedback in samples: u_k = -K x_(k-delay).

    Returns
    -------
    float
        1, 0.6752, 0.5111, 0.4116 for ρ = 2, 3, 4, 5; with one sample of delay 0.4262, 0.2703, 0.1979, 0.1561.

    Raises
    ------
    SpecificationError
        If ρ is not a whole number from 1 to 12, or the delay not from 0 to 12.
    """
    return fastest_poles(whole_of("rho", rho, range(1, 13)), None, whole_of("delay", delay, range(13)))
