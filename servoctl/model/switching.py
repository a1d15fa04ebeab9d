"""The smooth models between which the motion of a specification with kinks and switches changes."""

from functools import cached_property, lru_cache

import casadi as ca
import numpy as np

from servoctl.codegen.function import compiled
from servoctl.errors import SpecificationError
from servoctl.jets.branches import Branches, has_switches
from servoctl.model.equations import residual_names
from servoctl.model.model import Model, derived
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.parameters import Parameters
from servoctl.spec.references import function_of

MOST_TURNS = 16  # of a switch at one state, while those inside its switching function are settled


class Switching:
    """A model as a family of smooth models, one for each choice of its branches; made by `switching`.

    `model` is the one that was specified; `switches` is a list of `Switch` in the order of the branches.
    """

    def __init__(self, model):
        r, q = model.reduction, model.reduction.mechanism.q
        self.model = model
        names = r.mechanism.parameters.names
        branches = Branches(q.moves, names)
        self._specification = _smooth(r.mechanism, r.program, _angles(model), branches)
        self.switches = branches.switches
        for s in self.switches:
            if q.order(s.function) >= r.top:
                raise SpecificationError(
                    f"A kink or switch depends on accelerations: {s.text}.",
                    f"What decides a branch is known with the state, of derivatives below order {r.top}.",
                    do="Let it depend on coordinates, velocities or time, or use a smooth function such as tanh.",
                    switch=s.text,
                    order=q.order(s.function),
                )
        self._models, self._sides = {}, {}  # by branches; by sides alone

    @cached_property
    def _function(self):
        """Switching functions, the branches beyond their zeros, and derivatives of the former in X and t."""
        m = self._specification[0]
        q = m.q
        state = ca.vertcat(*q, *(s for k in range(1, self.model.reduction.top) for s in q.gamma(k)))
        functions = ca.vertcat(*(s.function for s in self.switches))
        others = ca.vertcat(*(s.other for s in self.switches))
        y = ca.densify(ca.cse(ca.vertcat(functions, others, ca.vec(ca.densify(ca.jacobian(functions, state))))))
        p, names = ca.vertcat(*m.parameters.symbols), self.model.reduction.references
        return compiled(function_of(q, names, "switches", state, p, y), "switches")

    def values(self, branches, t, x):
        """Switching functions (S, N), their slopes in X (S, n_x, N), and the branches beyond their zeros (S, N).

        At times t (N,) [s] and states x (n_x, N). The functions are not negative where the branches (tuple of float)
        are right.
        """
        n = len(self.switches)
        y = self._function.grid(t, x, np.append(self.model.p, branches))
        return y[:n], y[2 * n :].reshape(len(x), n, -1).swapaxes(0, 1), y[n : 2 * n]

    def branches(self, t, x, known=None):
        """The branches at a state x (n_x,) at time t [s].

        `known` are branches nearby, which are kept where a switching function is zero.
        """
        result = list(known or (float(not s.angle) for s in self.switches))
        for _ in range(MOST_TURNS * len(result)):  # branches inside the switching functions of others are settled first
            functions, _, others = self.values(tuple(result), np.array([t]), x[:, None])
            wrong = np.flatnonzero(functions[:, 0] < 0)
            if not len(wrong):
                break
            result[wrong[0]] = float(others[wrong[0], 0])
        return tuple(result)

    def at(self, branches):
        """The smooth model for a choice of branches (tuple of float).

        Raises ServoError if the specification has no model with them, or one of another structure.
        """
        if branches not in self._models:
            # half turns of an angle change no rank, so that they need no decision
            sides = tuple(0.0 if s.angle else b for s, b in zip(self.switches, branches, strict=True))
            if sides not in self._sides:
                self._sides[sides] = self._derived(sides, branches)
            model = self._sides[sides]
            values = np.append(self.model.parameters, branches)
            parts = model.reduction, model._store, values, model._functions
            self._models[branches] = Model(*parts, paths=self.model.paths)
        return self._models[branches]

    def _derived(self, sides, branches):
        """The smooth model for a choice of sides."""
        if self._sides:
            model = next(iter(self._sides.values()))
            now = model.parameters[len(self.model.parameters) :]
            kept = [b if s.angle else side for s, b, side in zip(self.switches, now, sides, strict=True)]
            model = model.with_parameters(**dict(zip(self._names, kept, strict=True)))
        else:
            model = derived(*self._with_numbers(branches), self.model.reduction.context.guess)
        self._require_same(model, branches)
        return model

    @property
    def _names(self):
        """Names of the branches among the parameters."""
        return self._specification[0].parameters.names[len(self.model.parameters) :]

    def _with_numbers(self, branches):
        """The smooth specification with the model's numbers and with branches."""
        mechanism, program = self._specification
        symbols = dict(zip(mechanism.parameters.names, mechanism.parameters.symbols, strict=True))
        parameters = _parameters(symbols, np.append(self.model.parameters, branches))
        return _with(mechanism, parameters=parameters), program

    def _require_same(self, model, branches):
        """Refuse a model of another state, or with other rows, than the one that was specified."""
        r, s = self.model.reduction, model.reduction
        if (r.top, r.free, residual_names(r)) == (s.top, s.free, residual_names(s)):
            return
        changed = [a.name for a, b in zip(r.rows, s.rows, strict=False) if (a.name, a.order) != (b.name, b.order)]
        raise SpecificationError(
            f"Beyond a kink or switch the program has {s.free} free initial values, and {r.free} where it was derived.",
            "The number of free initial values is the same along a motion.",
            do="Derive two models, one for each side, and continue one motion by the other.",
            free=s.free,
            expected=r.free,
            row=changed[0] if changed else None,
            branches=branches,
        )


