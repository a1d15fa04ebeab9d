"""The relaxed inverse as a nonlinear program: collocation at Radau nodes.

On each interval of a mesh the states are polynomials of degree s through its begin and s Radau nodes, where they
satisfy x' = f(t, x, u). Inputs are continuous; on an interval they are polynomials of the same degree in Bernstein's
form: they stay within the hull of their control points, so that limits of these points hold at all instants.
"""

from functools import cached_property, partial
from math import comb

import casadi as ca
import numpy as np

from servoctl.control.nonlinear import solver
from servoctl.methods.bounded import basis_rates
from servoctl.methods.radau import basis, radau
from servoctl.spec.references import Jets, rates_in_time
from servoctl.values import frozen

WATCHED = 12  # instants of bounds in an interval of the inputs


class Node:
    """Expressions at an instant t, of the state x and of v = (u, u', ...), with the numbers of a plant inserted.

    The plant's inputs act at once. `bounded` has the quantities with bounds by name, in symbols of its mechanism.
    """

    def __init__(self, plant, program, bounded):
        e = plant.equations
        self.q, self.bounds = e.q, tuple(bounded)
        residuals, effort = ca.vertcat(*program.residuals.values()), ca.SX(0)
        for name, u in zip(plant.inputs, e.u.elements(), strict=True):
            effort += program.weights.get(name, 1.0) * (u - program.toward.get(name, 0.0)) ** 2
        quantities = ca.vertcat(residuals, effort, *bounded.values())
        self.depth = max(0, max((self.q.order(x) for x in quantities.elements()), default=0) - 2)
        jets = [e.u, *(ca.SX.sym(f"u{k}", e.u.numel()) for k in range(1, self.depth + 1))]
        self.v, self.state = ca.vertcat(*jets), e.state
        self._numbers = e.p, ca.vertcat(ca.DM(plant.parameters), e.u, ca.SX.zeros(e.d.numel()))
        self.rates, self.acceleration = self.known(e.state_rates), self.known(e.acceleration)
        values = self._along(self.known(quantities), jets)
        k = residuals.numel()
        self.residuals, self.effort, self.bounded = values[:k], values[k], values[k + 1 :]
        kinematics = [self.known(each) for each in (self.q.V, self.q.h, plant.mechanism.mass, plant.mechanism.E)]
        numbers = plant.mechanism.parameters, plant.parameters
        self.jets_of = partial(Jets, self.q, paths=self.q.family.paths, numbers=numbers)
        self._jets = self.jets_of([values, self.rates, self.acceleration, *kinematics])
        self.instant = ca.vertcat(self.q.t, self._jets.symbols)

    def at(self, t):
        """Times (N,) [s] with the references there, as functions take them."""
        return np.vstack([t, self._jets.at(t)])

    def breaks(self, low, high):
        """Instants [s] at which the references switch between polynomials, a list."""
        paths = [path.held() for path in self._jets.paths.values()]
        return [t for path in paths for t in path.breaks_below(np.inf, low, high).tolist()]

    def known(self, expression):
        """An expression of the mechanism with the plant's numbers."""
        return ca.substitute(expression, *self._numbers)

    def _along(self, quantities, inputs):
        """Quantities with γ'' and higher derivatives replaced by those that the inputs cause."""
        levels = [self.acceleration]
        for _ in range(self.depth):
            last = levels[-1]
            moved = sum(ca.jtimes(last, u, du) for u, du in zip(inputs[:-1], inputs[1:], strict=True))
            levels.append(rates_in_time(self.q, last) + ca.jtimes(last, self.state, self.rates) + moved)
        symbols = ca.vertcat(*(s for k in range(2, 3 + self.depth) for s in self.q.gamma(k)))
        return ca.substitute(quantities, symbols, ca.vertcat(*levels))

    def function(self, name, *outputs):
        """A function of (t, x, v), where t are times with the references there."""
        outputs = [ca.densify(ca.cse(o)) for o in outputs]
        return ca.Function(name, [self.instant, self.state, self.v], outputs, {"der_options": {"cse": True}})


