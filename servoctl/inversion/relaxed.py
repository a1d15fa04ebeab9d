"""The relaxed inverse: the program as well as actuators and limits allow.

    minimise ∫ Σ φ_i²/β_i + uᵀWu dt   subject to   x' = f(t, x, u), limits, bounds, the ends.

The weights β lead from the least actuation to the exact inverse. A solution exists for every β > 0, also where the
exact inverse is singular, unbounded, or outside the limits. The nonlinear program is solved for falling weights, each
from the solution before, on a mesh that is refined until its motion is that of the plant.
"""

from collections.abc import Mapping, Sequence
from copy import copy
from dataclasses import replace

import numpy as np

from servoctl.checks import (
    array_of,
    as_list,
    as_span,
    by_name,
    interval,
    numbers_by_name,
    positive_number,
    positives,
    require_kind,
)
from servoctl.control.extremes import as_read, excesses, size_of_limit
from servoctl.control.nonlinear import words
from servoctl.errors import (
    IntegrationStopped,
    LimitExceeded,
    SpecificationError,
)
from servoctl.inversion.transcription import WATCHED, Mesh, Transcription
from servoctl.inversion.transfer import EXCEEDED, GUESS, Transfer, state_sizes
from servoctl.methods.bounded import subdivided
from servoctl.methods.motion import breakpoints
from servoctl.model.start import State
from servoctl.model.variants import derived_near
from servoctl.plants.driven import at_once, driven
from servoctl.plants.plant import Plant, part_of
from servoctl.reduction.idle import names_of, needed
from servoctl.reduction.reduce import require_parts
from servoctl.run import Run
from servoctl.spec.paths import Path
from servoctl.spec.program import Program
from servoctl.study.table import Study, machine
from servoctl.values import frozen

ORDER = 9  # of the collocation: five nodes
INTERVALS = 24  # of the first mesh at least
FIRST = 1e-3  # first weight, relative to that for which standing still costs as much as the program
DEFAULT = 1e-6  # default weight, relative to the same
FACTOR = 100.0  # between the weights of two successive solutions
COARSE = 1e-6  # defect with which no plan is returned
DEFECT, AIM = 1e-7, 0.1  # of the states between nodes, relative to their sizes; and what refinement aims at of it
PLACES = (0.12, 0.4, 0.75)  # places within an interval where the defect is measured
ROUNDS, MOST_PIECES, MOST_INTERVALS = 6, 8, 400  # of the mesh; pieces of an interval; intervals
SAMPLES = 1000  # of the run, at least
UNLIMITED = (-np.inf, np.inf)


