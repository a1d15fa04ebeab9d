"""Laws under limits: a small quadratic program per sample decides the inputs, and which residual gives way."""

from collections.abc import Mapping, Sequence
from dataclasses import field, fields, replace
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from servoctl.checks import ON_SAMPLE, as_list, finite, interval, mapping, named, numbers_by_name, positive
from servoctl.codegen import compiler, emit
from servoctl.codegen.function import Compiled, compiled
from servoctl.codegen.matrices import riccati
from servoctl.control import conditions
from servoctl.control.close import require_names
from servoctl.control.law import Law
from servoctl.control.lqr import Q_POSITION, R_INPUT, steady, tangents
from servoctl.control.reference import Reference, of_plan, require_plant
from servoctl.control.residuals import Residuals, as_read, in_symbols_of, paths_along, program_residuals
from servoctl.control.result import Closed
from servoctl.control.sampling import discretised
from servoctl.control.time_law import fastest_along
from servoctl.errors import LimitExceeded, ServoError, SpecificationError
from servoctl.markup import Shown
from servoctl.plants.plant import Plant
from servoctl.spec.references import Jets
from servoctl.tolerances import TINY
from servoctl.values import Value, frozen

HORIZON = 0.5  # s
FALLING = 1e-4  # ratio of weights from one residual to the next by priority
UNSEEN = 1e-6  # weight of each state relative to residuals: keeps states at rest that no residual sees
IDLE = 1e-3  # least cost of an input that the plan does not use, as the root of its share in the largest cost
MET = 1e-7  # of an input's size: distance from a limit at which it is met
GIVEN_WAY = 1e-6  # of a residual's largest effect: least slack that counts
STEPS = 100  # of the active-set method, which needs about as many as constraints become active
WITHIN = 1e-10  # of an input's size, and of the terms of a limit: its admissible violation
DEPENDENT = 1e-9  # sine of the angle between a constraint and others, below which it depends on them
SCENE = frozenset(("t_span", "start", "guess", "parameters"))  # arguments of `fastest` for a scene


class Effects:
    """The immediate effects of inputs: o = c + O u for expressions of t, q, γ' and γ'', affine in the inputs.

    `jets` are those of references in them, along `paths` by name.
    """

    def __init__(self, plant, expressions, paths):
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
                do="Bound forces of constraint or accelerations, which are affine.",
                names=self.names,
            )
        self.immediate = {name for i, name in enumerate(self.names) if slopes[i, :].nnz()}  # an input changes these
        still = ca.substitute(values, e.u, ca.SX.zeros(e.u.numel()))
        parts = ca.densify(ca.cse(ca.vertcat(still, ca.vec(ca.densify(slopes)))))
        self.jets = Jets(e.q, [parts], paths)
        numbers = ca.vertcat(e.p[: e.p.numel() - e.u.numel() - e.q.n], self.jets.symbols)
        self.expression = ca.Function("effects", [e.q.t, e.state, numbers], [parts])
        self._function = compiled(self.expression, "effects")

    def __call__(self, t, x, r):
        """c (j,) and O (j, m) at a state x (n_x,), with the jets of references r (n_r,)."""
        j, m = len(self.names), len(self._plant.inputs)
        y = self._function(t, x, np.append(self._plant.parameters, r))
        return y[:j], y[j:].reshape(m, j).T


