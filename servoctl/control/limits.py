"""Laws under limits: each sample's inputs from a small quadratic program that says which residual gives way."""

from dataclasses import dataclass, replace

import numpy as np

from servoctl.checks import ON_SAMPLE, finite, interval, mapping, positive
from servoctl.control.allocation import Effects, SmallQP
from servoctl.control.close import require_names
from servoctl.control.feedback import Residuals
from servoctl.control.law import Law
from servoctl.control.lqr import Q_POSITION, R_INPUT, steady, tangents
from servoctl.control.sampling import discretised
from servoctl.control.tracking import Reference, require_plant
from servoctl.errors import LimitExceeded, SpecificationError, unknown

HORIZON = 0.5  # s
FALLING = 1e-4  # of weights, from one residual to the next by priority
UNSEEN = 1e-6  # weight of each state beside those of residuals: states that no residual sees stay where they are
IDLE = 1e-3  # of the largest: the root of the cost of an input that the plan does not use
MET = 1e-7  # of an input's range: how near its limit an input has met it
SCENE = frozenset(("t_span", "start", "guess", "parameters"))  # what `fastest` takes beside program and limits
GIVEN_WAY = 1e-6  # of a residual's largest effect: a slack that counts


def limited(law, plant, *, bounds=None, weights=None, priority=None, horizon=HORIZON, solver="daqp"):
    """A law whose inputs are allocated within the plant's limits of magnitude and rate, and within bounds of outputs.

    At each sample the inputs u nearest to those of the law, u_law, by what the difference will cost the program: least
    is (u - u_law)ᵀ(R + BᵀPB)(u - u_law), with the cost-to-go P of Σ w_i φ_i² along the plan under the default R of
    `lqr` (and, for residuals of order 2, w_i times the square of their immediate change). By priority, the weights fall
    by 1e-4 from one residual to the next; that is decided sample by sample, and what is spared in each sample does not
    always come out smaller over a whole motion. The slack of a residual is by how much it deviates after the horizon if
    the difference is held (for residuals of order 2, at once). Integrals of residuals in the law's memory stand still
    while slack is given (anti-windup), and an estimator's prediction is told the inputs that were applied.

    Parameters
    ----------
    law : Law
    plant : Plant
        What the controller believes of the machine: its limits are kept.
    bounds : dict of str to (float, float) or float, optional
        Outputs of the mechanism, affine in the inputs, that stay within (low, high), None for an open side, or within
        (-c, c): a rope that cannot push is {"tension": (0.0, None)}.
    weights : dict of str to float, optional
        w_i of the residuals; default 1 each.
    priority : sequence of str, optional
        Residuals, the most important first, in the place of weights.
    horizon : float
        Of the slack [s]; default 0.5, in which actuators of cranes, arms and vehicles show in positions.
    solver : {"daqp", "qrqp"}
        Of the quadratic programs, through CasADi.

    Returns
    -------
    Law
        With the further signals "slack X" for each residual (its own units), "limit a" for each actuator (-1 lower,
        1 upper, 0 none) and "bound o" for each bounded output. `limit_report` reads them.

    Raises
    ------
    SpecificationError
        If there is nothing to keep, or weights and priority are both given.
    NameUnknown
        For a name of no residual, output or solver.
    LimitExceeded
        During the loop, where no inputs keep limits and bounds together; it names them.
    """
    _require_law(law, plant)
    bounds = {name: interval(name, value, "bound") for name, value in mapping(bounds, "The bounds").items()}
    if not (plant.limits or plant.rate_limits or bounds):
        raise SpecificationError(
            "The plant has no limits, and no bounds were given.",
            "An allocation keeps limits.",
            nearest='sv.plant(mechanism, limits={"trolley": 150.0}).',
            do="Give the plant its limits.",
        )
    for name in bounds:
        if name not in plant.mechanism.outputs:
            raise unknown(name, plant.mechanism.outputs, "output of the mechanism")
    effects = Effects(plant, {name: plant.mechanism.outputs[name] for name in bounds})
    _require_at_once(effects, plant, bounds)
    reference = Reference(law.plan, plant, law.rate)
    names, D, at_once = _predicted(reference, positive("horizon", horizon))
    H = _metric(reference, names, _weights(names, weights, priority), at_once)
    count, sizes = D.shape[0], _sizes(law.plan, plant, H)
    samples, columns = np.arange(max(count, law.table.shape[1])), law.table.shape[1]
    along = np.vstack([reference.x, D.reshape(count, -1).T, H.reshape(count, -1).T])
    table = [law.table[:, np.minimum(samples, columns - 1)], along[:, np.minimum(samples, count - 1)]]
    signals = (*(f"slack {n}" for n in names), *(f"limit {n}" for n in plant.inputs))
    signals += tuple(f"bound {n}" for n in bounds)
    low, high = _magnitudes(plant)
    memory_names = (*law.memory_names, *(f"last {name}" for name in plant.inputs))
    step = _Allocation(law, plant, effects, sizes, tuple(bounds.values()), len(names), solver)
    how = f"by priority {' > '.join(priority)}" if priority else "by weight"
    return replace(
        law,
        name=f"{law.name}, limited {how}",
        step=step,
        table=np.vstack(table),
        memory=np.concatenate([law.memory, np.clip(law.idle, low, high)]),
        memory_names=memory_names,
        signals=(*law.signals, *signals),
        info=law.info | {"slack of": names, "limited plant": plant, "slack sizes": np.abs(D).max(axis=0) @ sizes},
    )


