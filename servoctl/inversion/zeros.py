"""The polynomial whose roots are the eigenvalues of the internal dynamics at an equilibrium, by a parameter.

Deviations of a motion e^(st) [δπ; δμ] with δq = V δπ satisfy, at an equilibrium,

    Z(s) [δπ; δμ] = 0,    Z(s) = Σ_j s^j ∂ψ/∂[γ^(j); μ],    ψ = [r - B μ; φ; material rows],

so that these eigenvalues are the roots of det Z. Its coefficients are smooth in the parameter: roots move on, and reach
the right half plane through the imaginary axis, or through infinity where the highest coefficient vanishes and with it
the relative degree. No rank is decided, and nothing is divided by a pivot.
"""

import casadi as ca
import numpy as np

from servoctl.codegen.paths import arguments, evaluated
from servoctl.errors import InconsistentStart, NotRealisable
from servoctl.model.following import p_with
from servoctl.model.rests import Rests
from servoctl.reduction.ranks import equilibrate
from servoctl.spec.references import function_of, rates_in_time

NO_COEFFICIENT = 1e-11  # of the largest coefficient: a smaller one is zero
ON_AXIS = 1e-10  # real part of a root, relative to its size or the usual one, below which it lies on the axis
RADII = 4  # adjustments of the circle on which det Z is evaluated
MOVED = 1e-6  # distance of an equilibrium from the state that was passed, and its speed, relative to the state's size


class ZeroPolynomial:
    """det Z of a program at its equilibria, by the value of a parameter.

    `at` is an equilibrium under the model's own value; a state that is none is refused, as is a program that moves
    there.
    """

    def __init__(self, model, parameter, at):
        self.model, self.parameter, self.t, self.nq = model, parameter, at.t, model.nq
        self.own = model.numbers[parameter]
        self.rests, (self._rates, self._parts, self.degree) = Rests.of_model(model), _equations(model)
        self._values = {}
        self._known = {self.own: self._rest(self.own, at.values[: self.nq])}
        self._require_equilibrium(at)
        self.low, self.high, self.radius, self._scales = 0, self.degree, 1.0, None
        self._adjust()

    def _numbers(self, value):
        names = list(self.model.numbers)
        numbers = np.where(np.arange(len(names)) == names.index(self.parameter), value, self.model.parameters)
        return p_with(self.model, numbers)

    def _rest(self, value, q):
        """[q; μ] of the equilibrium nearest to coordinates."""
        z, there, worst = self.rests.reached(self.t, self._numbers(value), q)
        if not there:
            raise InconsistentStart(
                f"With {self.parameter} = {value:g} no equilibrium was reached: the {worst[0]} is {worst[1]:.1e} off.",
                "Internal dynamics are linearised at an equilibrium of the program.",
                do="Pass the state of another equilibrium, or a smaller range of values.",
                parameter=self.parameter,
                value=value,
                residual=worst[1],
            )
        return z

    def _require_equilibrium(self, at):
        """Refuse a state that is no equilibrium, and a program that does not stand still there."""
        z = self._known[self.own]
        q, size = z[: self.nq], 1.0 + np.abs(z[: self.nq]).max(initial=0.0)
        away, moving = np.abs(at.values[: self.nq] - q).max(), np.abs(at.values[self.nq :]).max(initial=0.0)
        rate = np.abs(evaluated(self._rates, self.t, q, self._numbers(self.own))).max(initial=0.0)
        if max(away, moving) <= MOVED * size and rate <= MOVED:
            return
        nearest = dict(zip(self.model.reduction.mechanism.q.names, q.tolist(), strict=True))
        listed = ", ".join(f"{name} = {x:.6g}" for name, x in nearest.items())
        raise InconsistentStart(
            f"At t = {self.t:g} s the program moves: its residuals change by {rate:.2g} per second."
            if rate > MOVED
            else f"The state at t = {self.t:g} s is no equilibrium: its coordinates are {away:.3g} off the nearest, "
            f"its velocities and accelerations up to {moving:.3g}.",
            "Internal dynamics are linearised at an equilibrium, while the program stands still.",
            nearest="" if rate > MOVED else f"{listed}.",
            do="Pass the state of an equilibrium, as model.start(...) with its coordinates held.",
            equilibrium=nearest,
            t=self.t,
        )

    def equilibrium(self, value):
        """[q; μ] for a value, continued from the nearest value that is known."""
        if value not in self._known:
            nearest = min(self._known, key=lambda known: abs(known - value))
            self._known[value] = self._rest(value, self._known[nearest][: self.nq])
        return self._known[value]

    def follow(self, values):
        """Continue the equilibrium over values, and decide which powers of s occur over them."""
        for value in sorted(values, key=lambda v: abs(v - self.own)):
            self.equilibrium(value)
        sizes = np.abs([self._all(value) for value in values]).max(axis=0)
        present = np.flatnonzero(sizes > NO_COEFFICIENT * sizes.max())
        if not len(present) or not np.isfinite(sizes).all():
            raise NotRealisable(
                f"With {self.parameter} from {values[0]:g} to {values[-1]:g} the linearised residuals leave the motion "
                "or the actuation open at the equilibrium.",
                "The residuals determine the actuation there, through some of their derivatives.",
                do="Choose another equilibrium, or other outputs.",
                parameter=self.parameter,
            )
        self.low, self.high = int(present[0]), int(present[-1])

    def _adjust(self):
        """Scale s and the rows and columns of Z so that coefficients are near 1."""
        for _ in range(RADII):
            size = sum(np.abs(part) * self.radius**j for j, part in enumerate(self._matrices(self.own)))
            self._scales = [a.astype(float) for a in equilibrate(size)[1:]]
            self._values.clear()
            c = np.abs(self._all(self.own))
            present = np.flatnonzero(c > NO_COEFFICIENT * c.max(initial=0.0))
            if len(present) < 2:
                return
            first, last = present[[0, -1]]
            self.radius *= (c[first] / c[last]) ** (1.0 / (last - first))
        self._values.clear()

    def _matrices(self, value):
        """Z_0, Z_1, ..."""
        point = arguments(self._parts, self.t, self.equilibrium(value), self._numbers(value))
        return [np.array(part) for part in self._parts(*point)]

    def _all(self, value):
        """All coefficients of det Z in powers of s over the radius, ascending, from its values on a circle."""
        if value not in self._values:
            rows, columns = self._scales
            size = self.degree + 1
            circle = self.radius * np.exp(2j * np.pi * np.arange(size) / size)[:, None, None]
            Z = sum(part * circle**j for j, part in enumerate(self._matrices(value)))
            self._values[value] = (np.fft.fft(np.linalg.det(rows[:, None] * Z * columns)) / size).real
        return self._values[value]

    def highest(self, value):
        """The highest coefficient: where it vanishes, a root passes through infinity."""
        return self._all(float(value))[self.high]

    def roots(self, value):
        """Roots [1/s] by descending real part, without those at infinity."""
        c = self._all(float(value))[self.low : self.high + 1]
        present = np.flatnonzero(np.abs(c) > NO_COEFFICIENT * np.abs(c).max())
        c = c[: present[-1] + 1]
        if (present % 2).any():
            roots = np.roots(c[::-1]).astype(complex)
        else:  # without damping roots come in pairs ±√σ
            sigma = np.roots(c[::-2]).astype(complex)
            sigma.imag[np.abs(sigma.imag) <= ON_AXIS * np.abs(sigma)] = 0.0
            roots = np.concatenate([np.sqrt(sigma), -np.sqrt(sigma)])
        roots = self.radius * np.concatenate([roots, np.zeros(self.low)])
        return roots[np.lexsort((-roots.imag, -roots.real))]

    def _distances(self, value):
        """Distances of the roots from the axis, relative to their sizes or the usual one: none for a root at zero."""
        roots = self.roots(value)
        return roots.real / np.maximum(np.abs(roots), self.radius)

    def kind(self, value):
        """The number of roots in the right half plane, and whether some lie on the axis."""
        away = self._distances(value)
        return int(np.sum(away > ON_AXIS)), bool(np.any(np.abs(away) <= ON_AXIS))

    def distance(self, value):
        """The smallest distance of a root from the axis."""
        return float(np.min(np.abs(self._distances(value)), initial=1.0))