def limited(
    law: Law,
    plant: Plant,
    *,
    bounds: Mapping[str, Any] | None = None,
    weights: Mapping[str, float] | None = None,
    priority: Sequence[str] | None = None,
    horizon: float = HORIZON,
) -> Law:
    """A law whose inputs are allocated within the plant's limits of magnitude and rate, and within bounds of outputs.

    At each sample the inputs u differ from those of the law, u_law, at the least cost to the program:
    (u - u_law)ᵀ(R + BᵀPB)(u - u_law), with the cost-to-go P of Σ w_i φ_i² along the plan under the default R of `lqr`.
    For residuals of order 2, w_i times the square of their immediate change is added. With a priority the weights fall
    by 1e-4 from one residual to the next; the choice is made sample by sample, and a residual of high priority is not
    always smaller over a whole motion. The slack of a residual is its deviation after the horizon if the difference is
    held (for residuals of order 2, its immediate deviation); of a residual of order 3 or more it is that of F. While
    there is slack, integrals of residuals in the controller state are held (anti-windup). An estimator predicts with
    the inputs that act.

    Parameters
    ----------
    law : Law
    plant : Plant
        The controller's model of the machine, with its limits.
    bounds : dict of str to (float, float) or float, optional
        Outputs of the mechanism, affine in the inputs, that stay within (low, high), None for an open side, or within
        (-c, c): a rope that cannot push is {"tension": (0.0, None)}. So do the reactions of material constraints,
        "multiplier_NAME" as in the plan. A combination goes before low and high, under a name of its own: one side of a
        cone of friction is {"slip": ({"multiplier_sole_x": 1.0, "multiplier_sole_z": -0.6}, None, 0.0)}.
    weights : dict of str to float, optional
        w_i by residual; default 1 each.
    priority : sequence of str, optional
        Residuals, the most important first, instead of weights.
    horizon : float
        Horizon of the slack [s]; default 0.5, after which actuators of cranes, arms and vehicles show in positions.

    Returns
    -------
    Law
        With the further signals "slack X" for each residual (its units), "limit a" for each actuator (-1 lower,
        1 upper, 0 none) and "bound o" for each bounded output. `limit_report` reads them.

    Raises
    ------
    SpecificationError
        If there are no limits and bounds, or both weights and priority.
    NameUnknown
        For an unknown residual or output.
    LimitExceeded
        During the loop, if no inputs satisfy limits and bounds together.
    """
    plant = of_plan(getattr(law, "plan", None), plant)
    _require_law(law, plant)
    effects, bounds = _bounds(plant, bounds)
    reference = Reference(law.plan, plant, law.rate)
    weights = _weights(tuple(program_residuals(law.plan.model)), weights, priority)
    D, H = _predicted(reference, positive("horizon", horizon), weights)
    sizes = _sizes(law.plan, plant, H)
    allocation = Allocation(law, plant, effects, bounds, tuple(weights), sizes, np.abs(D).max(axis=0) @ sizes)
    low, high, change = conditions.limits(plant, law.period)
    constant = np.concatenate([low, high, change, sizes, *bounds.T, plant.parameters])
    numbers = np.tile(np.nan_to_num(constant)[:, None], len(reference.t))  # finite in a schedule
    numbers = np.vstack([numbers, effects.jets.at(reference.t)])
    return replace(
        law,
        name=f"{law.name}, limited " + (f"by priority {' > '.join(priority)}" if priority else "by weight"),
        step=allocation,
        schedule=_schedule(law, reference, D, H, numbers),
        state=np.concatenate([law.state, np.clip(law.initial_input, low, high)]),
        state_names=(*law.state_names, *(f"last {name}" for name in plant.inputs)),
        signals=(*law.signals, *allocation.signals),
        allocation=allocation,
    )


def _bounds(plant, bounds):
    """The effects of inputs on the bounded outputs, and the bounds, (j, 2)."""
    bounds = mapping(bounds, "The bounds")
    parts = {name: _combination(name, value) for name, value in bounds.items()}
    bounds = {name: interval(name, sides, "bound") for name, (_, sides) in parts.items()}
    if not (plant.limits or plant.rate_limits or bounds):
        raise SpecificationError(
            "There are no limits of the plant and no bounds.",
            "An allocation keeps inputs within limits.",
            do='Pass bounds, or limits of the plant: sv.plant(mechanism, limits={"trolley": 150.0}).',
            names=plant.inputs,
        )
    known = plant.mechanism.outputs | (plant.equations.multipliers if bounds else {})
    for one in (one for combination, _ in parts.values() for one in combination):
        named(one, known, "output or multiplier")
    rows = {name: sum(c * known[one] for one, c in combination.items()) for name, (combination, _) in parts.items()}
    effects = Effects(plant, rows, plant.paths)
    for name in bounds:
        if name not in effects.immediate:
            raise SpecificationError(
                f"No input changes {name!r} immediately"
                + (f": {', '.join(plant.lagged)} lag behind their commands." if plant.lag else "."),
                "A bound is kept by the inputs of the same sample.",
                do="Leave the bound out, or design for actuators without lag.",
                name=name,
                lagged=plant.lagged,
            )
    return effects, np.array(list(bounds.values())).reshape(-1, 2)