def _require_law(law, plant):
    """Refuse what is no law of a plan, or measures what the plant lacks."""
    require_plant(plant)
    if not isinstance(law, Law) or "slack of" in law.info:
        raise SpecificationError(
            f"A {type(law).__name__} was given as law." if not isinstance(law, Law) else f"{law.name!r} was given.",
            "Limits are kept around a law that does not keep them yet.",
            nearest="sv.lqr(plan, plant).",
            do="Give a law made from a plan, and all bounds and weights at once.",
        )
    if law.plan is None:
        raise SpecificationError(
            f"The law {law.name!r} has no plan.",
            "Slack is given to the residuals of a plan's program.",
            do="Make the law from a plan.",
        )
    require_names(law, plant)
    if abs(law.t0 - law.plan.t[0]) > ON_SAMPLE * law.period:
        raise SpecificationError(
            f"The law {law.name!r} begins at t = {law.t0:g} s, its plan at {law.plan.t[0]:g} s.",
            "Limits are kept along the plan, sample by sample of the law.",
            do="Let both begin at once.",
        )


def _magnitudes(plant):
    """Lower and upper limits of the inputs, infinite where the plant has none."""
    return np.array([plant.limits.get(name, (-np.inf, np.inf)) for name in plant.inputs]).T


def _require_at_once(effects, plant, bounds):
    """Refuse bounds of what no input changes at once, as behind lagging actuators."""
    for name in bounds:
        if not effects.acts(name):
            raise SpecificationError(
                f"No input changes {name!r} at once"
                + (f": {', '.join(plant.lagged)} lag behind their commands." if plant.lag else "."),
                "A bound is kept by the inputs of the same sample.",
                nearest="The bound, with a plant without lag.",
                do="Leave the bound out, or design with actuators that act at once.",
                name=name,
            )


def _predicted(reference, horizon):
    """Names of the residuals, by how much each deviates after the horizon per unit of input, (N, k, m), and at once."""
    plan, plant = reference.plan, reference.plant
    program, q = plan.model.reduction.program, plant.mechanism.q
    residuals = Residuals(plan.model, plant)
    _, B = discretised(*reference.linearised(), horizon)
    D = dict(zip(residuals.names, np.moveaxis(residuals.jacobian(reference.t, reference.x) @ B, 1, 0), strict=True))
    second = {name: e for name, e in program.residuals.items() if name not in D}
    for name, e in second.items():
        if q.order(e) > 2:
            raise SpecificationError(
                f"The residual {name!r} has order {q.order(e)}.",
                "Slack is given to residuals that the state and the inputs decide, of order 2 at most.",
                do="Limit the commands by the plant's own limits, without allocation.",
                name=name,
            )
    effects = Effects(plant, second)
    slopes = np.array([effects(t, x)[1] for t, x in zip(reference.t, reference.x.T, strict=True)])
    at_once = {name: slopes[:, i] for i, name in enumerate(second)}
    names = tuple(program.residuals)
    return names, np.stack([(D | at_once)[name] for name in names], axis=1), at_once