def relaxed(
    plant: Plant,
    program: Program,
    t_span: Sequence[float],
    *,
    weight: float | Mapping[str, float] | Sequence[float] | None = None,
    limits: Mapping[str, object] | None = None,
    bounds: Mapping[str, object] | None = None,
    start: State | Mapping[str, float] | None = None,
    end: str | Mapping[str, float] = "rest",
) -> Run | Study:
    """The actuation that trades a program against effort: min ∫ Σ φ_i²/β_i + uᵀWu dt over all motions of the plant.

    As β falls, the motion tends to the exact inverse where one satisfies the ends; where none does, as for a program
    that is singular at rest, beyond the limits, or not smooth, the plan misses it as little as its weights say.

    Parameters
    ----------
    plant : Plant
        Its limits of magnitude and of rate hold; lag and delay are left to the laws.
    program : Program
        W are its `weights` of the actuators, 1 by default; with `toward` the effort is that of the difference.
    t_span : (t0, t1)
        [s]
    weight : float, dict of str to float, or sequence of float, optional
        β of all or of each residual, in (unit of φ)²/(unit of u)²: m²/N² for a position by a force. Several values
        give a Study of the front between error and actuation. Default: 1e-6 of that for which standing still costs as
        much as the program.
    limits : dict of str to float or (low, high), optional
        Further limits of actuators and of their rates, {"trolley": 100.0, "dtrolley": 500.0}. They hold at all
        instants.
    bounds : dict of str to float or (low, high), optional
        Bounds of states, accelerations, outputs of the mechanism and residuals: {"tension": (0, None)}. They hold at
        some 300 instants; `run.message` has what exceeds them between these.
    start : State, array or dict of str to float, optional
        Default: the rest at which the program is met. A dict may name some coordinates of a rest, or a whole state.
    end : "rest", "bounded", "free", or dict of str to float
        "rest": a rest at which the program is met; the start is at rest then, too. "bounded": open, but for unstable
        modes of the internal dynamics, which would grow until the end. "free": open. Or values of states at the end.

    Returns
    -------
    Run or Study
        The motion of the plant under these inputs, piecewise polynomials of time; `run.residual` is how far the program
        is missed. For several weights a table of largest and root mean square errors and inputs.

    Raises
    ------
    LimitExceeded
        If limits or bounds admit no motion between the ends.
    InconsistentStart
        If there is no rest, or the start is none.
    SpecificationError
        For a weight above which standing still is cheaper than the program, and for a program that moves at an end
        where the plant rests.
    IntegrationStopped
        If the iteration fails otherwise.
    NameUnknown
        For a name that is no residual, actuator, state or output.
    """
    require_kind(Plant, "plant", plant, "sv.plant(mechanism)")
    require_kind(Program, "program", program, "sv.Program({...})")
    program = require_parts(plant.mechanism, program, {})
    named = [name for given in (start, end, limits, plant.limits, bounds) for name in names_of(given)]
    plant = part_of(plant, needed(plant.mechanism, program, named=named))
    limits = _all_limits(plant, limits)
    relaxation = Relaxation(at_once(plant), program, as_span(t_span, forward=True), limits, bounds, start, end)
    several = None if isinstance(weight, Mapping) else as_list(weight)
    if several is None:
        return relaxation.run(weights_of(weight, program))
    weights = positives("weight", several, "Write weight=[1e-6, 1e-8].")
    return relaxation.front(array_of("weight", weights, None).tolist())


def weights_of(weight, program):
    """β of each residual, (k,); None for the default."""
    if weight is None:
        return None
    if not isinstance(weight, Mapping):
        return np.full(len(program.names), positive_number("weight", weight))
    weight = numbers_by_name(weight, program.names, "residual", "weight", positive=True)
    for name in program.names:
        if name not in weight:
            raise SpecificationError(
                f"The residual {name!r} has no weight.", "Each residual has one.", do=f"Add {name!r}.", name=name
            )
    return np.array([weight[name] for name in program.names])


def _all_limits(plant, limits):
    """(low, high) of actuators and of their rates, by name: the limits of the plant and further ones."""
    known = dict(plant.limits) | {f"d{name}": (-rate, rate) for name, rate in plant.rate_limits.items()}
    names = [*plant.inputs, *(f"d{name}" for name in plant.inputs)]
    for name, value in by_name(limits, names, "actuator or rate", "The limits").items():
        (low, high), before = interval(name, value, "limit"), known.get(name, UNLIMITED)
        known[name] = max(low, before[0]), min(high, before[1])
        if not known[name][0] < known[name][1]:
            raise SpecificationError(
                f"The limit of {name!r} is ({low:g}, {high:g}), that of the plant ({before[0]:g}, {before[1]:g}).",
                "Both hold.",
                do="Choose limits within those of the plant.",
                name=name,
            )
    return known


@frozen
class Plan:
    """A solution: states (n_x, 1 + N s), control points of the inputs (m, 1 + P s), and counts of the iterations."""

    mesh: Mesh
    pieces: Mesh
    x: np.ndarray
    points: np.ndarray
    iterations: tuple = ()
    beta: np.ndarray | None = None