def _combination(name, value):
    """Coefficients by signal of what is bounded, and its sides."""
    if not (isinstance(value, (tuple, list)) and len(value) == 3 and isinstance(value[0], Mapping)):
        return {name: 1.0}, value
    combination, *sides = value
    combination = mapping(combination, f"The signals of the bound {name!r}")
    return {one: finite(one, c, "coefficient") for one, c in combination.items()}, tuple(sides)


def _schedule(law, reference, D, H, numbers):
    """The law's schedule followed by numbers, an input matrix, x_ref, D and H at each sample; the last columns hold."""
    count = len(D)
    along = np.vstack([reference.x, D.reshape(count, -1).T, H.reshape(count, -1).T])
    matrix = [] if law.input_matrix is None else [law.input_matrix.reshape(len(law.input_matrix), -1).T]
    parts = (law.schedule, numbers, *matrix, along)
    samples = np.arange(max(count, law.schedule.shape[1]))
    return np.vstack([part[:, np.minimum(samples, part.shape[1] - 1)] for part in parts])


def _require_law(law, plant):
    """Refuse anything but a law without allocation that has a plan, starts with it and has the names of the plant."""
    require_plant(plant)
    if not isinstance(law, Law) or law.allocation:
        raise SpecificationError(
            f"Expected a Law, got a {type(law).__name__}." if not isinstance(law, Law) else f"{law.name!r} is limited.",
            "Limits are allocated around a law without limits.",
            do="Pass a law made from a plan, as by sv.lqr, and all bounds and weights in one call.",
            name=getattr(law, "name", None),
        )
    if law.plan is None:
        raise SpecificationError(
            f"The law {law.name!r} has no plan.",
            "Slack is given to the residuals of a plan's program.",
            do="Make the law from a plan.",
            name=law.name,
        )
    require_names(law, plant)
    if abs(law.t0 - law.plan.t[0]) > ON_SAMPLE * law.period:
        raise SpecificationError(
            f"The law {law.name!r} begins at t = {law.t0:g} s, its plan at {law.plan.t[0]:g} s.",
            "Samples of law and plan coincide.",
            do="Let both begin at the same instant.",
            t0=law.t0,
            plan_t0=float(law.plan.t[0]),
        )


def _predicted(reference, horizon, weights):
    """Deviations D of residuals after the horizon per unit of input, (N, k, m), and costs H of the inputs, (N, m, m).

    `weights` w_i by residual; H = R + BᵀPB along the plan, with P the cost-to-go of Σ w_i φ_i².
    """
    plant, residuals = reference.plant, Residuals(reference.plan.model, reference.plant)
    (A, B), C = reference.linearised(), residuals.jacobian(reference.t, reference.x)
    D = dict(zip(residuals.names, np.moveaxis(C @ discretised(A, B, horizon)[1], 1, 0), strict=True))
    A, B = discretised(A, B, reference.period)
    w = Q_POSITION * np.array([weights[name] for name in residuals.names])
    Q = np.einsum("nki,k,nkj->nij", C, w, C) + UNSEEN * Q_POSITION * np.eye(plant.n_x)
    R, basis = R_INPUT * np.eye(len(plant.inputs)), tangents(reference)
    _, P = steady(A[-1:], B[-1:], Q[-1], R, basis[-1:])
    H = riccati(A[::-1], B[::-1], Q[::-1], R, P)[1][::-1]
    for name, O in _at_once(reference, residuals.names).items():
        D[name] = O
        H += Q_POSITION * weights[name] * np.einsum("ni,nj->nij", O, O)
    return np.stack([D[name] for name in weights], axis=1), H


