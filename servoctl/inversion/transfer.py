"""What a relaxed plan joins: states and inputs at both ends, and a motion between them, where the iteration begins."""

from collections.abc import Mapping
from functools import cached_property

import casadi as ca
import numpy as np

from servoctl.checks import interval, mapping, numbers_by_name, rows_read
from servoctl.codegen.paths import Followed
from servoctl.errors import InconsistentStart, LimitExceeded, ServoError, SpecificationError, unknown
from servoctl.inversion.transcription import Node
from servoctl.methods.bounded import End, FreeEntries
from servoctl.model.model import derive
from servoctl.model.rests import RANK, Rests
from servoctl.model.start import State
from servoctl.plants.plant import refuse_references
from servoctl.simulation import simulated
from servoctl.spec.references import Jets, paths_at, rates_in_time, required_paths
from servoctl.values import frozen

EXCEEDED = 1e-6  # of a bound: excess between its instants that a run reports, and at the ends that is refused
GUESS = 241  # instants of the guess
STANDING = 1e-6  # rate of a program that stands still, relative to its largest


@frozen
class Near:
    """A start in motion whose unstable modes are open, so that the plan begins on its bounded motion."""

    state: State  # of the model of the program, near which the plan begins

    @property
    def names(self):
        """Names of the state's entries."""
        return self.state.names