def _metric(reference, names, weights, at_once):
    """R + BᵀPB along the plan, P the cost-to-go of Σ w_i φ_i², (N, m, m)."""
    plant = reference.plant
    residuals = Residuals(reference.plan.model, plant)
    A, B = discretised(*reference.linearised(), reference.period)
    C = residuals.jacobian(reference.t, reference.x)
    w = Q_POSITION * np.array([weights[names.index(name)] for name in residuals.names])
    Q = np.einsum("nki,k,nkj->nij", C, w, C) + UNSEEN * Q_POSITION * np.eye(plant.n_x)
    R, basis = R_INPUT * np.eye(len(plant.inputs)), tangents(reference)
    _, P = steady(A[-1:], B[-1:], Q[-1], R, None if basis is None else basis[-1:])
    H = np.empty((len(A), *R.shape))
    for k in reversed(range(len(A))):
        PB = P @ B[k]
        H[k] = R + B[k].T @ PB
        P = Q[k] + A[k].T @ P @ (A[k] - B[k] @ np.linalg.solve(H[k], PB.T @ A[k]))
        P = (P + P.T) / 2
    for name, O in at_once.items():
        H += Q_POSITION * weights[names.index(name)] * np.einsum("ni,nj->nij", O, O)
    return H


class _Allocation:
    """The step of a limited law: (t, [y; z; last u], [row; x_ref; D; H]) -> [u; z+; u; signals]."""

    def __init__(self, law, plant, effects, sizes, bounds, k, solver):
        self.law, self.plant, self.effects, self.sizes = law, plant, effects, sizes
        m, self.k = len(plant.inputs), k
        self.low, self.high = _magnitudes(plant)
        self.change = np.array([plant.rate_limits.get(name, np.inf) for name in plant.inputs]) * law.period
        self.bounds = np.array(bounds).reshape(-1, 2)
        self.where = [plant.state_names.index(name) for name in law.measures]
        self.integrals = np.array([name.startswith("integral of ") for name in law.memory_names], dtype=bool)
        self.told = law.info.get("memory from input")
        self.qp = SmallQP(m, len(bounds), solver)

    def __call__(self, t, x, row):
        law, m = self.law, len(self.plant.inputs)
        n_y, n_z = len(law.measures), len(law.memory)
        rows = law.table.shape[0]
        inner = law.answer(t, x[: n_y + n_z], row[:rows])
        wanted, memory, further = np.split(inner, [m, m + n_z])
        n_x, k = self.plant.n_x, self.k
        state, D, H = np.split(row[rows:].copy(), [n_x, n_x + k * m])
        D, H = D.reshape(k, m), H.reshape(m, m)
        state[self.where] = x[:n_y]
        last = x[n_y + n_z :]
        low, high = np.maximum(self.low, last - self.change), np.minimum(self.high, last + self.change)
        c, O = self.effects(t, state)
        u = self._allocate(t, wanted, low, high, H, c, O)
        slack = D @ (u - wanted)
        room = MET * self.sizes
        active = np.where(u <= low + room, -1.0, np.where(u >= high - room, 1.0, 0.0)) * (np.abs(u - wanted) > room)
        reached = np.where(np.abs(c + O @ u - self.bounds.T) <= MET * (np.abs(O) @ self.sizes), [[-1.0], [1.0]], 0.0)
        held = self.integrals & bool(np.any(np.abs(slack) > GIVEN_WAY * (np.abs(D) @ self.sizes)))
        memory = np.where(held, x[n_y : n_y + n_z], memory)
        if self.told is not None:
            k = min(round((t - law.t0) * law.rate), len(self.told) - 1)
            memory = memory + self.told[k] @ (u - wanted)
        return np.concatenate([u, memory, u, further, slack, active, reached.sum(axis=0)])

    def _allocate(self, t, wanted, low, high, H, c, O):
        """The inputs, from a quadratic program in (u - u_law)/size where those of the law do not do."""
        least, most = self.bounds.T - c - O @ wanted
        if np.all((low <= wanted) & (wanted <= high)) and np.all((least <= 0) & (0 <= most)):
            return wanted
        S, A = np.diag(self.sizes), O * self.sizes
        scale = np.maximum(np.abs(A).max(axis=1, initial=0.0), 1e-300)
        H = S @ H @ S
        ends = (low - wanted) / self.sizes, (high - wanted) / self.sizes
        v = self.qp(H / np.abs(H).max(), np.zeros(len(H)), *ends, A / scale[:, None], least / scale, most / scale)
        if v is None:
            self._refuse(t, low, high, c)
        return np.clip(wanted + self.sizes * v, low, high)

    def _refuse(self, t, low, high, c):
        names = self.plant.inputs
        limits = ", ".join(f"{n} {a:.6g} .. {b:.6g}" for n, a, b in zip(names, low, high, strict=True))
        bounds = ", ".join(f"{n} {a:.6g} .. {b:.6g}" for n, (a, b) in zip(self.effects.names, self.bounds, strict=True))
        raise LimitExceeded(
            f"At t = {t:.6g} s no inputs within {limits} keep {bounds or 'the rows'}.",
            "Limits and bounds are kept together; slack is given to the program's residuals alone.",
            nearest="The motion before, which is kept in `.run`.",
            do="Widen a limit or a bound, or slow the plan (sv.fastest).",
            t=float(t),
            bounds=self.effects.names,
        )


