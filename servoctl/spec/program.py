"""Program (servo) constraints of any order."""

import casadi as ca
import numpy as np

from servoctl.checks import by_name, column, finite, mapping, named, positive, require_kind, within, without_effect
from servoctl.errors import SpecificationError
from servoctl.jets.branches import without_turns
from servoctl.jets.overflow import settled
from servoctl.spec.coordinates import Coordinates, Rate
from servoctl.spec.packing import Packed
from servoctl.spec.references import orders_in

REALISATIONS = ("ideal", "actuators")


class Program(Packed):
    """Program constraints: named residuals of any, mixed order, and who realises them.

    Parameters
    ----------
    residuals : dict of str to SX scalar
        φ_i(t, q, γ', ..., γ^(s_i)), which the motion keeps at zero; one with angles atan2(y, x) up to whole turns.
    by : {"ideal", "actuators"}
        "ideal": an ideal reaction, which does no work on the virtual displacements that the program's leading
        matrix allows (eq. (3.18) as printed; for residuals nonlinear in velocities or of order >= 2 this
        generalised Chetaev rule is a postulate). "actuators": the actuators of the mechanism.
    weights : dict of str to float or SX, or "inertia", optional
        Weights W of the actuators, for programs with fewer residuals than actuators: the actuation has least
        (u - u_wish)ᵀW(u - u_wish). Default 1 each, in units of the actuators. "inertia", where each velocity has an
        actuator: W = EᵀM⁻¹E, so that the accelerations are nearest, in the metric of the inertia, to those that the
        wish would give (Gauss's principle).
    toward : dict of str to float or SX, optional
        The wish u_wish by actuator: expressions of t, q and γ', such as a spring that draws a redundant arm towards a
        posture, or a brake that damps its self-motion. Default 0 each.

    jumps : bool, optional
        Whether forces may jump at breaks of the paths of references. By default a path of too low a class is refused.
    integrals : dict of str to SX scalar, optional
        F by residual, of order at most 2, where the residual is the k-th time derivative of F, up to a function of
        time: what a loop reads, and feeds back, of residuals of order 3 and more. Known without it where a residual is
        written as `q.dt(F, k) - ...`.

    Attributes
    ----------
    with_turns : dict of str to SX scalar
        The residuals as they were written: their angles jump by 2π.
    metric : {"actuators", "inertia"}
        What the weights measure.

    Raises
    ------
    SpecificationError
        If there is no residual, or one is no scalar expression.
    NameUnknown
        If `by` is another word.
    """

    def __init__(self, residuals, by="actuators", weights=None, toward=None, jumps=False, integrals=None):
        if not isinstance(residuals, dict) or not residuals:
            raise SpecificationError(
                f"The program's residuals are {residuals!r}.",
                "A program has at least one residual, by name.",
                do='Write {"X": expression, ...}.',
                residuals=residuals,
            )
        named(by, REALISATIONS, "realisation")
        mapping(residuals, "The residuals")
        chosen = [name for name, value in (("weights", weights), ("toward", toward)) if value is not None]
        without_effect(chosen if by != "actuators" else [], f"with by={by!r}: they choose among actuators")
        self.with_turns = {name: _residual(name, value) for name, value in residuals.items()}
        self.residuals = {name: without_turns(value) for name, value in self.with_turns.items()}
        self.by, self.jumps = by, require_kind(bool, "jumps", jumps, "jumps=True")
        self.metric = "inertia" if isinstance(weights, str) and weights == "inertia" else "actuators"
        weights = None if self.metric == "inertia" else weights
        self.weights = {name: _weight(name, value) for name, value in mapping(weights, "The weights").items()}
        self.toward = {name: _wish(name, value) for name, value in mapping(toward, "The wishes").items()}
        found = {name: value.of for name, value in residuals.items() if isinstance(value, Rate)}
        given = by_name(mapping(integrals, "The integrals"), self.residuals, "residual", "The integrals")
        given = {name: column(value, f"The integral of {name!r}", 1)[0] for name, value in given.items()}
        self.integrals, self.stated = found | given, tuple(given)

    def __eq__(self, other):
        """Whether names, choices and expressions in symbols of the same names are the same."""
        if type(other) is not type(self):
            return NotImplemented
        return self is other or self._facts() == other._facts()

    def __hash__(self):
        return hash((self.names, self.by, self.metric))

    def _facts(self):
        """Names, choices, symbols' names and expressions as text."""
        parts = (self.with_turns, self.weights, self.toward, self.integrals)
        expressions = [ca.SX(value) for part in parts for value in part.values()]
        symbols = ca.symvar(ca.vertcat(*expressions))
        text = ca.Function("program", symbols, expressions).serialize()
        return [[*part] for part in parts], self.by, self.metric, self.jumps, [s.name() for s in symbols], text

    @property
    def names(self):
        """The residuals' names."""
        return tuple(self.residuals)

    def slowed(self, q, factor, at=0.0):
        """The program of the same motion along a slower time: q_s(t) = q(at + (t - at)/σ).

        Residuals are written for the slowed jets, φ(at + (t - at)/σ, q, σγ', σ²γ'', ...) = 0: paths and rates alike
        take σ times as long. Weights are slowed alike; wishes are forces, of which time alone is slowed.

        Parameters
        ----------
        q : Coordinates
            Those of the mechanism.
        factor : float
            σ > 0; below 1 the motion is quicker.
        at : float
            The fixed instant [s].

        Returns
        -------
        Program

        Raises
        ------
        SpecificationError
            If the factor is not positive, the kinematics q' = V w + h depend on time or drift by h, or the program
            follows references, whose paths are slowed.
        """
        require_kind(Coordinates, "q", q, "sv.coordinates(...)")
        sigma, instant = positive("factor", factor), finite("at", at, "instant")
        if names := self.references(q):
            slower = f"{names[0]}=path.at_rate({1 / sigma:.6g}, about={instant:g})"
            raise SpecificationError(
                f"The program follows {', '.join(names)}.",
                "A program has its formulas of time; the time of references runs in their paths.",
                nearest=f"model.with_references({slower}).",
                do="Derive the program once, and pass slower paths.",
                references=names,
            )
        return self.slower(q, sigma, instant)

    def references(self, q):
        """Names of the references that residuals, weights and wishes contain, in the order in which they were made.

        Parameters
        ----------
        q : Coordinates
            Those of the mechanism.

        Returns
        -------
        tuple of str
        """
        parts = self.with_turns, self.weights, self.toward
        return tuple(orders_in(q, [ca.SX(value) for part in parts for value in part.values()]))

    def slower(self, q, sigma, instant):
        """The program of `slowed`, whose references follow paths that are slowed alike.

        Parameters
        ----------
        q : Coordinates
            Those of the mechanism.
        sigma : float
            σ > 0.
        instant : float
            The fixed instant [s].

        Returns
        -------
        Program
        """
        if not q.plain and (not q.h.is_zero() or ca.depends_on(q.V, q.t)):
            raise SpecificationError(
                "The kinematics q' = V w + h depend on time or drift by h.",
                "A slower program has the same kinematics; these would have to change with it.",
                do="Write the slower mechanism and program yourself.",
                coordinates=list(q.names),
            )
        symbols, values = [q.t], [instant + (q.t - instant) / sigma]
        weights = {name: ca.SX(value) for name, value in self.weights.items()}
        parts = (self.with_turns, weights, self.integrals)
        every = [value for part in parts for value in part.values()]
        for k in range(1, max(map(q.order, every)) + 1):
            symbols += q.gamma(k)
            values += [sigma**k * s for s in q.gamma(k)]
        for symbol in ca.symvar(ca.vertcat(*every)):
            place = q.where(symbol)
            if place and place[0] == "r" and place[1]:
                symbols, values = [*symbols, symbol], [*values, sigma ** place[1] * symbol]
        slower = iter(ca.substitute(every, symbols, values))
        residuals, weights, integrals = ({name: next(slower) for name in part} for part in parts)
        toward = {name: ca.substitute(ca.SX(wish), q.t, values[0]) for name, wish in self.toward.items()}
        program = self.again(residuals, weights, toward)
        program.integrals = {
            name: sigma ** (q.order(residuals[name]) - q.order(F)) * F for name, F in integrals.items()
        }
        return program

    def again(self, residuals, weights, toward):
        """A program with other expressions, realised alike.

        Parameters
        ----------
        residuals : dict of str to SX scalar
        weights, toward : dict of str to float or SX
        """
        weights = "inertia" if self.metric == "inertia" else weights or None
        program = Program(residuals, self.by, weights, toward or None, self.jumps)
        program.integrals, program.stated = self.integrals, self.stated
        return program

    def __repr__(self):
        return f"Program({', '.join(self.residuals)}; by {self.by})"


def no_program(jumps=False):
    """The program without residuals: forces alone determine the motion, and may jump if so."""
    program = object.__new__(Program)
    program.by, program.residuals, program.with_turns, program.weights, program.toward = "actuators", {}, {}, {}, {}
    program.metric, program.jumps, program.integrals, program.stated = "actuators", jumps, {}, ()
    return program


def _residual(name, value):
    if isinstance(value, (bool, str)) or (isinstance(value, np.ndarray) and value.dtype != object):
        value = [value]
    (residual,) = settled(column(value, f"The residual {name!r}", 1))
    if not ca.symvar(residual):
        raise SpecificationError(
            f"The residual {name!r} is the number {residual}.",
            "A residual is an expression of the coordinates, their derivatives and t.",
            do="Write the expression that the motion keeps at zero.",
            name=name,
        )
    return residual


def _weight(name, value):
    if isinstance(value, ca.SX):
        (weight,) = column(value, f"The weight of {name!r}", 1)
        if ca.symvar(weight):
            return weight
    return within(name, value, above=0.0, given=f"The weight of {name!r} is {value!r}.")


def _wish(name, value):
    if isinstance(value, ca.SX):
        return column(value, f"The wish of {name!r}", 1)[0]
    return finite(name, value, "wish")