class Relaxation(Transfer):
    """The relaxed inverse of a transfer; `run` solves for weights."""

    def _first(self, mesh):
        """The guess on a mesh."""
        times, nodes = np.linspace(*self.span, GUESS), np.append(mesh.edges[0], mesh.nodes)
        x = np.array([np.interp(nodes, times, row) for row in self.states])
        return Plan(mesh, mesh, x, np.array([np.interp(mesh.places_of_points, times, row) for row in self.inputs]))

    # solutions

    def run(self, beta):
        """The run of weights (k,), by default a small part of the usual ones."""
        if beta is None:
            usual = self._usual_weights()
            beta = DEFAULT * np.where(np.isfinite(usual), usual, 1.0 / self.sizes[3])
        return self._as_run(self._plan(beta))

    def front(self, weights):
        """A Study of weights, each for all residuals: how far the program is missed, against the actuation."""
        plan, rows = None, {}
        for weight in sorted(set(weights), reverse=True):
            plan = self._plan(np.full(len(self.program.names), weight), plan)
            rows[weight] = {"weight": weight, **self._measured(plan)}
        columns = {name: [rows[weight][name] for weight in weights] for name in rows[weights[0]]}
        facts = {"residuals": list(self.program.names), "actuators": list(self.plant.inputs), "t_span": list(self.span)}
        return Study("relaxed", columns, facts | {"machine": machine()})

    def _measured(self, plan):
        """Largest and root mean square values of residuals and inputs, the effort, and how well it is solved."""
        t = np.linspace(*self.span, SAMPLES + 1)
        f = self.node.function("signals", self.node.residuals, self.node.effort).map(len(t))
        v = self._inputs_of(plan, t)
        residuals, effort = (np.array(part) for part in f(self.node.at(t), plan.x @ plan.mesh.of_states(t), v))
        signals = dict(zip((*self.program.names, *self.plant.inputs), (*residuals, *v[: self.m]), strict=True))
        largest = {f"largest {name}": np.abs(values).max() for name, values in signals.items()}
        rms = {f"rms {name}": np.sqrt(np.mean(values**2)) for name, values in signals.items()}
        facts = {"effort": np.mean(effort) * np.ptp(self.span), "iterations": max(plan.iterations)}
        return largest | rms | facts | {"intervals": len(plan.mesh.h), "defect": self._defects(plan).max()}

    def _plan(self, beta, near=None):
        """The plan of weights (k,), from one of greater weights or from the guess, on a mesh that is fine enough."""
        plan = self._continued(beta, near)
        for _ in range(ROUNDS):  # of the mesh
            finer = self._finer(plan)
            if finer is None:
                break
            plan = self._solved(finer, [beta], finer.iterations)
        worst = self._defects(plan)
        if worst.max() > COARSE:
            k = int(np.argmax(worst))
            raise IntegrationStopped(
                f"Between the nodes at t = {plan.mesh.edges[k]:.4g} s the plan misses the equations of motion by "
                f"{worst[k]:.1e}, with {len(worst)} intervals.",
                f"Relative to the states' sizes a plan misses them by at most {COARSE:g}.",
                do="Choose a greater weight, wider limits or a shorter span.",
                t=float(plan.mesh.edges[k]),
                defect=float(worst[k]),
                intervals=len(worst),
            )
        return replace(plan, beta=beta)

    def _mesh(self):
        """Intervals of about the same length between the breaks of the program's paths."""
        corners = np.array(breakpoints(self.span, sorted({*self.node.breaks(*self.span)})))
        counts = np.maximum(1, np.ceil(np.diff(corners) * INTERVALS / np.ptp(corners) * (1 - 1e-9))).astype(int)
        return Mesh(subdivided(corners, counts), ORDER)

    def _continued(self, beta, near):
        """The plan of weights from one of greater weights, or from the guess, over weights between."""
        usual = self._usual_weights()
        if np.any(beta > usual):
            raise self._useless(beta, usual)
        if near is not None:
            first = near.beta / beta
        else:
            near_rest = FIRST * (FACTOR if self.bounds else 1.0)  # bounds are met sooner by plans of little motion
            first = near_rest * usual / beta if self._exact is None else np.ones(1)
        factor = max(1.0, float(np.min(first[np.isfinite(first)], initial=np.inf)))
        steps = int(np.ceil(np.log(factor) / np.log(FACTOR))) if np.isfinite(factor) else 0
        weights = [beta * factor ** (1 - k / max(steps, 1)) for k in range(near is not None and steps > 0, steps + 1)]
        return self._solved(self._first(self._mesh()) if near is None else near, weights)

    def _usual_weights(self):
        """Weights (k,) for which standing still costs as much as the actuation of the program."""
        f = self.node.function("residuals", self.node.residuals)
        v = np.concatenate([self.begin_inputs, np.zeros(self.m * self.node.depth)])
        still = np.hstack([np.array(f(self.node.at([t]), self.begin, v)) for t in np.linspace(*self.span, GUESS)])
        moved = np.abs(still).max(axis=1)
        return np.where(moved > 0, moved**2 / self.sizes[3], np.inf)

    def _solved(self, plan, weights, iterations=()):
        """The plan of the last of falling weights, each solved from the one before."""
        nlp = Transcription(self.node, plan.mesh, plan.pieces, self.sizes, self.opening, self.target[2])
        sides, w, iterations = self._sides(plan), nlp.joined(plan.x, plan.points), list(iterations)
        for beta in weights:
            w, stats = nlp.solve(w, beta, sides)
            iterations.append(stats["iter_count"])
            if words(stats):
                raise self._failed(nlp, plan, beta, stats)
        return replace(plan, **dict(zip(("x", "points"), nlp.apart(w), strict=True)), iterations=tuple(iterations))

    def _sides(self, plan):
        """Sides of the states, of the control points, and of the constraints that have some, by kind."""
        inputs, (_, u_size, size, _) = self.plant.inputs, self.sizes
        x, count = _sides([UNLIMITED] * self.n, plan.x.shape[1]), plan.points.shape[1]
        if self.opening is None:
            x[:, :, 0] = self.begin
        fixed = np.isfinite(self.target[0])
        x[:, fixed, -1] = self.target[0][fixed]
        u = _sides([self.limits.get(name, UNLIMITED) for name in inputs], count)
        rates = [f"d{name}" for name in inputs]
        limited = np.array([rate in self.limits for rate in rates])  # which do not jump
        if self.held is not None:
            u[:, limited, 0] = self.held[limited]
        if self.target[1] is not None and not self.target[2]:
            u[:, limited, -1] = self.target[1][limited]
        return {
            "x": x,
            "u": u,
            "begin": _sides(np.where(limited[:, None], UNLIMITED, 0.0), 1),
            "slope": _sides([self.limits.get(name, UNLIMITED) for name in rates], count - 1) / u_size[:, None],
            "bound": _sides(self.bounds.values(), WATCHED * len(plan.pieces.h)) / size[:, None],
        }

    def _useless(self, beta, usual):
        i = int(np.argmax(beta / usual))
        name = self.program.names[i]
        return SpecificationError(
            f"The weight of {name!r} is {beta[i]:.3g}.",
            f"Above {usual[i]:.3g} standing still costs less than the program.",
            nearest=f"{FIRST * usual[i]:.1g}.",
            do="A weight is in (unit of the residual)²/(unit of the inputs)², such as m²/N²; choose a smaller one.",
            name=name,
            weight=float(beta[i]),
            most=float(usual[i]),
        )

    def _failed(self, nlp, plan, beta, stats):
        """The error of an iteration that ends without a solution: what would be exceeded without limits, and where."""
        facts = {"status": stats["return_status"], "weights": beta.tolist()}
        limits = self.limits | self.bounds
        free = copy(self)
        free.limits, free.bounds = {}, dict.fromkeys(self.bounds, UNLIMITED)
        w, without = nlp.solve(nlp.joined(plan.x, plan.points), beta, free._sides(plan)) if limits else (None, stats)
        if words(without):
            return IntegrationStopped(
                f"IPOPT {words(stats)}.",
                "A plan satisfies the equations of motion and the conditions at both ends.",
                do="Choose a greater weight, a longer span, or a start and an end nearer to the program.",
                **facts,
            )
        run = free._as_run(Plan(plan.mesh, plan.pieces, *nlp.apart(w)))
        _, name, _, t, value, limit = max(excesses(run, limits))
        kind = LimitExceeded if facts["status"] == "Infeasible_Problem_Detected" else IntegrationStopped
        return kind(
            f"IPOPT {words(stats)} within the limits and bounds; without them {name} is {value:.5g} at t = {t:.4g} s, "
            f"beyond {limit:.5g}.",
            "A plan keeps all limits from end to end.",
            do="Widen this limit, choose a greater weight, or give the transition more time.",
            row=name,
            t=t,
            value=float(value),
            limit=float(limit),
            **facts,
        )

    def _inputs_of(self, plan, t):
        """(u, u', ...) at instants (M,), as the node takes them."""
        return np.vstack([plan.points @ plan.pieces.of_inputs(t, rate) for rate in range(self.node.depth + 1)])

    def _defects(self, plan):
        """Largest defect h (x' - f) between the nodes of each interval, relative to the sizes of the states, (N,)."""
        mesh, x, theta = plan.mesh, plan.x, np.array(PLACES)
        t = (mesh.edges[:-1, None] + mesh.h[:, None] * theta).ravel()
        f = self.node.function("rates", self.node.rates).map(len(t))
        v = self._inputs_of(plan, t)
        defect = x @ mesh.of_states(t, 1) - np.array(f(self.node.at(t), x @ mesh.of_states(t), v))
        defect *= np.repeat(mesh.h, len(theta)) / state_sizes(x, self.nq, self.span)[:, None]
        return np.abs(defect).max(axis=0).reshape(len(mesh.h), -1).max(axis=1)

    def _finer(self, plan):
        """The plan on a finer mesh where its motion is not that of the plant; None where it is, or at the finest."""
        mesh, defect = plan.mesh, self._defects(plan)
        pieces = np.ceil((defect / (AIM * DEFECT)) ** (1 / (1 + len(mesh.c)))).astype(int)
        pieces = np.where(defect > DEFECT, np.clip(pieces, 2, MOST_PIECES), 1)
        if pieces.max() == 1 or pieces.sum() > MOST_INTERVALS:
            return None
        finer = Mesh(subdivided(mesh.edges, pieces), mesh.order)
        nodes = np.append(mesh.edges[0], finer.nodes)
        return replace(plan, mesh=finer, x=plan.x @ mesh.of_states(nodes))

    def _as_run(self, plan):
        """The run of the plant under the plan's inputs."""
        mesh, coefficients = plan.mesh, plan.pieces.power_coefficients(plan.points).transpose(1, 2, 0)
        classes = np.pad(np.zeros(len(plan.pieces.h) - 1), 1, constant_values=np.inf)  # inputs are continuous
        path = Path(plan.pieces.edges, coefficients, classes, "continue", "continue")
        inputs = {name: path[i] for i, name in enumerate(self.plant.inputs)}
        model = driven(self.plant, inputs, self.program.residuals)
        parts = max(1, -(-SAMPLES // len(mesh.h)))
        t = subdivided(mesh.edges, np.full(len(mesh.h), parts))
        x = plan.x @ mesh.of_states(t)
        v = self._inputs_of(plan, t)
        motion = self.node.function("motion", self.node.acceleration).map(len(t))
        jets = np.vstack([x, np.array(motion(self.node.at(t), x, v))])
        if not np.isfinite(model.function("ode").grid(t, x, model.p)).all():
            model = derived_near(model, t[0], jets[:, 0])  # material constraints whose pivot vanishes at the rest
        counters = {"iterations": sum(plan.iterations), "intervals": len(mesh.h), "solves": len(plan.iterations)}
        run = Run(
            t,
            jets,
            tuple(model.jet_names),
            model,
            "relaxed",
            counters=counters,
            knots=tuple(plan.pieces.edges[1:-1].tolist()),
            start=State(float(t[0]), x[:, 0].copy(), tuple(model.state_names), (), (), 0.0),
        )
        missed = ", ".join(f"{name} {np.abs(run.residual[name]).max():.2g}" for name in self.program.names)
        begins = "" if self.opening is None else "begins on its bounded motion; "
        return replace(run, message=f"finished; {begins}the program is missed by at most {missed}{self._exceeded(run)}")

    def _exceeded(self, run):
        """How far samples between the instants of bounds exceed these, for the message; "" if they do not."""
        text = ""
        for name, (low, high) in self.bounds.items():
            values = run[as_read(run, name)]
            excess = float(np.max(np.maximum(low - values, values - high)))
            if excess > EXCEEDED * size_of_limit(low, high):
                text += f"; between its instants {name} exceeds its bound by {excess:.2g}"
        return text


def _sides(sides, count):
    """Sides (rows of (low, high)) at each of so many instants, (2, rows, instants)."""
    return np.array([*sides], dtype=float).reshape(-1, 2).T[:, :, None].repeat(count, axis=2)
