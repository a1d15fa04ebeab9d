"""The companion of a program: of each row of order 3 or more, F minus F along the plan stands in its place.

A row ψ = D^k F + ρ(t) of such an order contains derivatives of the inputs: set to zero in the model, by dynamic
extension, it has no error that could be fed back. With e = F - F_plan it is ψ = e^(k), and e is fed back:

    F^(r) = F_plan^(r) - Σ_(j<n) c_j D^(j-n+r) e,    Π(D - λ_i) = D^n + Σ_(j<n) c_j D^j,    n >= max(k, r, 1),

where r is F's relative degree and negative powers of D are sums of e over the samples.
"""

from dataclasses import replace

import casadi as ca
import numpy as np

from servoctl.control.residuals import as_read, in_symbols_of, paths_along, program_residuals
from servoctl.control.sampling import spectral_radii
from servoctl.errors import SpecificationError
from servoctl.methods.stability import FASTEST, HALVINGS
from servoctl.model.jets import extended
from servoctl.model.model import derive
from servoctl.spec.integrals import integrals
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.paths.scipy_paths import as_path
from servoctl.spec.program import Program
from servoctl.spec.references import Jets
from servoctl.values import frozen

SUFFIX = " along the plan"  # of the reference that F follows
NODES = 257  # of the path of F along a plan: within pieces of a 256th of it the path is as smooth as the plan


@frozen(eq=False)
class Companion:
    """Rows that a law feeds back, in a plant's symbols, with coordinates that have F along the plan as references.

    `rows` are expressions by name, `paths` of all references by name, `powers` the k by name: 0 for rows that are fed
    back themselves; `of_plan` gives F along the plan by row.
    """

    q: object
    rows: dict
    paths: dict
    powers: dict
    of_plan: dict

    def require_finite(self, t):
        """Refuse an F that has no value somewhere along the plan, at instants (N,)."""
        for name, along in self.of_plan.items():
            lost = ~np.isfinite(along.jets(t, 0)[0, 0])
            if lost.any():
                raise SpecificationError(
                    f"What {name!r} is a derivative of has no value at t = {t[lost][0]:.6g} s of the plan.",
                    "It is fed back along the whole plan; a curvature has no value at a speed of zero.",
                    do="Follow the plan by sv.lqr, or begin it where the value is finite.",
                    name=name,
                    t=float(t[lost][0]),
                )

    def run_of(self, plan, order):
        """The motion of a plan under the program of these rows, whose internal dynamics have no error of any F.

        F along the plan is a path of class `order`, through its values at instants of the plan.
        """
        from scipy.interpolate import BPoly

        model, t = plan.model, np.unique(np.append(np.linspace(*plan.span, NODES), plan.knots))
        reduction, names = model.reduction, {name: f"{name}{SUFFIX}" for name in self.of_plan}
        paths = {
            names[name]: as_path(BPoly.from_derivatives(t, along.jets(t, order)[:, 0].T), smoothness=order)
            for name, along in self.of_plan.items()
        }
        q, followed = reduction.mechanism.q.beside(**paths)
        rows = reduction.program.residuals | as_read(model)[0]
        rows |= {name: rows[name] - followed[names[name]] for name in names}
        mechanism = object.__new__(Mechanism)
        vars(mechanism).update(vars(reduction.mechanism) | {"q": q})
        program = Program(rows, reduction.program.by, jumps=True)
        program.weights, program.toward, program.metric = (
            getattr(reduction.program, part) for part in ("weights", "toward", "metric")
        )
        with_numbers = dict(zip(mechanism.parameters.names, model.parameters, strict=False))
        found = derive(mechanism, program).with_parameters(**with_numbers)
        found = found.with_references(**{name: path for name, path in model.paths.items() if name in found.paths})
        return replace(
            plan.sampled(np.linspace(*plan.span, 4 * NODES)),
            model=found,
            jets=plan.at(np.linspace(*plan.span, 4 * NODES))[: len(found.jet_names)],
            jet_names=found.jet_names,
            variants=(),
            steps=(),
            start=None,
        )


