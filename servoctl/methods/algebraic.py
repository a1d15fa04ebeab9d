"""Flat programs: the solution at t0, followed by continuation; no integration.

The continuation takes steps of its own, so that samples decide neither the branch of the solution nor where the motion
ends. Samples are solved between the ends of these steps.
"""

import numpy as np

from servoctl.jets.branches import Branches
from servoctl.methods.motion import Stepping, breakpoints, interruptible
from servoctl.methods.pieces import DEFAULT, Tolerance
from servoctl.methods.rank import Fine, Singular, Stretch, Weak, strong
from servoctl.methods.switches import Switches
from servoctl.model.pivots import pivot_sizes
from servoctl.model.switching import switching
from servoctl.values import frozen

STEPS = 50  # at least, in a span: shorter movements between two rests are overlooked where there are no samples
NODES = 1000  # steps per call of the loop: 0.3 ms compiled, 50 ms where CasADi evaluates
BLOCK = 4000  # samples per call of the loop: 0.2 ms compiled, 0.2 s where CasADi evaluates


def algebraic(model, span, x0, times, knots, progress, events=None):
    """Solve a flat program (Σ o_a = 0) for q, γ' and γ'' at each of the times (N,), in the order of the motion [s].

    Newton's method starts from the q of x0, the state at t0; steps end at the knots [s].
    """
    continuation = _Algebraic(model, "algebraic", None, progress)
    continuation.events = events
    return continuation.run(span[0], x0, span[1], times, knots)