class Transfer:
    """A plant, a program, the limits and bounds of a plan, and its ends.

    Inputs of the plant act at once; `limits` are those of actuators and of their rates, (low, high) by name;
    `bounds`, `start` and `end` are as for `relaxed`. The state at t0 is `begin` (n_x,), or near it where it is open,
    and then `opening`, of (t, x), vanishes there; `held` (m,) are the inputs that hold it at rest, None if it may move.
    `target` is what is fixed at t1: state (n_x,), NaN where it is open, inputs (m,) or None, and a function of
    (t, x, v) that vanishes, or None. `states` (n_x, G) and `inputs` (m, G) are the guess at equal instants, `sizes`
    those that `Transcription` takes.
    """

    def __init__(self, plant, program, span, limits, bounds, start, end):
        refuse_references(plant, "The transfer is")
        self.plant, self.program, self.span, self.end = plant, program, span, end
        self.limits = limits
        self.n, self.m, self.nq = plant.n_x, len(plant.inputs), plant.mechanism.q.nq
        self.bounds = {name: interval(name, value, "bound") for name, value in mapping(bounds, "The bounds").items()}
        self.node = Node(plant, program, self._bounded())
        self.rests, self.numbers = rests(plant, program)
        self.begin, self.held = self._begin(start)
        self.states, self.inputs, self.sizes = self._guess()
        self.opening = self._opening(start.state) if isinstance(start, Near) else None
        self.target = self._target()
        self._require_bounds_at_ends()

    def _bounded(self):
        """Bounded quantities as expressions."""
        mechanism, q = self.plant.mechanism, self.plant.mechanism.q
        jets = {name: s for k in range(3) for name, s in zip(q.jet_names(k), ca.vertsplit(q.jet(k)), strict=True)}
        rows = rows_read(self.program.residuals, mechanism.signals)
        known = jets | mechanism.outputs | {name: self.program.residuals[row] for name, row in rows.items()}
        for name in self.bounds:
            if name in (*self.plant.inputs, *(f"d{u}" for u in self.plant.inputs)):
                raise SpecificationError(
                    f"bounds has {name!r}, an actuator or the rate of one.",
                    "Bounds are of states, outputs and residuals; those of actuators are limits.",
                    do=f"Write limits={{{name!r}: ...}}.",
                    name=name,
                )
            if name not in known:
                raise unknown(name, known, "state, output or residual")
        return {name: known[name] for name in self.bounds}

    # the ends

    @property
    def _to_rest(self):
        return isinstance(self.end, str) and self.end == "rest"

    def _begin(self, start):
        """The state at t0, and the inputs that hold it at rest; None if it may move."""
        nq, t0 = self.nq, self.span[0]
        if start is None or isinstance(start, dict) and set(start) <= set(self.plant.mechanism.q.names):
            self._require_standing(t0, "start")
            given = numbers_by_name(start, self.plant.mechanism.q.names, "coordinate", "start")
            found, worst = self.rests.nearest(t0, self.numbers, given, given)
            if not found:
                raise _no_rest("start", t0, worst)
            return np.concatenate([found[0][:nq], np.zeros(self.n - nq)]), self._held(found[0], "start")
        start = start.state if isinstance(start, Near) else start
        values = start.values[: self.n] if isinstance(start, State) else start
        x = self.plant.state(values)
        if not self._to_rest:
            return x, None
        self._require_standing(t0, "start")
        some = [name not in self.program.residuals for name in self.rests.names]
        fixed = np.zeros(nq, bool)
        rest, there, worst = self.rests.reached(t0, self.numbers, x[:nq], fixed, some=some)
        speeds = dict(zip(self.plant.state_names[nq:], x[nq:].tolist(), strict=True))
        if not there or np.any(x[nq:]):
            raise _no_equilibrium(t0, worst, speeds)
        return x, self._held(rest, "start")

    def _held(self, rest, where):
        """Inputs that hold a rest within the limits of magnitude."""
        t, u = self.span[where == "end"], rest[self.nq : self.nq + self.m]
        low, high = np.array([self.limits.get(name, (-np.inf, np.inf)) for name in self.plant.inputs]).reshape(-1, 2).T
        if np.all((u >= low) & (u <= high)):
            return u
        from scipy.optimize import lsq_linear

        B = self.rests.measured(t, rest, self.numbers)[1][:, self.nq :]
        held, free = np.split(B, [self.m], axis=1)  # by inputs and by the forces of constraints
        B = held - free @ np.linalg.lstsq(free, held, rcond=RANK)[0]
        found = lsq_linear(B, B @ u, (low, high), tol=1e-12)
        if np.abs(B @ (found.x - u)).max() <= 1e-6 * np.abs(B @ u).max():
            return np.clip(found.x, low, high)
        worst = int(np.argmax(np.maximum(low - u, u - high)))
        name = self.plant.inputs[worst]
        raise LimitExceeded(
            f"At rest at the {where}, t = {t:g} s, {name} = {u[worst]:.6g}; its limits are {low[worst]:g} and "
            f"{high[worst]:g}.",
            "The inputs that hold the machine at rest lie within the limits.",
            nearest=f"A limit of at least {abs(u[worst]):.6g}.",
            name=name,
            t=t,
            value=float(u[worst]),
            limit=(float(low[worst]), float(high[worst])),
        )

    def _require_standing(self, t, where):
        """Refuse a program that moves at an instant at which the plant rests."""
        q = self.node.q
        moving = ca.vertcat(*q.gamma(1), *(s for k in range(2, 3 + self.node.depth) for s in q.gamma(k)))
        orders = {name: q.order(e) for name, e in self.program.residuals.items()}
        rates = [rates_in_time(q, e) if orders[name] <= 0 else e for name, e in self.program.residuals.items()]
        values = ca.substitute(self.node.known(ca.vertcat(*rates)), moving, ca.SX.zeros(moving.numel()))
        jets = self.node.jets_of([values])
        f = ca.Function("rates", [q.t, jets.symbols, ca.vertcat(*q)], [values])
        some = np.full(self.nq, 0.3)  # a place where expressions of the coordinates have values
        times = np.linspace(*self.span, 101)
        along = np.hstack([np.array(f(s, r, some)) for s, r in zip(times, jets.at(times).T, strict=True)])
        at = np.array(f(t, jets.at([t]), some)).ravel()
        moved = np.abs(at) > STANDING * np.abs(along).max(axis=1)
        if moved.any():
            name = list(orders)[int(np.argmax(moved))]
            raise SpecificationError(
                f"The program's residual {name!r} moves at the {where}, t = {t:g} s: at rest it "
                f"{'changes by' if orders[name] <= 0 else 'is'} {at[np.argmax(moved)]:.4g}"
                f"{' 1/s' if orders[name] <= 0 else ''}.",
                "Where the plant rests, the program does, too.",
                do="Choose a span between rests of the program, or end='free' and a start with its velocities.",
                name=name,
                t=float(t),
                rate=float(at[np.argmax(moved)]),
            )

    def _target(self):
        """What is fixed at the end: (state with NaN where open, inputs or None, function that vanishes or None)."""
        open_ = np.full(self.n, np.nan)
        if isinstance(self.end, str) and self.end == "free":
            return open_, None, None
        if isinstance(self.end, Mapping):
            given = numbers_by_name(self.end, self.plant.state_names, "state", "value at the end")
            open_[[self.plant.state_names.index(name) for name in given]] = [*given.values()]
            return open_, None, None
        if isinstance(self.end, str) and self.end == "bounded":
            return open_, None, self._without_growth()
        if not self._to_rest:
            raise SpecificationError(
                f"end={self.end!r}.", "It is 'rest', 'bounded', 'free', or values of states by name.", end=self.end
            )
        t1 = self.span[1]
        self._require_standing(t1, "end")
        rest, there, worst = self.rests.reached(t1, self.numbers, self.states[: self.nq, -1])
        if not there:
            raise _no_rest("end", t1, worst)
        held = self._held(rest, "end")
        slopes = self.rests.measured(t1, rest, self.numbers)[1]
        slopes = slopes / np.maximum(np.abs(slopes).max(axis=1, keepdims=True), 1e-300)
        open_directions = np.linalg.svd(slopes)[2][np.linalg.matrix_rank(slopes, RANK) :, : self.nq]
        if np.abs(open_directions).max(initial=0.0) < RANK:  # the rest is isolated
            return np.concatenate([rest[: self.nq], np.zeros(self.n - self.nq)]), held, None
        open_[self.nq :] = 0.0
        return open_, held, self._independent(rest[: self.nq], held)

    def _unstable(self, t, x, of_start):
        """What the program leaves free at a state, its tangent, and its unstable modes (k, f); None if there are none.

        Of a start the modes are directions in which motions grow, of an end rows that vanish where none does.
        """
        try:
            entries = FreeEntries(self._exact_model, t, x)
        except ServoError:
            return None
        with np.errstate(all="ignore"):
            _, (A,), _, (tangent,) = entries.local(np.array([t]), x[:, None])
        if A.size == 0 or not np.isfinite(A).all():
            return None
        modes = End(t, x, A.T if of_start else A, entries.size[entries.free]).left_space(unstable=True)
        return (entries, tangent, modes) if len(modes) else None

    def _opening(self, start):
        """A function of (t, x) that vanishes on the program for all values of the unstable modes; None if none are.

        Of the entries of the state that the program leaves free, the directions of unstable modes at the start are
        open, and what complements them is that of the start.
        """
        values = np.asarray(start.values, dtype=float)
        found = self._unstable(start.t, values, of_start=True)
        if found is None or tuple(self._exact_model.state_names) != tuple(self.plant.state_names):
            return None
        (entries, _, opened), model = found, self._exact_model
        closed = np.linalg.svd(opened)[2][len(opened) :]
        t, x, free = self.node.q.t, self.node.state, entries.free.tolist()
        on_program = model.equations.called(model.function("invariants").expression, x, model.parameters)[: entries.m]
        jets = Jets(self.node.q, [on_program], model.paths)
        on_program = ca.substitute(on_program, jets.symbols, jets.at([start.t]))
        rows = ca.vertcat(on_program, ca.DM(closed) @ (x[free] - ca.DM(values[free])))
        return ca.Function("start", [t, x], [ca.densify(ca.cse(rows))], {"der_options": {"cse": True}})

    def _without_growth(self):
        """A function of (t, x, v): unstable modes of the internal dynamics, which are those of the guess at the end.

        The exact plan from a start near its bounded motion has modes that grow until the end. Their values there are
        open to tiny changes of the program; fixed, they leave a layer of a few time constants at the end.
        """
        x, t1 = self.states[:, -1], self.span[1]
        try:
            model = self._exact_model
            near = dict(zip(self.plant.state_names, x, strict=True))
            state = model.start(t1, guess={name: near.get(name, 0.0) for name in model.state_names})
        except ServoError:
            return None
        found = self._unstable(t1, np.asarray(state.values), of_start=False)
        if found is None:
            return None
        _, tangent, modes = found
        places = [model.state_names.index(name) for name in self.plant.state_names]
        rows = modes @ np.linalg.pinv(tangent[places])
        return self.node.function("unstable", ca.DM(rows) @ (self.node.state - ca.DM(x)))

    def _require_bounds_at_ends(self):
        """Refuse bounds that a fixed state at an end exceeds, whatever the inputs."""
        node, t = self.node, np.array(self.span)
        f = node.function("bounded", node.bounded)
        begin = self.begin if self.opening is None else np.full(self.n, np.nan)
        for k, (where, x) in enumerate((("start", begin), ("end", self.target[0]))):
            values = np.array(f(node.at(t[[k]]), x, np.zeros(node.v.numel()))).ravel()
            for name, value, each in zip(node.bounds, values, node.bounded.elements(), strict=True):
                low, high = self.bounds[name]
                excess = max(low - value, value - high)
                if excess > EXCEEDED * max(1.0, abs(value)) and not ca.depends_on(each, node.v):
                    raise LimitExceeded(
                        f"At the {where}, t = {t[k]:g} s, {name} = {value:.6g}; its bound is ({low:g}, {high:g}).",
                        "The states at both ends lie within the bounds.",
                        do=f"Widen the bound, or choose another {where}.",
                        name=name,
                        t=float(t[k]),
                        value=float(value),
                        limit=(low, high),
                    )

    def _independent(self, rest, held):
        """A function of (t, x, v) whose values vanish at rests near this one, without dependent rows."""
        from scipy.linalg import qr

        node, q = self.node, self.node.q
        rows = {**self.plant.mechanism.constraints, **self.program.residuals, **q.invariants}
        rows = ca.vertcat(node.acceleration, *(node.known(e) for e in rows.values() if q.order(e) <= 0))
        rows = ca.substitute(rows, q.jet(1), ca.SX.zeros(q.n))
        unknown = ca.vertcat(q.jet(0), node.v[: self.m])
        slopes = ca.Function("slopes", [node.instant, unknown], [ca.densify(ca.jacobian(rows, unknown))])
        slopes = np.array(slopes(node.at(self.span[1:]), np.concatenate([rest, held])))
        scaled = slopes / np.maximum(np.abs(slopes).max(axis=1, keepdims=True), 1e-300)
        order = qr(scaled.T, pivoting=True)[2][: np.linalg.matrix_rank(scaled, RANK)]
        return node.function("rest", rows[np.sort(order).tolist()])

    # where the iteration begins

    @cached_property
    def _exact_model(self):
        """The model of the program with the plant's numbers, or the error of its derivation."""
        model = derive(self.plant.mechanism, self.program)
        names = self.plant.mechanism.parameters.names
        return model.with_parameters(**dict(zip(names, self.plant.parameters, strict=False)))

    @cached_property
    def _exact(self):
        """The exact plan of a program that determines the motion completely; None if there is none."""
        try:
            model = self._exact_model
            return simulated(model, model.start(self.span[0]), self.span, progress=False) if model.flat else None
        except ServoError:
            return None

    def _guess(self):
        """States (n_x, G) and inputs (m, G) at equal instants, and the sizes that `Transcription` takes."""
        times = np.linspace(*self.span, GUESS)
        if self._exact is not None:
            x = np.array([np.interp(times, self._exact.t, self._exact[name]) for name in self.plant.state_names])
            u = np.array([np.interp(times, self._exact.t, self._exact[name]) for name in self.plant.inputs])
        else:
            x, u = self._quasi_static(times)
        x_size = state_sizes(x, self.nq, self.span)
        effort = self.node.function("effort", self.node.effort)
        u_size = np.abs(u).max(axis=1)
        u_size = np.where(u_size > 1e-6 * u_size.max(), u_size, u_size.max() or 1.0)
        v = np.concatenate([u_size, np.zeros(self.m * self.node.depth)])
        at_start = float(effort(self.node.at(self.span[:1]), self.begin, v)) or 1.0
        return x, u, (x_size, u_size, self._bounded_sizes(times, x, u), at_start)

    def _bounded_sizes(self, times, x, u):
        """Size of each bounded quantity (b,): its largest value along states and inputs, at least that of its sides."""
        v = np.vstack([u, np.zeros((self.m * self.node.depth, len(times)))])
        values = np.array(self.node.function("bounded", self.node.bounded).map(len(times))(self.node.at(times), x, v))
        sides = np.array([*self.bounds.values()]).reshape(-1, 2)
        both = np.abs(np.hstack([values.reshape(len(sides), len(times)), sides]))
        largest = np.max(both, axis=1, where=np.isfinite(both), initial=0.0)
        return np.where(largest > 0, largest, 1.0)

    def _quasi_static(self, times):
        """Rests at frozen instants, with the speeds and the inertia of moving through them slowly."""
        rests, z = np.full((self.nq + self.m, len(times)), np.nan), self.begin
        for k, t in enumerate(times):
            z, there, _ = self.rests.reached(t, self.numbers, z[: self.nq])
            rests[:, k] = z[: self.nq + self.m] if there else np.nan
        rests[: self.nq, 0] = self.begin[: self.nq]
        rests[self.nq :, 0] = np.zeros(self.m) if self.held is None else self.held
        known = np.isfinite(rests).all(axis=0)
        rests = np.array([np.interp(times, times[known], row[known]) for row in rests])
        q, u = rests[: self.nq], rests[self.nq :]
        kinematics = self.node.function("kinematics", self.node.q.V, self.node.q.h)
        mechanism = self.plant.mechanism
        forces = self.node.known(mechanism.mass), self.node.known(mechanism.E)
        motion = self.node.function("motion", self.node.acceleration, *forces)
        rate = np.gradient(q, times, axis=1)
        v = np.vstack([u, np.zeros((self.m * self.node.depth, len(times)))])
        instants = self.node.at(times)
        V, h = _at_each(kinematics, instants, np.vstack([q, np.zeros((self.n - self.nq, len(times)))]), v)
        w = (np.linalg.pinv(V) @ (rate.T[:, :, None] - h))[:, :, 0].T
        present, M, E = _at_each(motion, instants, np.vstack([q, w]), v)
        inertial = M @ (np.gradient(w, times, axis=1).T[:, :, None] - present)
        u = u + (np.linalg.pinv(E) @ inertial)[:, :, 0].T
        return np.vstack([q, w]), u

    @property
    def begin_inputs(self):
        """Inputs that hold the start at rest (m,), or zeros."""
        return np.zeros(self.m) if self.held is None else self.held