def _at_once(reference, others):
    """Immediate effects of the inputs on residuals of order 2 along the plan, (N, m) by name; not of `others`."""
    plan, plant = reference.plan, reference.plant
    read, q = as_read(plan.model)[0], plan.model.reduction.mechanism.q
    second = {name: e for name, e in in_symbols_of(plant, plan.model, read).items() if name not in others}
    for name in second:
        if (order := q.order(read[name])) > 2:
            raise SpecificationError(
                f"The residual {name!r} has order {order}.",
                "Slack is given to residuals, or F of which they are derivatives, that state and inputs determine.",
                do="Leave out sv.limited; the plant limits the commands.",
                name=name,
                order=order,
            )
    effects = Effects(plant, second, paths_along(plan.model, plant))
    along = zip(reference.t, reference.x.T, effects.jets.at(reference.t).T, strict=True)
    slopes = np.array([effects(*at)[1] for at in along])
    return {name: slopes[:, i] for i, name in enumerate(second)}


@frozen(eq=False)
class Allocation(Value):
    """The step of a limited law: (t, [y; z; last u], [column; numbers; x_ref; D; H]) -> [u; z+; u; signals].

    The numbers are limits, sizes, bounds, the plant's parameters, and jets of references in the bounded outputs.

    `law` is the law without limits, `plant` the plant with them; `effects` are those of the inputs on the bounded
    outputs, `bounds` (j, 2). `residuals` may have slack; `sizes` (m,) are typical sizes of the inputs, `slack_sizes`
    (k,) the largest effects of such inputs on the residuals.
    """

    law: Law
    plant: object
    effects: Effects = field(compare=False)  # follows from the plant and its outputs
    bounds: np.ndarray
    residuals: tuple
    sizes: np.ndarray
    slack_sizes: np.ndarray

    def __getstate__(self):
        return {f.name: getattr(self, f.name) for f in fields(self)}  # loaded libraries stay in the process

    @property
    def limits(self):
        """Pairs ("limit", actuator) and ("bound", output)."""
        return (*(("limit", name) for name in self.plant.inputs), *(("bound", name) for name in self.effects.names))

    @property
    def signals(self):
        """Names of the further signals: slacks, limits and bounds."""
        return (*(f"slack {name}" for name in self.residuals), *(f"{kind} {name}" for kind, name in self.limits))

    @cached_property
    def measured(self):
        """Indices of the measured states."""
        return [self.plant.state_names.index(name) for name in self.law.measures]

    @cached_property
    def _jets(self):
        """Where a column has the jets of references in the bounded outputs."""
        begin = len(self.law.schedule) + 4 * len(self.sizes) + 2 * len(self.bounds) + len(self.plant.parameters)
        return slice(begin, begin + len(self.effects.jets))

    @cached_property
    def _limits(self):
        """Lower and upper limits, and the largest change in a sample, (m,) each."""
        return conditions.limits(self.plant, self.law.period)

    @cached_property
    def _qp(self):
        """min vᵀH v/2 subject to lbx <= v <= ubx and lba <= A v <= uba, by DAQP through CasADi."""
        m, j = len(self.sizes), len(self.bounds)
        shapes = {"h": ca.Sparsity.dense(m, m), "a": ca.Sparsity.dense(j, m)}
        return ca.conic("qp", "daqp", shapes, {"error_on_fail": False})

    def native(self, suffix):
        """The same in C, `NAME_suffix`; None without a compiler, or for a law in Python."""
        return self._library and self._library[f"allocation_{suffix}"]

    @cached_property
    def _library(self):
        if not isinstance(self.law.step, Compiled):
            return None
        indices = {"MEASURED": self.measured, "INTEGRATORS": self.law.integrators}
        lists = {name: f"{{{', '.join(map(str, places)) or '0'}}}" for name, places in indices.items()}
        functions = (emit.function(f, name, emit.PORTABLE) for name, f in self.functions.items())
        head = emit.unit(self.sizes_in_c | lists | {"NAME": "allocation"})
        return compiler.library("".join([head, *functions, emit.include("allocation.c")]))

    @property
    def functions(self):
        """Functions that allocation.h calls, by name."""
        return {"unlimited": self.law.step.expression, "effects": self.effects.expression}

    @property
    def sizes_in_c(self):
        """Sizes and tolerances of allocation.h."""
        law = self.law
        return {
            "NM": len(law.measures),
            "NZ_LAW": len(law.state),
            "NU": len(self.sizes),
            "NX": self.plant.n_x,
            "NSIG": len(law.signals),
            "NROW": law.schedule.shape[0],
            "NK": len(self.residuals),
            "NJ": len(self.bounds),
            "NC": len(self.plant.parameters) + len(self.effects.jets),
            "NI": len(law.integrators),
            "QP_STEPS": STEPS,
            "QP_MET": WITHIN,
            "QP_DEPENDENT": DEPENDENT,
            "QP_TINY": TINY,
            "MET": MET,
            "GIVEN_WAY": GIVEN_WAY,
        } | ({} if law.input_matrix is None else {"CORRECTED_BY": 1})

    def __call__(self, t, x, column):
        """The inputs, the next controller state and the signals, in one array."""
        law, n_x, m, k = self.law, self.plant.n_x, len(self.sizes), len(self.residuals)
        y, z, last = np.split(x, np.cumsum([len(law.measures), len(law.state)]))
        answer = law.answer(t, np.concatenate([y, z]), column[: len(law.schedule)])
        desired, z_next, signals = np.split(answer, [m, m + len(law.state)])
        state, D, H = np.split(column[-(n_x + k * m + m * m) :].copy(), [n_x, n_x + k * m])
        D, H = D.reshape(k, m), H.reshape(m, m)
        state[self.measured] = y
        low, high, change = self._limits
        low, high = np.maximum(low, last - change), np.minimum(high, last + change)
        c, O = self.effects(t, state, column[self._jets])
        u = self._allocate(t, desired, low, high, H, c, O)
        difference = u - desired
        slack = D @ difference
        gives_way = np.any(np.abs(slack) > GIVEN_WAY * (np.abs(D) @ self.sizes))
        z = self._advanced(t, z, z_next, gives_way, difference)
        room = MET * self.sizes
        active = np.where(u <= low + room, -1.0, np.where(u >= high - room, 1.0, 0.0)) * (np.abs(difference) > room)
        reached = np.where(np.abs(c + O @ u - self.bounds.T) <= MET * (np.abs(O) @ self.sizes), [[-1.0], [1.0]], 0.0)
        return np.concatenate([u, z, u, signals, slack, active, reached.sum(axis=0)])

    def _advanced(self, t, z, z_next, gives_way, difference):
        """The next controller state: integrals are held while there is slack, an estimate takes the inputs that act."""
        law, held = self.law, list(self.law.integrators) if gives_way else []
        z_next = z_next.copy()
        z_next[held] = z[held]
        if law.input_matrix is None:
            return z_next
        k = min(round((t - law.t0) * law.rate), len(law.input_matrix) - 1)
        return z_next + law.input_matrix[k] @ difference

    def _allocate(self, t, desired, low, high, H, c, O):
        """The inputs: those of the law if they are admissible, else from a quadratic program in (u - u_law)/size."""
        least, most = self.bounds.T - c - O @ desired
        if np.all((low <= desired) & (desired <= high)) and np.all((least <= 0) & (0 <= most)):
            return desired
        S, A = np.diag(self.sizes), O * self.sizes
        # rows are scaled to entries of order one, for the tolerance of the solver
        scale = np.maximum(np.abs(A).max(axis=1, initial=0.0), TINY)
        H, A = S @ H @ S, A / scale[:, None]
        sides = {"lbx": (low - desired) / self.sizes, "ubx": (high - desired) / self.sizes}
        sides |= {"lba": least / scale, "uba": most / scale}
        try:
            v = self._qp(h=H / np.abs(H).max(), a=A, **sides)["x"]
        except RuntimeError as error:  # CasADi's only type
            raise ServoError(
                f"The quadratic program of the allocation failed: {str(error).splitlines()[0][:100]}.",
                "Its data are finite numbers.",
                do="Check weights and limits for very large numbers.",
            ) from error
        if not self._qp.stats()["success"]:
            raise self._infeasible(t, low, high)
        return np.clip(desired + self.sizes * np.asarray(v).ravel(), low, high)

    def _infeasible(self, t, low, high):
        names = self.plant.inputs
        limits = ", ".join(f"{n} {a:.6g} .. {b:.6g}" for n, a, b in zip(names, low, high, strict=True))
        bounds = ", ".join(f"{n} {a:.6g} .. {b:.6g}" for n, (a, b) in zip(self.effects.names, self.bounds, strict=True))
        return LimitExceeded(
            f"At t = {t:.6g} s no inputs within {limits} satisfy {bounds or 'the limits'}.",
            "Limits and bounds hold together; only residuals have slack.",
            do="Widen a limit or a bound, or slow the plan (sv.fastest); `.run` is the motion so far.",
            t=float(t),
            bounds=self.effects.names,
            low=low,
            high=high,
        )


