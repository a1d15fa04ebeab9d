"""Radau IIA steps with exact Jacobians: the whole loop in compiled C, or the same algorithm in Python."""

import ctypes

import numpy as np

from servoctl.codegen.function import compiled
from servoctl.codegen.interpreted import Interpreter
from servoctl.codegen.loops import ROUNDING
from servoctl.codegen.native import pointer
from servoctl.methods.radau_tableau import basis, radau

TOLERANCE = 1e-2  # of the Newton iteration, relative to the tolerance of a step
TIGHT, PATIENT = 1e-4, 3  # the same where steps are fixed, and how many times more iterations they may take
ITERATIONS = {5: 7, 9: 12, 13: 17}  # at most, by order (Hairer and Wanner 1999)


def radau_steps(model, poles=False):
    """The Radau IIA steps of a model.

    Parameters
    ----------
    model : Model
    poles : bool
        Whether rows carry error dynamics.

    Returns
    -------
    Implicit
    """
    name = "RadauIIA_poles" if poles else "RadauIIA"

    def build():
        e = model.equations
        return Implicit(e.ode(poles), e.ode_jacobian(poles), e.project(), name)

    return model.once("RadauIIA with poles" if poles else "RadauIIA", build)


class Implicit:
    """Right-hand side X' with its Jacobian and the loop over Radau IIA steps.

    Parameters
    ----------
    f, jacobian, project : casadi.Function
        SX functions of (t, x, p): X' and guards, ∂X'/∂X column by column, the change of X that restores invariants.
    name : str
        A C identifier.

    Attributes
    ----------
    f : Compiled
        X' and guards; its library holds the loop.
    """

    def __init__(self, f, jacobian, project, name):
        self.f = compiled(f, name, ("radau",), project, {"jacobian": jacobian})
        self._functions = (f, jacobian, project)

    @property
    def operations(self):
        """Number of arithmetic operations of one evaluation of X'."""
        return self.f.operations

    def steps(self, t0, x0, t1, p, order, h, rtol, atol, max_steps, fixed=False, project_every=0):
        """Radau IIA steps towards t1.

        Parameters
        ----------
        t0, t1 : float
            Start and end [s].
        x0 : (n_x,) array
            State at t0, SI.
        p : (n_p,) array
            Parameters, SI.
        order : {5, 9, 13}
        h : float
            Length of the first step [s], positive.
        rtol, atol : float
            Tolerance of each entry of the state, relative and absolute, of the embedded method of order s.
        max_steps : int
            Number of steps at most.
        fixed : bool
            Whether all steps have the length h.
        project_every : int
            Steps between projections; 0 for none.

        Returns
        -------
        t : (S + 1,) array
            Starts of the steps, and where the last one ended [s]; short of t1 where steps vanish.
        x : (n_x, S + 1) array
            States there, SI.
        y : (n_y, S) array
            X' and guards at the starts.
        z : (S, s, n_x) array
            Increments of the stages.
        h : float
            Length that the next step should have [s].
        counts : (4,) array
            Rejected steps, evaluations of X', of the Jacobian, decompositions.
        """
        parts, n = radau(order), len(x0)
        s = len(parts[0])
        t, counts = np.empty(max_steps + 1), np.zeros(4, dtype=np.int64)
        x, y = np.empty((max_steps + 1, n)), np.empty((max_steps, self.f.n_y))
        z, step = np.empty((max_steps, s, n)), np.array([float(h)])
        limit, tol = ITERATIONS[order] * (PATIENT if fixed else 1), TIGHT if fixed else TOLERANCE
        settings = (limit, max(tol, 10 * ROUNDING / rtol), fixed, rtol, atol)
        logs = (t, x, y, z, counts)
        run = self.f.native("radau")
        if run is None:
            loop = _Loop(self._functions, p, parts, settings)
            k = loop.run(float(t0), np.array(x0, dtype=float), float(t1), project_every, max_steps, step, *logs)
        else:
            k = _native(run, float(t0), x0, float(t1), p, parts, settings, project_every, max_steps, step, logs)
        return t[: k + 1], x[: k + 1].T, y[:k].T, z[:k], float(step[0]), counts

    def settle(self, t, x, p):
        """States x (n_x, N) at times t (N,) moved onto the invariants."""
        rows, t = np.array(x.T, dtype=float, order="C"), np.ascontiguousarray(t, dtype=float)
        run = self.f.native("settle")
        if run is not None:
            p = np.ascontiguousarray(p, dtype=float)
            run.restype = None
            run(ctypes.c_int64(len(t)), *map(pointer, (t, rows, p)))
        else:
            f, _, project = self._functions
            evaluator = Interpreter(f, project)
            rows = np.array([evaluator._restore(s, row, p) for s, row in zip(t, rows, strict=True)])
        return rows.T