def companion(plan, plant):
    """The `Companion` of a plan's program; refuses rows of an order above 2 without F."""
    model, paths = plan.model, paths_along(plan.model, plant)
    own, (read, powers) = model.reduction.mechanism.q, as_read(model)
    for name, row in read.items():
        if own.order(row) > 2:
            raise SpecificationError(
                f"The residual {name!r} has order {own.order(row)}, and no F is known of which it is a derivative.",
                "Set to zero in a model it would be no feedback; F minus F along the plan is what can be fed back.",
                do=f"Use sv.lqr, which follows plans of any order, or state integrals={{{name!r}: F}} in the Program.",
                name=name,
                order=own.order(row),
            )
    rows, of_plan = in_symbols_of(plant, model, read), {name: Along(plan, name) for name in powers}
    follow = {name + SUFFIX: along for name, along in of_plan.items()}
    q = plant.mechanism.q.beside(**dict.fromkeys(follow))[0] if follow else plant.mechanism.q
    rows = {name: row - q.family.jet(name + SUFFIX, 0) if name in powers else row for name, row in rows.items()}
    return Companion(q, rows, paths | follow, {name: powers.get(name, 0) for name in rows}, of_plan)


class Along:
    """F of a row along a plan as the path of a reference: values and derivatives of any order at any instant."""

    def __init__(self, plan, name):
        self._plan, self._name, self._functions = plan, name, {}

    def held(self):
        """Itself: outside the plan it is held."""
        return self

    def jets(self, t, order):
        """Derivatives 0 to `order`, (order + 1, 1, N), at times (N,)."""
        plan, model = self._plan, self._plan.model
        if order not in self._functions:
            self._functions[order] = self._derivatives(order)
        t, (f, jets) = np.clip(t, *plan.span), self._functions[order]
        ascending = np.argsort(t)
        z, size = plan.at(t[ascending]), f.size1_in(1)
        z = z[:size] if len(z) >= size else extended(model, t[ascending], z, size)
        values = np.empty((order + 1, 1, len(t)))
        values[:, 0, ascending] = f(t[None, ascending], z, model.parameters, jets.at(t[ascending]))
        return values

    def _derivatives(self, order):
        """A function (t, jets, parameters, jets of references), and the latter: of F to D^(k-1) F, then of -ρ(t)."""
        model, q = self._plan.model, self._plan.model.reduction.mechanism.q
        residual = program_residuals(model)[self._name]
        F = integrals(q, model.reduction.program)[self._name]
        k = q.order(residual) - q.order(F)
        levels = [level[0] for level in q.derivatives([F], k)]
        levels[k] -= residual  # -ρ(t), whatever the jets are
        top = max(q.order(F) + min(k - 1, order), 2)
        absent = ca.vertcat(ca.SX(0, 1), *(s for s in ca.symvar(levels[k]) if q.is_jet(s) and q.order(s) > top))
        levels[k] = ca.substitute(levels[k], absent, ca.SX.zeros(absent.shape))
        while len(levels) <= order:
            followed = Jets(q, levels[-1:])
            symbols, rates = ca.vertcat(q.t, followed.symbols), ca.vertcat(1, followed.rates)
            levels.append(ca.jtimes(levels[-1], symbols, rates))
        jets, p = Jets(q, levels[: order + 1], model.paths), model.reduction.mechanism.parameters.symbols
        z = ca.vertcat(*(q.jet(i) for i in range(top + 1)))
        inputs = [q.t, z, ca.vertcat(ca.SX(0, 1), *p), jets.symbols]
        return ca.Function("along", inputs, [ca.vertcat(*levels[: order + 1])]), jets