def switching(model: Model) -> Switching | None:
    """The smooth models of a model with kinks or switches of its jets; None if it has none."""
    r = model.reduction

    def branched():
        rows = _residuals(r.mechanism, r.program, _angles(model))
        return has_switches(ca.vertcat(r.mechanism.balance, *rows))

    if not model.once("branches", branched):
        return None
    family = _switching(model)
    return family if family.switches else None


@lru_cache(32)
def _switching(model):
    return Switching(model)


def _angles(model):
    """The residuals of a program by name: angles jump by 2π where a motion is integrated, which follows their turns."""
    program = model.reduction.program
    return program.residuals if model.flat else program.with_turns


def _residuals(mechanism, program, residuals):
    chosen = [w for w in (*program.weights.values(), *program.toward.values()) if isinstance(w, ca.SX)]
    return [*residuals.values(), *mechanism.constraints.values(), *chosen, *mechanism.E.elements()]


def _smooth(mechanism, program, residuals, branches):
    """The mechanism and the program with branches as further parameters."""
    residuals = dict(zip(residuals, branches.smooth(list(residuals.values()), "continuous"), strict=True))
    constraints = dict(
        zip(mechanism.constraints, branches.smooth(list(mechanism.constraints.values()), "continuous"), strict=True)
    )
    weights, toward = (
        {name: branches.smooth([ca.SX(e)])[0] for name, e in chosen.items()} or None
        for chosen in (program.weights, program.toward)
    )
    columns = {
        name: ca.reshape(ca.vertcat(*branches.smooth(m.elements(), "principal")), *m.shape) if m.numel() else m
        for name, m in (("balance", mechanism.balance), ("forces", mechanism.forces), ("E", mechanism.E))
    }
    parameters = _extended(mechanism.parameters, [s.branch for s in branches.switches])
    smooth = _with(mechanism, **columns, constraints=constraints, energy=mechanism.energy, parameters=parameters)
    return smooth, program.again(residuals, weights, toward) if residuals else program


def _with(mechanism, **parts):
    """The mechanism with some of its parts replaced."""
    other = Mechanism.__new__(Mechanism)
    vars(other).update({name: part for name, part in vars(mechanism).items() if name != "mass"} | parts)
    return other


def _extended(parameters, symbols):
    """The parameters with further symbols, whose numbers depend on the state."""
    known = dict(zip(parameters.names, parameters.symbols, strict=True)) | {s.name(): s for s in symbols}
    return _parameters(known, [*parameters.values(), *(1.0 for _ in symbols)])


def _parameters(symbols, numbers):
    """Parameters of given symbols by name."""
    result = Parameters(dict(zip(symbols, map(float, numbers), strict=True)))
    result._symbols = symbols
    return result