@frozen
class Mesh:
    """Intervals and the nodes in them."""

    edges: np.ndarray  # (N + 1,) [s]
    order: int  # of the Radau method with s nodes

    @cached_property
    def c(self):
        """The nodes in an interval of length 1, (s,) array."""
        return radau(self.order)[0]

    @property
    def h(self):
        """Lengths of the intervals, (N,) array."""
        return np.diff(self.edges)

    @property
    def nodes(self):
        """All nodes, (N s,) array [s]."""
        return (self.edges[:-1, None] + self.h[:, None] * self.c).ravel()

    @property
    def weights(self):
        """Weights of the nodes in integrals over time, (N s,) array [s]."""
        return (self.h[:, None] * np.linalg.inv(radau(self.order)[1])[-1]).ravel()

    def place(self, t):
        """The interval of each instant (M,), and its place in it from 0 to 1."""
        k = np.clip(np.searchsorted(self.edges, t, side="right") - 1, 0, len(self.h) - 1)
        return k, (t - self.edges[k]) / self.h[k]

    def of_states(self, t, rate=0):
        """The matrix (1 + N s, M) from states at the start and all nodes to states or rates at instants (M,)."""
        k, theta = self.place(t)
        stages = (basis_rates if rate else basis)(self.c, theta).T
        begin = (rate == 0) - stages.sum(axis=1, keepdims=True)
        return self._of_intervals(k, np.hstack([begin, stages]) / self.h[k, None] ** rate)

    def of_inputs(self, t, rate=0):
        """The matrix (1 + N s, M) from control points to inputs at instants (M,), or to their derivatives."""
        k, theta = self.place(t)
        return self._of_intervals(k, bernstein(len(self.c), theta, rate) / self.h[k, None] ** rate)

    def _of_intervals(self, k, values):
        """The sparse matrix of values (M, s + 1) at the begin and the nodes of intervals (M,)."""
        from scipy.sparse import csc_matrix

        s = len(self.c)
        rows, columns = k[:, None] * s + np.arange(s + 1), np.repeat(np.arange(len(k)), s + 1)
        return csc_matrix((values.ravel(), (rows.ravel(), columns)), shape=(1 + len(self.nodes), len(k)))

    @property
    def places_of_points(self):
        """Instants [s] at which control points are nearly values, (1 + N s,) array."""
        s = len(self.c)
        return np.append((self.edges[:-1, None] + self.h[:, None] * np.arange(s) / s).ravel(), self.edges[-1])

    def power_coefficients(self, points):
        """Coefficients (s + 1, N, m) of the inputs' polynomials in a place from -1 to 1 on each interval."""
        s = len(self.c)
        places = -np.cos(np.linspace(0.0, np.pi, s + 1))
        to_powers = np.linalg.solve(np.vander(places, increasing=True), bernstein(s, (1.0 + places) / 2.0))
        values = points[:, np.arange(len(self.h))[:, None] * s + np.arange(s + 1)]
        return np.einsum("ps,uns->pnu", to_powers, values)


def bernstein(s, theta, rate=0):
    """Bernstein's polynomials of degree s, or their derivatives, at places theta (N,): an (N, s + 1) array."""
    theta = np.asarray(theta, dtype=float)[:, None]
    if rate == 0:
        return np.hstack([comb(s, j) * theta**j * (1.0 - theta) ** (s - j) for j in range(s + 1)])
    lower = bernstein(s - 1, theta[:, 0], rate - 1) if s else np.zeros((len(theta), 0))
    return s * (np.pad(lower, ((0, 0), (1, 0))) - np.pad(lower, ((0, 0), (0, 1))))