def _at_each(f, t, x, v):
    """Values of a function of (t, x, v) at instants (., N): an (N, rows, columns) array for each output."""
    values = f.map(t.shape[1])(t, x, v)
    return [np.array(part).reshape(part.size1(), t.shape[1], -1).swapaxes(0, 1) for part in values]


def rests(plant, program):
    """The rests of a plant under a program with any inputs, and what their functions take as parameters."""
    numbers = np.array(plant.parameters[: len(plant.mechanism.parameters.names)])
    found, paths = Rests.of_program(plant.mechanism, plant.equations.forces, program), plant.mechanism.q.family.paths
    if not found.references:
        return found, numbers
    followed = required_paths({name: paths[name] for name in found.references})
    followed = paths_at(followed, plant.mechanism.parameters, numbers)
    found.followed = Followed([path.held() for path in followed.values()])
    return found, np.append(found.followed.address, numbers)


def state_sizes(x, nq, span):
    """Size of each state (n_x,): its range, at least a part of that of others at its level."""
    ranges = np.ptp(x, axis=1)
    for level, floor in ((slice(nq), 1.0), (slice(nq, None), 1.0 / (span[1] - span[0]))):
        ranges[level] = np.maximum(ranges[level], 1e-2 * (ranges[level].max(initial=0.0) or floor))
    return ranges


def _no_rest(where, t, worst):
    row, value = worst
    return InconsistentStart(
        f"There is no rest at the {where}, t = {t:g} s, at which the program is met: {row} remains {value:.3g}.",
        "The plan begins and ends at rest where start or end do not say otherwise.",
        do="Give coordinates near the rest in start={...}, or end='free'.",
        where=where,
        t=float(t),
        row=row,
        value=value,
    )


def _no_equilibrium(t, worst, speeds):
    row, value = worst
    moving = {name: speed for name, speed in speeds.items() if speed}
    what = ", ".join(f"{name} = {speed:g}" for name, speed in moving.items()) or f"{row} = {value:.4g}"
    return InconsistentStart(
        f"The start at t = {t:g} s is no equilibrium: {what}.",
        "With end='rest' the plan leaves a rest, at which inputs hold the machine.",
        do="Leave start= out, or write end='free' or the values of states at the end.",
        t=float(t),
        row=row,
        value=value,
        speeds=moving,
    )
