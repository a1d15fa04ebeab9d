"""Forces along references that arrive while the machine moves, one sample after the other."""

import numpy as np

from servoctl.checks import as_numbers, by_name, positive, require_kind
from servoctl.codegen.loops import CORRECTED, CORRECTIONS
from servoctl.errors import IntegrationStopped, SpecificationError
from servoctl.model.jets import with_highest
from servoctl.model.start import State
from servoctl.spec.paths.fit import through_jets
from servoctl.spec.paths.value import Path

TAKEN = 3  # jets of both samples between which Hermite polynomials lie: their error is of the order of RK4's


class Feedforward:
    """The forces of a program along references that arrive in samples; made by `Model.feedforward`.

    `step(jets)` gives the forces by name at the sample to which the jets belong: the first is that of the start, each
    further one a period later. A program that determines all of the motion needs no more than these jets. Another one
    keeps its state, which a Runge-Kutta step of order 4 takes from sample to sample, along the polynomials that have
    the jets of both. Nothing is derived and nothing compiled for a sample.

    Attributes
    ----------
    orders : dict of str to int
        Of each reference the number of derivatives that its jets have at least.
    """

    def __init__(self, model, start, rate):
        self._model, start = model, require_kind(State, "start", start, "model.start(...)")
        if start.names != model.state_names:
            raise SpecificationError(
                f"The start has the values {', '.join(start.names)}.",
                f"The state of this model is {', '.join(model.state_names)}.",
                do="Start without coordinates that the program leaves out.",
                names=start.names,
            )
        self._begin, self._state, self._period = start.t, start.values, 1.0 / positive("rate", rate)
        self._count, self._before = 0, None
        self._names, self._forces = model.signals("reaction" if model.reduction.ideal else "actuation")
        self.orders = {name: max(order, 0) for name, order in model.reduction.follows.items()}

    @property
    def t(self):
        """Time of the next sample [s]."""
        return self._begin + self._count * self._period

    def __repr__(self):
        jets = ", ".join(f"{name} to order {order}" for name, order in self.orders.items())
        kept = "" if self._model.flat else f"; keeps the state {', '.join(self._model.state_names)}"
        return f"Feedforward of {', '.join(self._names)} from the jets of {jets}{kept}"

    def __call__(self, jets):
        """The forces at the next sample.

        Parameters
        ----------
        jets : dict of str to sequence of float
            Value and derivatives of each reference at `t`, SI; as many derivatives as `orders` has, or more.

        Returns
        -------
        dict of str to float

        Raises
        ------
        SpecificationError
            If a reference is missing or unknown, has too few derivatives, or a number that is not finite.
        IntegrationStopped
            Where the machine cannot follow. The sample is not taken then.
        """
        jets, t = self._checked(jets), self.t
        model = self._model.with_references(**{name: _beside(t, r) for name, r in jets.items()})
        state = self._solved(model, t) if model.flat else self._integrated(jets, t)
        forces = self._forces(t, with_highest(model, np.array([t]), state[:, None])[:, 0], model.p)
        if not np.isfinite([*state, *forces]).all():
            raise IntegrationStopped(
                f"The machine cannot follow the references at t = {t:g} s.",
                "A motion goes on as far as its equations have a solution.",
                do="Keep the references within the machine's reach, and their jets those of one path.",
                t=t,
            )
        self._state, self._before, self._count = state, jets, self._count + 1
        return dict(zip(self._names, forces.tolist(), strict=True))

    def _solved(self, model, t):
        """The state of a flat program at t [s], by Newton's method from that of the last sample; NaN without one."""
        f, nq, n = model.function("path"), model.nq, model.n
        first, q = nq if model.reduction.mechanism.q.plain else 3 * nq, self._state[:nq]
        for _ in range(CORRECTIONS):
            y = f(t, q, model.p)
            q = q + y[:nq]
            if np.all(np.abs(y[:nq]) <= CORRECTED * (1.0 + np.abs(q))):
                return np.concatenate([q, y[first : first + n]])
        return np.full(nq + n, np.nan)

    def _integrated(self, jets, t):
        """The state at t [s], by a Runge-Kutta step along the polynomials from the last sample, and its projection."""
        if self._before is None:
            return self._state
        h, ends = self._period, (t - self._period, t)
        paths = {name: _between(ends, self._before[name], r) for name, r in jets.items()}
        model, x = self._model.with_references(**paths), self._state
        f, p = model.function("ode_projected"), model.p
        k1 = f(ends[0], x, p)[: len(x)]
        k2 = f(t - h / 2, x + h / 2 * k1, p)[: len(x)]
        k3 = f(t - h / 2, x + h / 2 * k2, p)[: len(x)]
        k4 = f(t, x + h * k3, p)[: len(x)]
        return f.restore(t, x + h / 6 * (k1 + 2 * (k2 + k3) + k4), p)

    def _checked(self, jets):
        """Jets (order + 1,) of each reference that the forces need, by name."""
        given = by_name(jets, self.orders, "reference", "The jets")
        found = {name: as_numbers(given.get(name, ())).ravel() for name in self.orders}
        for name, order in self.orders.items():
            if len(found[name]) <= order or not np.isfinite(found[name]).all():
                raise SpecificationError(
                    f"The jets of {name!r} at t = {self.t:g} s are {given.get(name)!r}.",
                    f"The forces contain derivatives of {name!r} up to order {order}.",
                    do=f"Pass {order + 1} finite numbers: its value and {order} derivatives.",
                    name=name,
                    order=order,
                    t=self.t,
                )
        return {name: found[name][: order + 1] for name, order in self.orders.items()}


def _beside(t, jets):
    """The path with these jets at t [s], a Taylor polynomial."""
    coefficients = jets / np.cumprod([1.0, *range(1, len(jets))])
    return Path(np.array([t - 1.0, t + 1.0]), coefficients[None, None], np.full(2, np.inf), "continue", "continue")


def _between(ends, before, after):
    """The polynomial between two instants [s] with their jets (k + 1,).

    Two-point Hermite for the last three derivatives, integrated: differences of values would lose their digits over a
    period's powers.
    """
    m = max(len(before) - TAKEN, 0)
    pair = np.stack([before[m:], after[m:]], axis=1)[:, None]
    last = through_jets(np.array(ends), pair, "continue", "continue")
    half = (ends[1] - ends[0]) / 2
    whole = np.polynomial.polynomial.polyint(last.coefficients[0, 0], m, before[:m][::-1], -1, half)
    return Path(np.array(ends), whole[None, None], np.full(2, np.inf), "continue", "continue")