class Transcription:
    """The nonlinear program of one mesh; weights, bounds and the ends are data of each solution.

    Unknowns are states at the start and all nodes (n_x, 1 + N s) of `mesh`, and control points of the inputs
    (m, 1 + P s) on `pieces`, each of one or several intervals of the former; N and P are the numbers of intervals.
    `sizes` are the units of the states (n_x,), inputs (m,), bounded quantities (b,) and effort. Constraints by kind:
    "motion" (n_x, N s), collocation; "begin" (m, 1), the highest coefficient of the inputs on the first interval, whose
    begin is no node; "slope" (m, P s), control points of u'; "bound" (b, P w); "start" and "rest" (r, 1), functions
    that vanish at the start, of (t, x), and at the end, of (t, x, v).
    """

    def __init__(self, node, mesh, pieces, sizes, start=None, rest=None):
        self.node, self.mesh, self.pieces, self.sizes, self.start, self.rest = node, mesh, pieces, sizes, start, rest
        w, beta, objective, self._constraints = self._problem()
        g = ca.vertcat(*(ca.vec(value) for value in self._constraints.values()))
        self._solver = solver({"x": w, "p": beta, "f": objective, "g": g})

    @cached_property
    def watched(self):
        """Instants of the bounds, (P w,) array [s]: more than an interval of the inputs has control points."""
        inside = np.arange(1, WATCHED + 1) / WATCHED
        return (self.pieces.edges[:-1, None] + self.pieces.h[:, None] * inside).ravel()

    def _problem(self):
        """Variables, weights, the objective, and the constraints by kind."""
        node, mesh, pieces, K, s = self.node, self.mesh, self.pieces, len(self.mesh.nodes), len(self.mesh.c)
        x, points = ca.MX.sym("x", len(self.sizes[0]), 1 + K), ca.MX.sym("u", len(self.sizes[1]), 1 + len(pieces.nodes))
        w, beta = ca.veccat(x, points), ca.MX.sym("beta", node.residuals.numel())
        x, points = ca.diag(ca.DM(self.sizes[0])) @ x, ca.diag(ca.DM(self.sizes[1])) @ points
        f = node.function("node", node.rates, node.residuals, node.effort).map(K)
        v = ca.vertcat(*(points @ ca.DM(pieces.of_inputs(mesh.nodes, k)) for k in range(node.depth + 1)))
        rates, residuals, effort = f(ca.DM(node.at(mesh.nodes)), x[:, 1:], v)
        begins = np.repeat(np.arange(0, K, s), s).tolist()
        increments = (x[:, 1:] - x[:, begins]) @ ca.diagcat(*[ca.DM(radau(mesh.order)[1].T)] * len(mesh.h))
        cost = ca.sum1(residuals**2 / ca.repmat(beta, 1, K)) + effort
        highest = ca.DM([(-1.0) ** (s - j) * comb(s, j) for j in range(s + 1)])
        slopes = (points[:, 1:] - points[:, :-1]) @ ca.diag(ca.DM(s / np.repeat(pieces.h, s)))
        constraints = {
            "motion": (increments - rates @ ca.diag(ca.DM(np.repeat(mesh.h, s)))) / _each(self.sizes[0], K),
            "begin": points[:, : s + 1] @ highest / ca.DM(self.sizes[1]),
            "slope": slopes / _each(self.sizes[1], len(pieces.nodes)),
            "bound": self._bounded(x, points),
            "start": self.start(mesh.edges[0], x[:, 0]) if self.start else ca.MX(0, 1),
            "rest": self.rest(node.at(mesh.edges[-1:]), x[:, -1], v[:, -1]) if self.rest else ca.MX(0, 1),
        }
        return w, beta, ca.dot(cost, ca.DM(mesh.weights).T) / (self.sizes[3] * np.sum(mesh.h)), constraints

    def _bounded(self, x, points):
        """Bounded quantities (b, P w) at instants that do not change with the mesh of the states."""
        node, t = self.node, self.watched
        if not node.bounds:
            return ca.MX(0, len(t))
        f = node.function("bounded", node.bounded).map(len(t))
        v = ca.vertcat(*(points @ ca.DM(self.pieces.of_inputs(t, k)) for k in range(node.depth + 1)))
        return f(ca.DM(node.at(t)), x @ ca.DM(self.mesh.of_states(t)), v) / _each(self.sizes[2], len(t))

    def joined(self, x, points):
        """The variables (n_w,) of states (n_x, 1 + N s) and control points (m, 1 + P s)."""
        parts = x / self.sizes[0][:, None], points / self.sizes[1][:, None]
        return np.concatenate([part.ravel(order="F") for part in parts])

    def apart(self, w):
        """What `joined` joins."""
        x, points = np.split(w, [len(self.sizes[0]) * (1 + len(self.mesh.nodes))])
        of_states, of_inputs = (size[:, None] for size in self.sizes[:2])
        x, points = x.reshape(len(of_states), -1, order="F"), points.reshape(len(of_inputs), -1, order="F")
        return x * of_states, points * of_inputs

    def solve(self, w, beta, sides):
        """Variables w (n_w,) of the solution that is found from an approximation w, and IPOPT's statistics.

        `beta` (k,) divides the squares of the residuals. `sides` are lower and upper ones (2, rows, instants) of the
        states "x", of the control points "u", and of constraints by kind; others vanish.
        """
        lower, upper = (self.joined(sides["x"][i], sides["u"][i]) for i in (0, 1))
        kinds = [sides.get(kind, np.zeros((2, *value.shape))) for kind, value in self._constraints.items()]
        lower_g, upper_g = (np.concatenate([side[i].ravel(order="F") for side in kinds]) for i in (0, 1))
        found = self._solver(x0=w, p=beta, lbx=lower, ubx=upper, lbg=lower_g, ubg=upper_g)
        return np.array(found["x"]).ravel(), self._solver.stats()


def _each(sizes, count):
    return ca.repmat(ca.DM(sizes), 1, count)
