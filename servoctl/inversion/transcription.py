"""The relaxed inverse as a nonlinear program: collocation at Radau nodes.

On each interval of a mesh the states are polynomials of degree s through its begin and s Radau nodes, where they
satisfy x' = f(t, x, u). Inputs are continuous; on an interval they are polynomials of the same degree in Bernstein's
form: they stay within the hull of their control points, so that limits of these points hold at all instants.
"""

from functools import cached_property
from math import comb

import casadi as ca
import numpy as np

from servoctl.methods.bounded import basis_rates
from servoctl.methods.radau import basis, radau
from servoctl.values import frozen

WATCHED = 12  # instants of bounds in an interval of the inputs
PIVOTS = 0.1  # threshold of MUMPS: with smaller ones rounding hides the inertia of stiff machines
LONGEST = 120.0  # of a solution [s]
IPOPT = {
    "print_level": 0,
    "sb": "yes",
    "tol": 1e-8,
    "acceptable_tol": 1e-6,  # rounding of φ²/β for small β
    "acceptable_iter": 2,
    "acceptable_constr_viol_tol": 1e-9,
    "max_iter": 200,
    "bound_relax_factor": 0.0,
    "nlp_scaling_method": "none",
    "mu_strategy": "adaptive",
    "mumps_pivtol": PIVOTS,
    "max_wall_time": LONGEST,
}
WARM = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": 1e-9,
    "warm_start_mult_bound_push": 1e-9,
    "warm_start_slack_bound_push": 1e-9,
    "warm_start_bound_frac": 1e-9,
    "warm_start_slack_bound_frac": 1e-9,
    "mu_init": 1e-6,
    "mu_strategy": "monotone",
}


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

    def known(self, expression):
        """An expression of the mechanism with the plant's numbers."""
        return ca.substitute(expression, *self._numbers)

    def _along(self, quantities, inputs):
        """Quantities with γ'' and higher derivatives replaced by those that the inputs cause."""
        levels = [self.acceleration]
        for _ in range(self.depth):
            last = levels[-1]
            moved = sum(ca.jtimes(last, u, du) for u, du in zip(inputs[:-1], inputs[1:], strict=True))
            levels.append(ca.jacobian(last, self.q.t) + ca.jtimes(last, self.state, self.rates) + moved)
        symbols = ca.vertcat(*(s for k in range(2, 3 + self.depth) for s in self.q.gamma(k)))
        return ca.substitute(quantities, symbols, ca.vertcat(*levels))

    def function(self, name, *outputs):
        """A function of (t, x, v)."""
        outputs = [ca.densify(ca.cse(o)) for o in outputs]
        return ca.Function(name, [self.q.t, self.state, self.v], outputs, {"der_options": {"cse": True}})


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
        s = len(self.c)
        at_nodes = np.linalg.solve(np.vander(self.c, s, increasing=True).T, 1.0 / np.arange(1, s + 1))
        return (self.h[:, None] * at_nodes).ravel()

    def place(self, t):
        """The interval of each instant (M,), and its place in it from 0 to 1."""
        k = np.clip(np.searchsorted(self.edges, t, side="right") - 1, 0, len(self.h) - 1)
        return k, (t - self.edges[k]) / self.h[k]

    def states(self, x, t, rate=0):
        """States (n_x, M) at instants from those at the start and the nodes (n_x, 1 + N s), or their rates."""
        k, theta = self.place(t)
        s = len(self.c)
        weights = (basis_rates if rate else basis)(self.c, theta) / self.h[k] ** rate
        begin = x[:, k * s]
        stages = x[:, 1:].reshape(len(x), -1, s)[:, k]
        return begin * (rate == 0) + np.einsum("xns,sn->xn", stages - begin[:, :, None], weights)

    def inputs(self, points, t, rate=0):
        """Inputs (m, M) at instants from their control points (m, 1 + N s), or their derivatives."""
        k, theta = self.place(t)
        s = len(self.c)
        values = points[:, k[:, None] * s + np.arange(s + 1)]
        return np.einsum("uns,ns->un", values, bernstein(s, theta, rate) / self.h[k, None] ** rate)

    def control_points(self, values, begin):
        """Control points (m, 1 + N s) of inputs with these values (m, N s) at the nodes and (m,) at the start."""
        s, matrix = len(self.c), np.linalg.inv(bernstein(len(self.c), np.append(0.0, self.c)))
        points = [np.asarray(begin, dtype=float)[:, None]]
        for i in range(len(self.h)):
            known = np.hstack([points[-1][:, -1:], values[:, i * s : (i + 1) * s]])
            points.append((known @ matrix.T)[:, 1:])
        return np.hstack(points)

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
        self.n, self.m, self.count = len(sizes[0]), len(sizes[1]), len(mesh.nodes)

    @cached_property
    def watched(self):
        """Instants of the bounds, (P w,) array [s]: more than an interval of the inputs has control points."""
        inside = np.arange(1, WATCHED + 1) / WATCHED
        return (self.pieces.edges[:-1, None] + self.pieces.h[:, None] * inside).ravel()

    @cached_property
    def _problem(self):
        """Variables, weights, the objective, and the constraints by kind."""
        from scipy.sparse import block_diag, coo_matrix

        node, mesh, K, s = self.node, self.mesh, self.count, len(self.mesh.c)
        count = self.n * (1 + K) + self.m * (1 + len(self.pieces.nodes))
        w, beta = ca.MX.sym("w", count), ca.MX.sym("beta", node.residuals.numel())
        x, points = self._split(w)
        f = node.function("node", node.rates, node.residuals, node.effort).map(K)
        v = ca.vertcat(*(points @ _matrix(_at(self.pieces, mesh.nodes, k)) for k in range(node.depth + 1)))
        rates, residuals, effort = f(ca.DM(mesh.nodes).T, x[:, 1:], v)
        begins = np.repeat(np.arange(0, K, s), s).tolist()
        increments = (x[:, 1:] - x[:, begins]) @ _matrix(block_diag([coo_matrix(radau(mesh.order)[1].T)] * len(mesh.h)))
        h = ca.repmat(ca.DM(np.repeat(mesh.h, s)).T, self.n, 1)
        cost = ca.sum1(residuals**2 / ca.repmat(beta, 1, K)) + effort
        scale = self.sizes[3] * np.sum(mesh.h)
        highest = ca.DM([(-1.0) ** (s - j) * comb(s, j) for j in range(s + 1)])
        constraints = {
            "motion": (increments - h * rates) / ca.repmat(ca.DM(self.sizes[0]), 1, K),
            "begin": points[:, : s + 1] @ highest / ca.DM(self.sizes[1]),
            "slope": points @ _matrix(_slopes(self.pieces)) / ca.DM(self.sizes[1]),
            "bound": self._bounded(x, points),
            "start": self.start(mesh.edges[0], x[:, 0]) if self.start else ca.MX(0, 1),
            "rest": self.rest(mesh.edges[-1], x[:, -1], v[:, -1]) if self.rest else ca.MX(0, 1),
        }
        return w, beta, ca.dot(cost, ca.DM(mesh.weights).T) / scale, constraints

    def _bounded(self, x, points):
        """Bounded quantities (b, P w) at instants that do not change with the mesh of the states."""
        node, t = self.node, self.watched
        if not node.bounds:
            return ca.MX(0, len(t))
        f = node.function("bounded", node.bounded).map(len(t))
        v = ca.vertcat(*(points @ _matrix(_at(self.pieces, t, k)) for k in range(node.depth + 1)))
        return f(ca.DM(t).T, x @ _matrix(_states_at(self.mesh, t)), v) / ca.repmat(ca.DM(self.sizes[2]), 1, len(t))

    def _split(self, w):
        """States and control points, in SI, of the variables."""
        x, points = ca.vertsplit(w, [0, self.n * (1 + self.count), w.numel()])
        x, points = ca.reshape(x, self.n, -1), ca.reshape(points, self.m, -1)
        return ca.diag(ca.DM(self.sizes[0])) @ x, ca.diag(ca.DM(self.sizes[1])) @ points

    def joined(self, x, points):
        """The variables (n_w,) of states (n_x, 1 + N s) and control points (m, 1 + P s)."""
        parts = x / self.sizes[0][:, None], points / self.sizes[1][:, None]
        return np.concatenate([part.ravel(order="F") for part in parts])

    def apart(self, w):
        """What `joined` joins."""
        x, points = np.split(w, [self.n * (1 + self.count)])
        x, points = x.reshape(self.n, -1, order="F"), points.reshape(self.m, -1, order="F")
        return x * self.sizes[0][:, None], points * self.sizes[1][:, None]

    def constraints(self, w):
        """Values of the constraints by kind, as arrays (rows, instants)."""
        w_, _, _, constraints = self._problem
        values = ca.Function("constraints", [w_], list(constraints.values()))(w)
        return {kind: np.array(value) for kind, value in zip(constraints, values, strict=True)}

    @cached_property
    def _solvers(self):
        return {}

    def solve(self, w, beta, bounds, multipliers=None):
        """Variables w (n_w,), multipliers and statistics of the solution that is found from an approximation w.

        `beta` (k,) divides the squares of the residuals. `bounds` is (lower, upper, {kind: (lower, upper)}) of the
        variables (n_w,) and of the constraints, as arrays (rows, instants). Multipliers are pairs, of bounds and of
        constraints; those passed are of a nearby solution, where this one begins.
        """
        warm = multipliers is not None
        lower, upper, limits = bounds
        solver = self._solver(warm)
        sides = [np.concatenate([limits[kind][i].ravel(order="F") for kind in limits]) for i in (0, 1)]
        start = {"lam_x0": multipliers[0], "lam_g0": multipliers[1]} if warm else {}
        result = solver(x0=w, p=beta, lbx=lower, ubx=upper, lbg=sides[0], ubg=sides[1], **start)
        found = {name: np.array(value).ravel() for name, value in result.items()}
        return found["x"], (found["lam_x"], found["lam_g"]), solver.stats()

    def _solver(self, warm):
        if warm not in self._solvers:
            w, beta, objective, constraints = self._problem
            g = ca.vertcat(*(ca.vec(value) for value in constraints.values()))
            quiet = {"print_time": False, "show_eval_warnings": False, "calc_lam_p": False}
            options = quiet | {"ipopt": IPOPT | (WARM if warm else {})}
            self._solvers[warm] = ca.nlpsol("relaxed", "ipopt", {"x": w, "p": beta, "f": objective, "g": g}, options)
        return self._solvers[warm]


