"""CVODES and IDAS of SUNDIALS, through CasADi: independent integrators for comparison.

CVODES integrates the ODE, IDAS the equations before elimination.
"""

import contextlib
import io
import signal
import threading

import casadi as ca
import numpy as np

from servoctl.methods.bulk import BulkSteps
from servoctl.methods.choice import Poles
from servoctl.methods.motion import Cubics
from servoctl.values import frozen

WATCHED = 1000  # intervals of a span at whose ends pivots are inspected, beside the samples
SLACK = 0.25  # times the change of the rates over an interval, by which its cubic may miss them
MOST_STEPS = 20_000  # between two instants of the grid
SOLVERS = {"CVODES": "cvodes", "IDAS": "idas"}
COUNTS = {"steps": "nsteps", "nfev": "nfevals", "nlu": "nlinsetups"}


def rows_unsolved(equations, poles=False):
    """The rows that determine γ^(s̄), L γ^(s̄) + rest = 0, in the form in which they were differentiated.

    Returns
    -------
    z : casadi.SX
        γ^(s̄).
    residual : casadi.SX
    """
    e, residual = equations, []
    for a, level in enumerate(e.levels):
        row = level[-1]
        if poles:
            row += sum(c * lower for c, lower in zip(e.coefficients[a], level[:-1], strict=True))
        residual.append(row)
    return ca.vertcat(*e.q.gamma(e.top)), ca.vertcat(*residual)


@contextlib.contextmanager
def _interrupts():
    """A list that is not empty after Ctrl-C, which CasADi turns into a failure of the integrator."""
    pressed, before = [], signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield pressed
        return

    def note(number, frame):
        pressed.append(number)
        raise KeyboardInterrupt

    signal.signal(signal.SIGINT, note)
    try:
        yield pressed
    finally:
        signal.signal(signal.SIGINT, before)


class Sundials:
    """A motion at the instants of a grid.

    Parameters
    ----------
    equations : Equations
    solver : {"CVODES", "IDAS"}
        CVODES integrates X' = f(t, X); IDAS integrates X' = (V γ' + h, γ'', ..., γ^(s̄)) together with
        L γ^(s̄) + rest = 0, before elimination.
    poles : bool
        Whether rows carry error dynamics.
    """

    def __init__(self, equations, solver, poles=False):
        self.solver = SOLVERS[solver]
        e = equations
        f = e.ode(poles)
        self.n_x, t = f.numel_in(1), ca.SX.sym("t")
        # SUNDIALS integrates forward: time is way[0] + way[1] t with way[1] = -1 for motions that run backwards
        p, way = ca.SX.sym("p", f.numel_in(2)), ca.SX.sym("way", 2)
        parts = {"t": t, "x": e.state, "p": ca.vertcat(p, way)}
        if solver == "IDAS":
            z, residual = rows_unsolved(e, poles)
            extra = [c for row in e.coefficients for c in row] if poles else []
            form = ca.Function("form", [e.q.t, e.state, z, ca.vertcat(e.parameters, *extra)], [e.rates(z), residual])
            rates, rows = form(way[0] + way[1] * t, e.state, z, p)
            self.parts = parts | {"z": z, "ode": way[1] * rates, "alg": rows}
            self.rates = ca.Function("rates", [e.state, z, parts["p"]], [ca.substitute(way[1] * rates, t, 0.0)])
        else:
            self.parts = parts | {"ode": way[1] * f(way[0] + way[1] * t, e.state, p)[: self.n_x]}

    def run(self, t, x0, top, p, rtol, atol):
        """States at the instants of a grid, up to where the integrator fails.

        Parameters
        ----------
        t : (N,) array
            Increasing or decreasing instants [s]; x0 holds at t[0].
        x0 : (n_x,) array
        top : (n,) array
            γ^(s̄) there, from which IDAS starts.
        p : (n_p,) array
        rtol, atol : float

        Returns
        -------
        x : (n_x, M) array
            States at the first M instants; all N unless the integrator failed.
        counts : dict of str to int
            Steps, evaluations of f or of the residual, decompositions, as the solver reports them.
        """
        forward = np.sign(t[-1] - t[0])
        grid, p = forward * (t - t[0]), np.concatenate([p, [t[0], forward]])
        options = {"reltol": rtol, "abstol": atol, "max_num_steps": MOST_STEPS, "disable_internal_warnings": True}
        inputs = {"x0": x0, "p": p}
        if self.solver == "idas":  # γ^(s̄) starts without a rate, so that no first step would pass a test of its error
            inputs["z0"], options["suppress_algebraic"] = top, True
            options |= {"calc_ic": False, "init_xdot": self.rates(x0, top, p).full().ravel().tolist()}
        low, high, states, counts = 0, len(t), None, {}
        count = high  # the integrator returns nothing if it fails: bisection finds the last end that it reaches
        while low + 1 < high or states is None:
            x, work = self._to(grid[:count], inputs, options) if count > 1 else (np.array(x0)[:, None], counts)
            if x is None:
                high = count
            else:
                low, states, counts = count, x, work
                if count == len(t):
                    break
            count = (low + high) // 2
        return states, counts

    def _to(self, grid, inputs, options):
        """States at the instants of a grid, None where the integrator fails; and counts."""
        pressed = []
        try:
            integrator = ca.integrator("motion", self.solver, self.parts, 0.0, grid[1:], options)
            with _interrupts() as pressed, contextlib.redirect_stderr(io.StringIO()):  # its complaints, raised below
                states = np.array(integrator(**inputs)["xf"])
        except RuntimeError as error:
            if pressed:
                raise KeyboardInterrupt from error
            return None, {}
        stats = integrator.stats()
        counts = {name: int(stats[key]) for name, key in COUNTS.items() if key in stats}
        return (np.column_stack([inputs["x0"], states]) if np.isfinite(states).all() else None), counts