def _equations(model):
    """Functions of (t, z = [q; μ], p), and a bound of the degree.

    The first gives rates in t of constraints and program at rest by (t, q, p), the second Z_0, Z_1, ...
    """
    r, q = model.reduction, model.reduction.mechanism.q
    mu = ca.SX.sym("mu", r.realisation.B.shape[1])
    balance = (r.balance - r.realisation.B @ mu).elements()
    constraints = [row.expression for row in r.original.values()]
    rows = ca.vertcat(*balance, *constraints)
    orders = [2] * len(balance) + [max(q.order(e), 0) for e in constraints]
    jets = ca.vertcat(*(s for k in range(1, max(orders) + 1) for s in q.gamma(k)))
    rest = (jets, ca.SX.zeros(jets.shape))
    parts = [ca.horzcat(ca.jacobian(rows, q.jet(0)) @ q.V, ca.jacobian(rows, mu))]
    open_ = ca.SX(rows.numel(), mu.numel())
    parts += [ca.horzcat(ca.jacobian(rows, q.jet(j)), open_) for j in range(1, max(orders) + 1)]
    z, p = ca.vertcat(q.jet(0), mu), ca.vertcat(*r.mechanism.parameters.symbols)
    rates = ca.densify(ca.substitute(rates_in_time(q, rows[len(balance) :]), *rest))
    matrices = [ca.densify(ca.substitute(part, *rest)) for part in parts]
    rates = function_of(q, r.references, "rates", q.jet(0), p, rates)
    return rates, function_of(q, r.references, "Z", z, p, *matrices), sum(orders)