def _weights(names, weights, priority):
    """The residuals' weights, (k,)."""
    weights = mapping(weights, "The weights")
    if isinstance(priority, str) or not np.iterable(priority or ()) or len({*(priority or ())}) < len(priority or ()):
        raise SpecificationError(
            f"priority={priority!r} was given.",
            "A priority is a sequence of residuals, each once, the most important first.",
            nearest=f"{list(names)}.",
            do="Give it.",
        )
    if weights and priority:
        raise SpecificationError(
            "Weights and a priority were given.", "Slack goes by one of them.", do="Leave one of them out."
        )
    for name in (*weights, *(priority or ())):
        if name not in names:
            raise unknown(name, names, "residual")
    if priority:
        order = [*dict.fromkeys(priority), *(n for n in names if n not in priority)]
        return np.array([FALLING ** order.index(name) for name in names])
    found = np.array([finite(name, weights.get(name, 1.0), "weight") for name in names])
    if found.min() <= 0:
        raise SpecificationError(
            f"The weights {weights} were given.", "A residual's weight is positive.", do="Give positive numbers."
        )
    return found


def _sizes(plan, plant, H):
    """A typical size of each input: its range where it has limits, else what the plan uses, if that costs anything."""
    found = []
    for name in plant.inputs:
        low, high = plant.limits.get(name, (-np.inf, np.inf))
        found.append(high - low if np.isfinite(high - low) else float(np.abs(plan[name]).max()))
    unit = 1 / np.sqrt(np.diagonal(H, axis1=1, axis2=2).max(axis=0))  # of each input, of the same cost
    return np.maximum(found, (IDLE * np.max(found / unit) or 1.0) * unit)


