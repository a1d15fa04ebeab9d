"""The watch on rank: pivots that degrade are chosen anew; where no pivot helps, the program is singular."""

import numpy as np

from servoctl.errors import ServoError, SingularProgram
from servoctl.reduction.ranks import column_sizes

DEGRADED = 0.02  # of its reference: a pivot below this is chosen anew, if the matrix itself is better than that
HELPS = 5.0  # by how much the matrix must be better
NEGLIGIBLE = 1e-7  # of its reference: a pivot below this is zero
HOPELESS = 1e-9  # an equilibrated singular value below this leaves no digits
NO_CHOICE = "no choice of pivots leads on"
VANISHING = 0.03  # of its reference: a row whose gradient is below this has lost it


class Watch:
    """Pivots and matrices of a model along a motion.

    Parameters
    ----------
    model : Model
    t : float
    x : (n_x,) array
        Where references are taken; they grow along the motion.
    before : Watch, optional
        The watch on the variant that this one replaces: its references are kept for columns and for the rows that
        both have, so that a row whose gradient has nearly vanished does not look new.
    """

    def __init__(self, model, t, x, before=None):
        self.model = model
        self.f, self.invariants = model.function("matrices"), model.function("invariants")
        self.l_names, self.b_names = model.leading_names()
        self.reference = None
        matrices = [np.nan_to_num(m, nan=0.0, posinf=0.0, neginf=0.0) for m in self._matrices(t, x)]
        self.columns = [
            np.where(now > 0, now, np.where(usual > 0, usual, 1.0))
            for now, usual in zip(map(column_sizes, matrices), model.column_sizes, strict=True)
        ]
        if before is not None:
            self.columns = before.columns
        self.rows = [np.linalg.norm(m / c, axis=1) for m, c in zip(matrices, self.columns, strict=True)]
        self.stories = [model.row_stories(), {}]
        self.largest = np.abs(np.asarray(x, dtype=float))
        self.best, self.lift = self._smallest(matrices), 1.0
        if before is not None:
            self._inherit(before, matrices)
        self.m = len(model.invariant_names())
        jacobian = self.invariants(t, x, model.parameters)[self.m :].reshape(len(x), self.m).T
        self.gradients = np.maximum(np.sqrt((jacobian**2 * (1.0 + np.abs(x)) ** 2).sum(axis=1)), 1e-300)

    def _inherit(self, before, matrices):
        for i, names in enumerate((self.l_names, self.b_names)):
            old = dict(zip((before.l_names, before.b_names)[i], before.rows[i], strict=True))
            for j, name in enumerate(names):
                if name in old and self.stories[i].get(name) == before.stories[i].get(name):
                    self.rows[i][j] = old[name]
        self.largest = np.maximum(self.largest, before.largest)
        now = self._smallest(matrices)
        self.best = np.maximum(now, before.best)
        self.lift = 1.0 / max(float(np.min(now / np.where(self.best > 0, self.best, 1.0))), DEGRADED)

    def _matrices(self, t, x):
        n = self.model.n
        y = self.f(t, x, self.model.parameters)
        rows = len(self.l_names)
        return y[: rows * n].reshape(n, rows).T, y[rows * n :].reshape(n, len(self.b_names)).T

    def _smallest(self, matrices):
        result = []
        for m, c, r in zip(matrices, self.columns, self.rows, strict=True):
            scaled = (m / c) / np.where(r > 0, r, 1.0)[:, None] if np.all(np.isfinite(m)) else m
            finite = scaled.size and np.all(np.isfinite(m))
            result.append(np.linalg.svd(scaled, compute_uv=False)[-1] if finite else (0.0 if scaled.size else 1.0))
        return np.array(result)

    def rank_measure(self, t, x):
        """The smallest equilibrated singular value of L or of B, relative to the best so far."""
        self.largest = np.maximum(self.largest, np.abs(x))
        now = self._smallest(self._matrices(t, x))
        self.best = np.maximum(self.best, now)
        return float(np.min(now / np.where(self.best > 0, self.best, 1.0)))

    def relative(self, guards):
        """Pivots (n_g,) or (n_g, N) relative to the largest size that each has had until then."""
        guards = np.asarray(guards)
        if not guards.size:
            return guards
        sizes = np.abs(guards.reshape(len(guards), -1))
        sizes = np.where(np.isfinite(sizes), sizes, 0.0)
        if self.reference is None:
            sizes[:, 0] *= self.lift
        else:
            sizes[:, 0] = np.maximum(sizes[:, 0], self.reference)
        largest = np.maximum.accumulate(sizes, axis=1)
        self.reference = largest[:, -1]
        return guards / np.where(largest > 0, largest, 1.0).reshape(guards.shape)

    def residual(self, t, x):
        """Largest residual of the invariants, relative to their gradients at the start."""
        value = self.invariants(t, x, self.model.parameters)[: self.m]
        return float(np.abs(value / self.gradients).max(initial=0.0))

    def lost(self, t, x):
        """Whether rank, not the integrator, is what fails at a state where no step succeeds."""
        return self.rank_measure(t, x) < 0.1 or float(self.best.min()) < HOPELESS

    def hidden_zero(self, relative, t, x):
        """Whether a relative pivot, or the matrices themselves, are so small that the residual hides a zero."""
        return min(relative, self.rank_measure(t, x)) < max(NEGLIGIBLE, 10.0 * np.sqrt(self.residual(t, x)))

    def chart_only(self, relative, t, x):
        """Whether a degraded pivot is only a bad choice: the matrices themselves are far better."""
        return self.rank_measure(t, x) > HELPS * max(abs(relative), NEGLIGIBLE)

    def refuse_start(self, t, x, outputs):
        """The error of a start at which the accelerations are not finite with any choice of pivots, or None."""
        return None if np.all(np.isfinite(outputs)) else self.singular(t, x, "the accelerations are not finite there")

    def bad_choice(self, outputs, n_x):
        """Whether the outputs of a right-hand side at the start show pivots far worse than the matrices."""
        if not np.all(np.isfinite(outputs)):
            return True
        reference = self.model.guard_sizes
        weakest = (np.abs(outputs[n_x:]) / np.where(reference > 0, reference, 1.0)).min(initial=1.0)
        return bool(weakest < DEGRADED and self.best.min() > HELPS * weakest)

    def anew(self, t, x, top):
        """The model with pivots chosen at a state x with γ^(s̄) = top, as far as that is finite, and the watch on it.

        Returns
        -------
        (Model, Watch) or None
            None where no choice is found.
        """
        sizes = {name: size for name, size in zip(self.model.state_names, self.largest, strict=True) if size > 0}
        try:
            model = self.model.near(t, np.append(x, np.nan_to_num(top)), sizes)
            return model, Watch(model, t, x, self)
        except ServoError:
            return None

    def other_choice(self, t, jets, later, state):
        """The model with pivots and rows chosen anew at an instant, if that keeps its rank at a later state, else None.

        Parameters
        ----------
        t : float
            Before the pivot vanishes [s].
        jets : (n_z,) array
            Jets there.
        later : float
            Where the pivot vanishes [s].
        state : (n_x,) array
            State there.

        Returns
        -------
        (Model, Watch) or None
        """
        variant = self.anew(t, jets[: len(state)], jets[len(state) :])
        return variant if variant and variant[1].rank_measure(later, state) > DEGRADED else None

    def singular(self, t, x, why):
        """The error that tells where, which row, and which jets are zero there."""
        matrices = self._matrices(t, x)
        measure = self.rank_measure(t, x)
        lost, zero, names = [], [], (self.l_names, self.b_names)
        for m, c, r, rows in zip(matrices, self.columns, self.rows, names, strict=True):
            norms = np.linalg.norm(m / c, axis=1)
            lost += [name for name, a, b in zip(rows, norms, r, strict=True) if a <= VANISHING * b and name not in lost]
        state = dict(zip(self.model.state_names, zip(x, self.largest, strict=True), strict=True))
        for row in lost or dict.fromkeys([*self.l_names, *self.b_names]):
            for name in self.model.gradient_jets(row):
                value, largest = state.get(name, (1.0, 1.0))
                if abs(value) < VANISHING * max(largest, 1e-12) and name not in zero:
                    zero.append(name)
        direction = self._null_direction(matrices)
        where = f", where {' and '.join(f'{name} = 0' for name in zero)}" if zero else ""
        dependent = [] if lost else self._dependent_rows(matrices[0])
        what = (
            f"the gradient of row {', '.join(map(repr, lost))} vanishes"
            if lost
            else f"the rows {', '.join(map(repr, dependent))} lose their rank"
        )
        return SingularProgram(
            f"The program is singular at t = {t:.7g} s: {what}{where}; {why}.",
            f"The smallest equilibrated singular value is {measure:.1e} of its best along the motion; in the direction "
            f"of {', '.join(direction)} the equations say nothing.",
            nearest=f"The motion before t = {t:.6g} s, which is kept.",
            do="State the residual in a form whose gradient does not vanish (linear in velocities, not squared), "
            "or plan around this state.",
            t=float(t),
            measure=measure,
            rows=lost or dependent,
            zero=zero,
            direction=direction,
        )

    def _dependent_rows(self, leading):
        """Names of the rows of L that depend on each other: its left null vector."""
        if not np.all(np.isfinite(leading)):
            return list(self.l_names)
        scaled = leading / self.columns[0]
        norms = np.linalg.norm(scaled, axis=1)[:, None]
        scaled = scaled / np.where(norms > 0, norms, 1.0)
        weights = np.abs(np.linalg.svd(scaled)[0][:, -1])
        return [self.l_names[j] for j in np.flatnonzero(weights > 0.1 * weights.max())]

    def _null_direction(self, matrices):
        """Names of the accelerations that the rows leave open: the right null vector of L."""
        leading, columns = matrices[0], self.columns[0]
        names = self.model.jet_names[-self.model.n :]
        if not np.all(np.isfinite(leading)):
            return list(names)
        rows = np.linalg.norm(leading / columns, axis=1)
        vector = np.abs(np.linalg.svd((leading / columns) / np.where(rows > 0, rows, 1.0)[:, None])[2][-1] / columns)
        return [names[j] for j in np.flatnonzero(vector > 0.1 * vector.max())]