class Sums:
    """The sums of errors that a law feeds back, as parts of its step; made for an extension of a plant.

    `counts` are the numbers of poles by row. `now` has the sums of each row by their number, as they are fed back.
    Where accelerations are in a row, its error is the mean over the last sample: (w_k - w_(k-1))/Ts with w = γ', at the
    state in its middle. `state` are symbols of the controller state, `names` their names, `before` those of jets of
    references half a sample before, which are `jets`; `integrators` the places of the sums.
    """

    def __init__(self, extension, counts, period):
        self._q, self._period, self.names = extension.q, period, []
        q = self._q
        self._counted, self._velocities = ca.SX.sym("counted"), ca.SX.sym("w_before", q.n)
        numbers = {name: counts[name] - r for name, r in extension.orders.items()}
        rows = {name: row for name, row in extension.rows.items() if numbers[name] and q.order(row) == 2}
        self.jets = extension.jets(list(rows.values()))
        self.before = ca.SX.sym("before", len(self.jets))
        means = dict(zip(rows, ca.vertsplit(self._means(ca.vertcat(ca.SX(0, 1), *rows.values()))), strict=True))
        self.now, self._next, symbols = [], [], []
        for name, level in zip(extension.names, extension.levels, strict=True):
            sums = [ca.SX.sym(f"sum_{i}") for i in range(numbers[name])]
            summed = [means.get(name, level[0]), *sums][: len(sums)]
            self.now.append([s + self._gain(e) for s, e in zip(sums, summed, strict=True)] if name in means else sums)
            self._next += zip(self.now[-1], [None] * len(sums) if name in means else summed, strict=True)
            symbols += sums
            self.names += [f"{'integral' if i == 0 else f'integral {i + 1}'} of {name}" for i in range(len(sums))]
        self.measured = bool(means)
        held = [self._counted, self._velocities] if self.measured else []
        self.state = ca.vertcat(ca.SX(0, 1), *held, *symbols)
        first = (1 + q.n) * self.measured
        self.integrators = range(first, first + len(symbols))
        if self.measured:
            self.names[:0] = ["inputs within limits", *(f"{name} before" for name in q.velocity_names)]

    def _gain(self, e):
        """What is added to a sum for the last sample; nothing at the first one, and while an input was at its limit."""
        return ca.if_else(self._counted, self._period * e, 0)

    def _means(self, rows):
        """Rows with the mean accelerations of the last sample, at the state in its middle."""
        q, h, w = self._q, self._period, ca.vertcat(*self._q.gamma(1))
        middle = q.jet(0) - h / 2 * (q.V @ (3 * w + self._velocities) / 4 + q.h)
        old = ca.vertcat(q.t, q.jet(0), w, *q.gamma(2), self.jets.symbols)
        velocities, accelerations = (w + self._velocities) / 2, (w - self._velocities) / h
        return ca.substitute(rows, old, ca.vertcat(q.t - h / 2, middle, velocities, accelerations, self.before))

    def after(self, command, low, high):
        """The next state: sums of errors are held while a command (m,) is at its limit, low or high (m,)."""
        within = ca.SX(1)
        for u, least, most in zip(command.elements(), low, high, strict=True):
            within *= (u > least) if np.isfinite(least) else 1
            within *= (u < most) if np.isfinite(most) else 1
        held = [within, ca.vertcat(*self._q.gamma(1))] if self.measured else []
        return [*held, *(s if e is None else s + ca.if_else(within, self._period * e, 0) for s, e in self._next)]

    def start(self, plan):
        """The state at the start of a plan, (n,)."""
        state, q = np.zeros(self.state.numel()), self._q
        if self.measured:
            state[1 : 1 + q.n] = plan.state(plan.t[0])[q.nq : q.nq + q.n]
        return state


# --- chains of integrators and sums under sampled feedback


def sampled_radius(poles, rate, delay=0, chain=None):
    """Spectral radius of feedback with poles (n,) [1/s] that is held and delayed.

    Of n integrators the last `chain`, default all, are those of the machine, exact under the hold; the others are sums
    over the samples, and so is the only one of a row of relative degree 0.
    """
    n, h = len(poles), 1.0 / rate
    r = n if chain is None else max(chain, 1)
    powers = np.arange(r)
    steps = np.cumprod(np.append(1.0, h / np.arange(1, r + 1)))  # h^k / k!
    loop = np.eye(n + delay)
    for i in range(n - r):
        loop[i, i + 1] = h
    for i in powers:
        loop[n - r + i, n - r + i : n] = steps[: r - i]
    held, gains = steps[r - powers], np.poly(poles).real[:0:-1]
    loop[n:, n:] = np.eye(delay, k=-1)
    if delay:
        loop[n - r : n, -1], loop[n, :n] = held, -gains
    else:
        loop[n - r : n, :n] -= np.outer(held, gains)
    return float(spectral_radii(loop[None])[0])


def fastest_poles(n, chain, delay):
    """The fastest n equal poles, as p h, that `sampled_radius` finds stable."""
    low, high = 0.0, FASTEST
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if sampled_radius([-middle] * n, 1.0, delay, chain) < 1 else (low, middle)
    return low