def inside(order, theta, z):
    """Increments at fractions theta (N,) of steps from their stages z (..., s, n_x): (..., N, n_x)."""
    return np.einsum("jm,...jl->...ml", basis(radau(order)[0], np.asarray(theta)), z)


def first_step(f, t, x, p, order, span, rtol, atol):
    """Length of a first step (Hairer, Nørsett and Wanner 1993, II.4); f is a Compiled with the outputs X', guards."""
    n, power = len(x), 1.0 / (radau(order)[0].size + 1)
    scale = atol + rtol * np.abs(x)
    slope = f(t, x, p)[:n]
    d0, d1 = _size(x / scale), _size(slope / scale)
    h = min(abs(span), 1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1)
    signed = np.copysign(h, span)
    d2 = _size((f(t + signed, x + signed * slope, p)[:n] - slope) / scale) / h
    longer = max(1e-6, h * 1e-3) if max(d1, d2) <= 1e-15 else (0.01 / max(d1, d2)) ** power
    h = min(100 * h, longer, abs(span))
    return h if np.isfinite(h) and h > 0 else 1e-6 * abs(span)


def _native(run, t0, x0, t1, p, parts, settings, project_every, max_steps, step, logs):
    limit, tol, fixed, rtol, atol = settings
    s, n = len(parts[0]), len(x0)
    table = np.concatenate([np.ravel(part) for part in parts])
    x0, p = np.ascontiguousarray(x0, dtype=float), np.ascontiguousarray(p, dtype=float)
    work, pivots = np.empty(n * n * (s + 2) + n * (2 * s + 2)), np.empty((s + 1) // 2 * n, dtype=np.int64)
    run.restype = ctypes.c_int64
    return run(
        ctypes.c_double(t0),
        pointer(x0),
        ctypes.c_double(t1),
        pointer(p),
        ctypes.c_int64(s),
        pointer(table),
        ctypes.c_int64(limit),
        ctypes.c_double(tol),
        ctypes.c_int64(fixed),
        ctypes.c_double(rtol),
        ctypes.c_double(atol),
        ctypes.c_int64(project_every),
        ctypes.c_int64(max_steps),
        *map(pointer, (step, work, pivots, *logs)),
    )


def _size(v):
    return float(np.sqrt(np.mean(np.square(v)))) if v.size else 0.0


def _rounded(h):
    part, exponent = np.frexp(h)
    return float(np.ldexp(np.rint(part * 1024) / 1024, exponent))


class _Loop:
    """The loop of radau.c in Python over CasADi's evaluation."""

    def __init__(self, functions, p, parts, settings):
        f, jacobian, project = functions
        self.f, self.slopes = Interpreter(f, project), Interpreter(jacobian)
        self.c, self.rate, self.from_pairs, self.to_pairs, mu, self.e = parts
        self.mu = mu @ [1.0, 1.0j]
        self.p, self.n, self.s = p, f.numel_in(1), len(self.c)
        self.limit, self.tol, self.fixed, self.rtol, self.atol = settings
        self.nfev = self.njev = self.nlu = self.rejected = 0

    def _jacobian(self, t, x):
        self.njev += 1
        return self.slopes._value(t, x, self.p).reshape(self.n, self.n).T

    def _prepare(self, h):
        """Decompositions of mu/h - J, None where one is singular."""
        from scipy.linalg.lapack import zgetrf

        self.nlu += 1
        found = [zgetrf(mu / h * np.eye(self.n) - self.jacobian) for mu in self.mu]
        return None if any(info or not np.isfinite(lu).all() for lu, _, info in found) else found

    def _iterate(self, t, x, h, z):
        """Increments of the stages, the number of iterations (0 where they fail) and their rate."""
        from scipy.linalg.lapack import zgetrs

        last = rate = 0.0
        for k in range(self.limit):
            values = [self.f._value(t + c * h, x + row, self.p)[: self.n] for c, row in zip(self.c, z, strict=True)]
            right = np.array(values) - self.rate @ z / h
            if not np.isfinite(right).all():
                return z, 0, rate
            self.nfev += self.s
            w = self.to_pairs @ right
            parts = [w[0] + 0j, *(w[2 * q - 1] + 1j * w[2 * q] for q in range(1, len(self.mu)))]
            solved = [zgetrs(lu, pivots, b)[0] for (lu, pivots, _), b in zip(self.lu, parts, strict=True)]
            rows = [solved[0].real, *(half for b in solved[1:] for half in (b.real, b.imag))]
            dz = self.from_pairs @ np.array(rows)
            z, norm = z + dz, _size(dz / self.scale)
            if not np.isfinite(norm):
                return z, 0, rate
            rate = norm / last if k else 0.0
            if norm <= 10 * ROUNDING / self.rtol or (k and rate < 1 and rate / (1 - rate) * norm < self.tol):
                return z, k + 1, rate
            if k and (rate >= 1 or rate ** (self.limit - 1 - k) / (1 - rate) * norm > self.tol):
                return z, 0, rate
            last = norm
        return z, 0, rate

    def _error(self, t, x, slope, z, h, again):
        from scipy.linalg.lapack import zgetrs

        lu, pivots, _ = self.lu[0]
        scale = self.atol + self.rtol * np.maximum(np.abs(x), np.abs(x + z[-1]))
        error = zgetrs(lu, pivots, slope + self.e @ z / h + 0j)[0].real
        if again and _size(error / scale) > 1:
            self.nfev += 1
            slope = self.f._value(t, x + error, self.p)[: self.n]
            error = zgetrs(lu, pivots, slope + self.e @ z / h + 0j)[0].real
        return _size(error / scale)

    @np.errstate(all="ignore")
    def run(self, t, x, t1, project_every, max_steps, step, t_log, x_log, y_log, z_log, counts):
        """Fill the logs as `Implicit.steps` says; return the number of steps."""
        h, self.before, self.prepared, self.current, useful = float(step[0]), None, 0.0, False, False
        k = 0
        while True:
            t_log[k], x_log[k] = t, x
            if k == max_steps or t == t1:
                break
            y_log[k] = self.f._value(t, x, self.p)
            self.nfev += 1
            if not useful:
                self.jacobian, self.current, self.prepared = self._jacobian(t, x), True, 0.0
            past = (z_log[k - 1], t - t_log[k - 1]) if k else None
            taken = self._step(t, x, t1, y_log[k, : self.n], h, past)
            if taken is None:
                break
            z_log[k], x = taken[0], x + taken[0][-1]
            t, h, useful = taken[1:]
            if project_every and (k + 1) % project_every == 0:
                x = self.f._restore(t, x, self.p)
            k += 1
        step[0], counts[:] = h, (self.rejected, self.nfev, self.njev, self.nlu)
        return k

    def _step(self, t, x, t1, slope, h, past):
        """Increments of an accepted step, its end, the next length, whether the Jacobian serves on; None if stuck."""
        self.scale = self.atol + self.rtol * np.abs(x)
        refused, error, factor, power = 0, 0.0, 1.0, -1.0 / (self.s + 1)
        while True:
            if not h > 1e-14 * (1e-3 + abs(t)) or (self.fixed and refused):
                self.rejected += refused
                return None
            ends = h >= abs(t1 - t) * (1 - 1e-12)
            signed = t1 - t if ends else np.copysign(h, t1 - t)
            z, iterations, rate = self._guess(signed, past), 0, 0.0
            if self.prepared != signed:
                self.lu = self._prepare(signed)
            if self.lu is not None:
                self.prepared = signed
                z, iterations, rate = self._iterate(t, x, signed, z)
            if not iterations:
                self.prepared = 0.0
                if self.current:
                    h, refused = 0.5 * abs(signed), refused + 1
                else:
                    self.jacobian, self.current = self._jacobian(t, x), True
                continue
            if self.fixed:
                break
            error = self._error(t, x, slope, z, signed, refused > 0 or past is None)
            factor = max(error, 1e-10) ** power
            if self.before is not None and error > 0:
                length, size = self.before
                factor *= min(1.0, abs(signed) / length * (size / error) ** -power)
            factor *= 0.9 * (2 * self.limit + 1) / (2 * self.limit + iterations)
            if error <= 1:
                break
            h, refused = _rounded(abs(signed) * (max(0.2, factor) if np.isfinite(error) else 0.5)), refused + 1
        self.rejected += refused
        self.before, self.current = (abs(signed), max(error, 1e-4)), False
        useful = iterations <= 2 or rate <= 1e-3
        if not self.fixed and not (useful and 0.9 < factor < 1.2):
            h = _rounded(abs(signed) * min(factor, 1.0 if refused else 5.0))
        return z, t1 if ends else t + signed, h, useful

    def _guess(self, h, past):
        """Increments that continue the collocation polynomial of the last step."""
        if past is None:
            return np.zeros((self.s, self.n))
        z, length = past
        return basis(self.c, 1 + self.c * (h / length)).T @ z - z[-1]