def _weights(names, weights, priority):
    """The residuals' weights by name."""
    weights = numbers_by_name(weights, names, "residual", "weight", positive=True)
    order = [] if priority is None else as_list(priority)
    if order == []:
        return {name: weights.get(name, 1.0) for name in names}
    if order is None or not all(isinstance(name, str) for name in order) or len({*order}) < len(order):
        raise SpecificationError(
            f"The priority is {repr(priority)[:150]}.",
            "It is a sequence of residuals, each once, the most important first.",
            do=f"Pass some of {', '.join(names)}.",
            names=names,
        )
    if weights:
        raise SpecificationError(
            f"Weights of {', '.join(weights)} and a priority were given.",
            "A priority sets the weights of all residuals.",
            do="Leave out one of them.",
            weights=weights,
            priority=tuple(order),
        )
    for name in order:
        named(name, names, "residual")
    order += [name for name in names if name not in order]
    return {name: FALLING ** order.index(name) for name in names}


def _sizes(plan, plant, H):
    """A typical size of each input, (m,): the width of its limits, else its largest value in the plan."""
    low, high, _ = conditions.limits(plant, 1.0)
    used = np.array([np.abs(plan[name]).max() for name in plant.inputs])
    sizes = np.where(np.isfinite(high - low), high - low, used)
    unit = 1 / np.sqrt(np.diagonal(H, axis1=1, axis2=2).max(axis=0))  # inputs of equal cost
    # an input that the plan does not use has a small size, not zero: it divides
    return np.maximum(sizes, (IDLE * np.max(sizes / unit) or 1.0) * unit)