def _at(pieces, t, rate):
    """The matrix (1 + P s, M) from control points to derivatives of the inputs at instants (M,)."""
    from scipy.sparse import csc_matrix

    k, theta = pieces.place(t)
    s = len(pieces.c)
    values = bernstein(s, theta, rate) / pieces.h[k, None] ** rate
    rows, columns = k[:, None] * s + np.arange(s + 1), np.repeat(np.arange(len(t)), s + 1)
    return csc_matrix((values.ravel(), (rows.ravel(), columns)), shape=(1 + len(pieces.nodes), len(t)))


def _states_at(mesh, t):
    """The matrix (1 + N s, M) from states at the start and all nodes to those at instants (M,)."""
    from scipy.sparse import csc_matrix

    k, theta = mesh.place(t)
    s = len(mesh.c)
    of_stages = basis(mesh.c, theta).T
    values = np.hstack([1.0 - of_stages.sum(axis=1, keepdims=True), of_stages])
    rows, columns = k[:, None] * s + np.arange(s + 1), np.repeat(np.arange(len(t)), s + 1)
    return csc_matrix((values.ravel(), (rows.ravel(), columns)), shape=(1 + len(mesh.nodes), len(t)))


def _slopes(pieces):
    """The matrix (1 + P s, P s) from control points to those of the derivative."""
    from scipy.sparse import diags

    s, count = len(pieces.c), len(pieces.nodes)
    slopes = s / np.repeat(pieces.h, s)
    return diags([-slopes, slopes], [0, -1], shape=(1 + count, count))


def _matrix(sparse):
    """A constant sparse matrix of CasADi."""
    return ca.DM(sparse.tocsc())
