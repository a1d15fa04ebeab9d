"""Flat programs: a Newton solve at each instant, no integration."""

import numpy as np

from servoctl.methods.monitor import Fine, Stretch
from servoctl.methods.motion import Stepping, interruptible


def algebraic(model, t0, x0, times, progress):
    """Solve a flat program for q, γ' and γ'' at each time.

    Parameters
    ----------
    model : Model
        With Σ o_a = 0.
    t0 : float
        [s]
    x0 : (n_x,) array
        Consistent state at t0.
    times : (N,) array
        In the order of the motion [s].
    progress : callable

    Returns
    -------
    Motion
    """
    return _Algebraic(model, "algebraic", None, progress).run(t0, np.asarray(x0), np.asarray(times, dtype=float))


class _Algebraic(Stepping):
    rank_lost = "Newton's method finds no solution beyond"
    advice = "Check whether the path leaves the reach of the mechanism."
    most = 4000  # instants per call of the loop: 0.2 ms compiled, 0.2 s where CasADi evaluates

    def _function(self, model, poles):
        return model.function("path")

    def _outputs(self, t, x):
        return self.f(t, x[: self.model.nq], self.p)

    def _pivots(self, t, x):
        return _split(self.model, x[: self.model.nq], self._outputs(t, x))[2]

    def _top(self, t, x):
        return _split(self.model, x[: self.model.nq], self._outputs(t, x))[1]

    def run(self, t0, x0, times):
        """Solve at each of the times (N,) [s], from the solution x0 at t0."""
        with interruptible(self.motion):
            self._start(t0, x0, t0)
            done, x, t = 0, x0, None  # t of the last instant solved: between t0 and the first nothing is inspected
            while done < len(times) and self.motion.stop is None:
                block = times[done : done + self.most]
                q, y, iterations = self.f.newton(block, x[: self.model.nq], self.p)
                self.motion.count(iterations=iterations)
                state, top, pivots = _split(self.model, q, y)
                ends = block[: q.shape[1]]
                if t is not None:
                    outcome = self._inspect(np.append(t, ends), np.column_stack([x, state]), pivots)
                    solved = outcome.steps
                elif len(ends):
                    self.monitor.begin(pivots[:, 0])
                    outcome = self._inspect(ends, state, pivots[:, 1:])
                    solved = 1 + outcome.steps
                else:
                    outcome, solved = Fine(0), 0
                self.motion.add(self.model, ends[:solved], state[:, :solved], top[:, :solved])
                done += solved
                if solved:
                    t, x = ends[solved - 1], state[:, solved - 1]
                    self.progress(t)
                if not isinstance(outcome, Fine):
                    self._follow(outcome)
                elif len(ends) < len(block):
                    why = "Newton's method finds no solution of the program beyond"
                    self._fail(block[0] if t is None else t, x, why)
        return self.motion

    def _inspect(self, t, state, pivots):
        """The monitor's outcome; an instant solved beyond a pivot's zero is as accurate as any other."""
        return self.monitor.inspect(Stretch(t, state, pivots[:, :, None], self._top, crosses=True))


def _split(model, q, y):
    """State (q, γ'), γ'' and pivots from the outputs (δq, q', γ', γ'', pivots)."""
    nq, n = model.nq, model.n
    return np.concatenate([q, y[2 * nq : 2 * nq + n]]), y[2 * nq + n : 2 * nq + 2 * n], y[2 * nq + 2 * n :]