class _Algebraic(Stepping):
    rank_lost = "Newton's method finds no solution beyond"
    advice = "Check whether the path leaves the reach of the mechanism."

    def _function(self, model, poles):
        return model.function("path")

    def _outputs(self, t, x):
        return self.f(t, x[: self.model.nq], self.p)

    def _use(self, model):
        super()._use(model)
        first = model.nq if model.reduction.mechanism.q.plain else 3 * model.nq
        self.ends = first, first + model.n, first + 2 * model.n

    def _levels(self, y):
        """γ', γ'' and pivots from the outputs of `Equations.path`, or from these with q in place of the Newton step."""
        first, second, end = self.ends
        return y[first:second], y[second:end], y[end:]

    def _states(self, z):
        """States (q, γ') from q and further outputs of `Equations.path`."""
        return np.concatenate([z[: self.model.nq], self._levels(z)[0]])

    def _pivots_of(self, outputs):
        return self._levels(outputs)[2]

    def _top(self, t, x):
        return self._levels(self._outputs(t, x))[1]

    def run(self, t0, x0, t1, times, knots):
        """Follow the solution from x0 at t0 to t1 [s], and solve at each of the times (N,) [s]."""
        with interruptible(self.motion):
            self.length = abs(t1 - t0)
            self._look_out(t0, x0)
            cuts = np.array(breakpoints((t0, t1), knots))
            self.longest, self.direction = abs(t1 - t0) / STEPS, np.sign(t1 - t0)
            if self._at_once(cuts, x0, times):
                return self.motion
            self.tolerance = Tolerance(self.model, x0, *DEFAULT)
            self._start(t0, x0, t1)
            self.pending, self.resumed, self.motion.room = times, None, len(times)
            t, x = t0, x0
            while t != t1 and self.motion.stop is None and not self.motion.ended:
                t, x = self._advance(np.append(t, cuts[(cuts - t) * self.direction > 0]), x)
        return self.motion

    def _at_once(self, cuts, x0, times):
        """Take a motion whose steps and pivots are all in order; False if one of them must be inspected."""
        if self.family is not None or self.events is not None or len(times) > BLOCK:
            return False
        nq = self.model.nq
        nodes, followed = self.f.continuation(cuts, x0[:nq], self.p, self.longest, NODES)
        if not 0 < len(nodes) < NODES or nodes[-1, 0] != cuts[-1]:
            return False
        outputs = nodes.T[1 + nq :]
        if not strong(self._levels(outputs)[2], pivot_sizes(self.model)):
            return False
        z, solved = self.f.newton(times, nodes, self.p)
        if z.shape[1] < len(times):
            return False
        self.motion.fill(self.model, times, _jets_from(self.model, z))
        self.motion.keep(self.model, nodes[:, 0], _Solved(self.model, self.f, nodes))
        self.motion.start = np.concatenate([nodes[0, 1 : 1 + nq], self._levels(outputs[:, 0])[0]])
        self.motion.count(iterations=followed + solved, steps=len(nodes) - 1)
        self.progress(cuts[-1])
        return True

    def _look_out(self, t, x):
        """Look for kinks and switches of the motion, if it has any, with the smooth model that holds at the start.

        Those of forces alone change the actuation, not the motion.
        """
        moves = self.model.once("switches of the motion", lambda: switched(self.model.reduction))
        self.family = switching(self.model) if moves else None
        if self.family is not None:
            branches = self.family.branches(t, x)
            self._use(self.family.at(branches))
            self.switches = Switches(self.family, branches, self.length, 1, Tolerance(self.model, x, *DEFAULT))

    def _advance(self, cuts, x):
        """Follow the solution as far as the pivots allow; the instant and the state from which it goes on."""
        nodes, iterations = self.f.continuation(cuts, x[: self.model.nq], self.p, self.longest, NODES)
        self.motion.count(iterations=iterations, steps=max(len(nodes) - 1, 0))
        if not len(nodes):
            self._fail(cuts[0], x, "Newton's method finds no solution of the program from the start")
            return cuts[0], x
        t, nq = nodes[:, 0], self.model.nq
        rates, _, pivots = self._levels(nodes[:, 1 + nq :].T)
        states = np.concatenate([nodes[:, 1 : 1 + nq].T, rates])
        if self.motion.start is None:
            self.motion.start = states[:, 0]
            self.rank.begin(self.model, t[0], pivots[:, 0])
        stretch = Stretch(t, states, np.ones(1), pivots[:, 1:, None], self._between(nodes))
        outcome = self.rank.inspect(stretch)
        last = self._resumption(t, outcome.steps) if isinstance(outcome, Weak) else outcome.steps
        switch = self._switch(stretch.first(last))
        if self.events is not None and self._meets_event(*self._reached(nodes, last, switch, outcome, cuts[-1])):
            return t[last], states[:, last]
        if switch is not None:
            return self._turned(switch, nodes[: switch.steps + 2], cuts[-1])
        self._sample(nodes[: last + 1], states[:, last], t[last], cuts[-1])
        if self.motion.stop is None:
            self.progress(t[last])
        if self.motion.stop is None and not isinstance(outcome, Fine):
            self._follow(outcome)
        elif self.motion.stop is None and len(nodes) < NODES and t[last] != cuts[-1]:
            self._fail(t[last], states[:, last], "Newton's method finds no solution of the program beyond")
        return t[last], states[:, last]

    def _switch(self, stretch):
        """The first switch within steps between nodes, or None."""
        if self.switches is None or len(stretch.t) < 2:
            return None

        self.switches.start = stretch.t[0]
        return self.switches.first(stretch, stretch.dense, stretch.state)

    def _between(self, nodes):
        """States (n_x, N) from steps and times (N,) within them; NaN where there is no solution."""

        def states(_, times):
            found = self._states(self.f.newton(times, nodes, self.p)[0])
            return np.pad(found, ((0, 0), (0, len(times) - found.shape[1])), constant_values=np.nan)

        return states

    def _turned(self, switch, nodes, t1):
        """Go on beyond a switch, or stop there; its instant and the state."""
        self._sample(nodes, switch.x, switch.t, t1)
        if self.motion.stop is None:
            self._turn(switch, t1)
        if self.motion.stop is None:
            self.rank.begin(self.model, switch.t, self._pivots(switch.t, switch.x))
        return switch.t, switch.x

    def _resumption(self, t, last):
        """The node before one with bad pivots, from which others lead on; that node, if they did so before."""
        good = last - 1 if last and t[last - 1] != self.resumed else last
        self.resumed = t[good]
        return good

    @staticmethod
    def _reached(nodes, last, switch, outcome, t1):
        """The nodes up to a switch, a stop or the last one that leads on, the instant, and whether it is a stop."""
        if switch is not None:
            return nodes[: switch.steps + 2], switch.t, False
        stops = isinstance(outcome, Singular) or (len(nodes) < NODES and nodes[-1, 0] != t1)
        reached = nodes if stops else nodes[: last + 1]
        return reached, reached[-1, 0], stops

    def _meets_event(self, nodes, end, stops):
        """Whether a terminal event ends the motion between nodes; the samples up to it are then recorded."""
        t, dense = np.append(nodes[:-1, 0], end), _Solved(self.model, self.f, nodes)
        found = self.events.first(self.model, t, lambda s: dense(None, s, self.p), stops)
        if found is not None:
            x, top = np.split(found.jets[:, None], [len(self.model.state_names)])
            self.pending = self.pending[self.direction * self.pending < self.direction * found.t]
            self._sample(nodes, x[:, 0], min(self.direction * found.t, self.direction * end) * self.direction, None)
            self.motion.add(self.model, [found.t], x, top)
            self.motion.ended = found.name
        return found is not None

    def _sample(self, nodes, x, t, t1):
        """Solve at the pending instants up to t, where the state is x; at all of them if the motion ends there."""
        if len(nodes) > 1:
            self.motion.keep(self.model, nodes[:, 0], _Solved(self.model, self.f, nodes), (), t)
        count = len(self.pending) if t == t1 else int(np.sum((self.pending - t) * self.direction <= 0))
        now, self.pending = self.pending[:count], self.pending[count:]
        for first in range(0, count, BLOCK):
            block = now[first : first + BLOCK]
            z, iterations = self.f.newton(block, nodes, self.p)
            self.motion.count(iterations=iterations)
            solved = z.shape[1]
            self.motion.add(self.model, block[:solved], _jets_from(self.model, z))
            if solved < len(block):
                return self._fail(block[solved], x, "Newton's method finds no solution of the program there")
            if solved:
                self.progress(block[-1])


def _jets_from(model, z):
    """Jets (q, γ', γ'') from q and further outputs of `Equations.path` (n_y, N)."""
    nq, n = model.nq, model.n
    if model.reduction.mechanism.q.plain:
        return z[: nq + 2 * n]
    return np.concatenate([z[:nq], z[3 * nq : 3 * nq + 2 * n]])


@frozen(eq=False)
class _Solved:
    """Jets between nodes, which `Equations.path` f solves for."""

    model: object
    f: object
    nodes: np.ndarray

    @property
    def nbytes(self):
        """Memory of the nodes."""
        return self.nodes.nbytes

    def __call__(self, k, t, p):
        """Jets (n_z, N) at instants (N,), whatever the steps; NaN where there is no solution."""
        order = np.argsort(np.sign(self.nodes[-1, 0] - self.nodes[0, 0]) * t)
        z, _ = self.f.newton(t[order], self.nodes, p)
        solved = _jets_from(self.model, z)
        jets = np.full((len(solved), len(t)), np.nan)
        jets[:, order[: solved.shape[1]]] = solved
        return jets


def switched(reduction):
    """Whether a row of the motion has a kink or a switch that the motion may cross."""
    branches = Branches(reduction.mechanism.q.moves)
    branches.smooth([row.expression for row in reduction.rows], angles="continuous")
    return bool(branches.switches)