@dataclass(frozen=True)
class LimitReport:
    """Which residuals gave way in a closed loop, when and by how much; made by `limit_report`.

    Attributes
    ----------
    rows : tuple of (str, float, float, float, float)
        Residual, first and last instant with slack [s], largest slack (units of φ, after the horizon) and its instant.
    limits : dict of str to float
        Share of the samples at which each actuator or bound was met.
    overload : tuple of (str, float, float, float) or None
        Of the plan itself: actuator, instant, what it asks, the limit; None if it asks for no more than there is.
    slower : float or None
        Factor by which the plan would have to be slowed to keep the limits of magnitude, where it was asked for.
    """

    rows: tuple
    limits: dict
    overload: tuple = None
    slower: float = None

    def __repr__(self):
        lines = ["LimitReport: " + ("no residual gave way" if not self.rows else "residuals gave way")]
        for name, first, last, most, t in self.rows[:5]:
            lines.append(f"  {name}: slack from t = {first:.5g} to {last:.5g} s, largest {most:.4g} at t = {t:.5g} s")
        for name, share in list(self.limits.items())[:4]:
            lines.append(f"  {name} at its limit during {100 * share:.3g} % of the samples")
        if self.overload:
            name, t, asked, limit = self.overload
            lines.append(f"  the plan asks {asked:.6g} of {name} at t = {t:.5g} s; the limit is {limit:.6g}")
        if self.slower:
            lines.append(f"  slowed by the factor {self.slower:.5g} the plan would keep the limits of magnitude")
        return "\n".join(lines)


def limit_report(run, scene=None):
    """Which residuals gave way in a closed loop with a limited law, and what would have avoided it.

    Parameters
    ----------
    run : Closed
        Of a law made by `limited`.
    scene : dict, optional
        Arguments of `fastest` beside mechanism, program and limits ({"t_span": (0.0, 6.0), "guess": {...}}): then the
        factor is solved for by which a plan that exceeds limits of magnitude would have to be slowed to keep them.

    Returns
    -------
    LimitReport

    Raises
    ------
    SpecificationError
        If the law is not limited.
    """
    law = getattr(run, "law", None)
    if "slack of" not in getattr(law, "info", {}):
        raise SpecificationError(
            f"The law {getattr(law, 'name', None)!r} is not limited.",
            "The report reads the slacks of an allocation.",
            nearest="sv.limited(law, plant).",
            do="Close the loop with it.",
        )
    if scene is not None and not (isinstance(scene, dict) and "t_span" in scene and SCENE.issuperset(scene)):
        raise SpecificationError(
            f"scene={scene!r} was given."[:200],
            f"A scene has the span of the program as given, and what sv.fastest takes: {', '.join(sorted(SCENE))}.",
            nearest='{"t_span": (0.0, 6.0), "guess": {"l": 4.0}}.',
            do="Give such a dict.",
        )
    names, plant, sizes = (run.law.info[key] for key in ("slack of", "limited plant", "slack sizes"))
    rows = []
    for name, size in zip(names, sizes, strict=True):
        slack = np.abs(run.signal[f"slack {name}"])
        given = np.flatnonzero(slack > GIVEN_WAY * size)
        if len(given):
            k = int(np.argmax(slack))
            rows.append((name, *(float(run.t[i]) for i in (given[0], given[-1])), float(slack[k]), float(run.t[k])))
    signals = [name for name in run.law.signals if name.startswith(("limit ", "bound "))]
    limits = {s.split(" ", 1)[1]: float(np.mean(run.signal[s] != 0)) for s in signals}
    overload = _overload(run.plan, plant)
    slower = None
    if scene is not None and overload is not None:
        from servoctl.control.time_law import fastest

        reduction = run.plan.model.reduction
        slower = fastest(reduction.mechanism, reduction.program, plant.limits, **scene).factor
    return LimitReport(tuple(rows), {n: s for n, s in limits.items() if s}, overload, slower)


def _overload(plan, plant):
    """The largest excess of the plan over the limits of magnitude: actuator, instant, value, limit."""
    found = []
    for name, (low, high) in plant.limits.items():
        (t_low, least), (t_high, most) = plan.extrema(name)
        found += [(low - least, name, t_low, least, low), (most - high, name, t_high, most, high)]
    excess, *told = max(found, default=(0.0,))
    return tuple(told) if excess > 0 else None