def sundials_solver(model, solver, poles=False):
    """The integrator of a model by "CVODES" or "IDAS", with error dynamics if `poles`."""
    key = f"{solver} with poles" if poles else solver
    return model.once(key, lambda: Sundials(model.equations, solver, poles))


@frozen
class Grid(Cubics):
    """A motion on a grid; `failed` after its end."""

    failed: bool


class SundialsSteps(BulkSteps):
    """One integration by CVODES, or by IDAS on the rows before elimination.

    Parameters
    ----------
    model : Model
    method : {"CVODES", "IDAS"}
    drift : None or Poles
    rtol, atol : float
    span : float
        Length of the integration [s].
    progress : callable
    """

    parts = 1
    rank_lost = "the integrator finds no further step"
    failure = f"no step succeeds, or {MOST_STEPS:,} reach no further sample"
    advice = "Use a larger rtol, more t_eval or 'RadauIIA', or check whether the motion escapes."

    def __init__(self, model, method, drift, rtol, atol, span, progress):
        self.resolution = abs(span) / WATCHED
        self.tolerances = rtol, atol
        super().__init__(model, method, drift, progress)

    def _use(self, model):
        super()._use(model)
        self.solver = sundials_solver(model, self.method, isinstance(self.drift, Poles))

    def _begin(self, a, x, b):
        """Nothing to prepare."""

    def _state_within(self, stretch):
        """X from (k, t), integrated from the start of an interval: the cubics between instants are less accurate."""

        def state(k, t):
            x = stretch.x[:, k]
            return self.solver.run(np.array([stretch.t[k], t]), x, self._top(t, x), self.p, *self.tolerances)[0][:, -1]

        return state

    def _steps(self, t, x, b):
        direction = np.sign(b - t)
        marks = np.linspace(t, b, 2 + int(abs(b - t) / self.resolution))
        grid = np.unique(direction * np.concatenate([marks, self.pending]))
        grid = direction * grid[(grid >= direction * t) & (grid <= direction * b)]
        states, counts = self.solver.run(grid, x, self._top(t, x), self.p, *self.tolerances)
        self.motion.count(**counts)
        t, failed = grid[: states.shape[1]], states.shape[1] < len(grid)
        self.grid = Grid(t, states, self.f.grid(t, states, self.p)[: self.n_x], failed)
        return self.grid

    def _slack(self, k, h):
        return SLACK * np.abs(np.diff(self.grid.rates)[:, k] * h[k])