@frozen
class LimitReport(Shown):
    """The residuals that gave way in a closed loop; made by `limit_report`.

    Attributes
    ----------
    rows : tuple of (str, float, float, float, float)
        Residual, first and last instant with slack [s], largest slack (units of φ, after the horizon) and its instant.
    limits : dict of str to float
        Share of the samples at which a limit of an actuator or a bound was met.
    overload : tuple of (str, float, float, float) or None
        Largest excess of the plan: actuator, instant, value, limit; None if the plan is within all limits.
    slower : float or None
        With a scene: factor by which the plan must be slowed to stay within the limits of magnitude.
    """

    rows: tuple[tuple[str, float, float, float, float], ...]
    limits: dict[str, float]
    overload: tuple[str, float, float, float] | None = None
    slower: float | None = None

    def __repr__(self):
        lines = ["LimitReport: " + ("no residual gave way" if not self.rows else "residuals gave way")]
        for name, first, last, most, t in self.rows[:5]:
            lines.append(f"  {name}: slack from t = {first:.5g} to {last:.5g} s, largest {most:.4g} at t = {t:.5g} s")
        for name, share in list(self.limits.items())[:4]:
            lines.append(f"  {name} at its limit during {100 * share:.3g} % of the samples")
        if self.overload:
            name, t, needed, limit = self.overload
            lines.append(f"  the plan needs {needed:.6g} of {name} at t = {t:.5g} s; the limit is {limit:.6g}")
        if self.slower:
            lines.append(f"  slowed by the factor {self.slower:.5g} the plan would keep the limits of magnitude")
        return "\n".join(lines)


def limit_report(run: Closed, scene: Mapping[str, Any] | None = None) -> LimitReport:
    """Report which residuals gave way in a closed loop with a limited law, and what would avoid it.

    Parameters
    ----------
    run : Closed
        Run of a law made by `limited`.
    scene : dict, optional
        Arguments t_span, start, guess and parameters of `fastest`, as {"t_span": (0.0, 6.0), "guess": {...}}. If the
        plan exceeds limits of magnitude, the report then has the factor by which it must be slowed.

    Returns
    -------
    LimitReport

    Raises
    ------
    SpecificationError
        If the law is not limited.
    """
    law = getattr(run, "law", None)
    allocation = getattr(law, "allocation", None)
    if allocation is None:
        raise SpecificationError(
            f"The law {getattr(law, 'name', None)!r} is not limited.",
            "The report reads the slacks of an allocation.",
            do="Close the loop with a law of sv.limited(law, plant).",
            name=getattr(law, "name", None),
        )
    if scene is not None and not (isinstance(scene, dict) and "t_span" in scene and SCENE.issuperset(scene)):
        raise SpecificationError(
            f"The scene is {scene!r}."[:200],
            f"It is a dict with t_span and arguments of sv.fastest: {', '.join(sorted(SCENE))}.",
            do='Pass one such as {"t_span": (0.0, 6.0), "guess": {"l": 4.0}}.',
            valid=sorted(SCENE),
        )
    met = {name: float(np.mean(run.signal[f"{kind} {name}"] != 0)) for kind, name in allocation.limits}
    overload, slower = _overload(run.plan, allocation.plant), None
    if scene is not None and overload is not None:
        model = run.plan.model
        mechanism, program = model.reduction.mechanism, model.reduction.program
        paths = {name: model.paths[name] for name in program.references(mechanism.q)}
        options = *(scene.get(name) for name in ("start", "guess", "parameters")), False
        slower = fastest_along(paths, mechanism, program, allocation.plant.limits, scene["t_span"], options).factor
    return LimitReport(_slacks(run, allocation), {name: s for name, s in met.items() if s}, overload, slower)


def _slacks(run, allocation):
    """(residual, first and last instant, largest slack, its instant) of each residual that gave way."""
    rows = []
    for name, size in zip(allocation.residuals, allocation.slack_sizes, strict=True):
        slack = np.abs(run.signal[f"slack {name}"])
        samples = np.flatnonzero(slack > GIVEN_WAY * size)
        if len(samples):
            k = int(np.argmax(slack))
            rows.append((name, *(float(run.t[i]) for i in samples[[0, -1]]), float(slack[k]), float(run.t[k])))
    return tuple(rows)


def _overload(plan, plant):
    """(actuator, instant, value, limit) of the plan's largest excess over limits of magnitude, or None."""
    excesses = []
    for name, (low, high) in plant.limits.items():
        (t_low, least), (t_high, most) = plan.extrema(name)
        excesses += [(low - least, name, t_low, least, low), (most - high, name, t_high, most, high)]
    excess, *facts = max(excesses, default=(0.0,))
    return tuple(facts) if excess > 0 else None
