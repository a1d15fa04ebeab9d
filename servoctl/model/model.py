"""The model: a reduction as functions on numbers, built at their first use."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np

from servoctl.checks import MOST_JETS, as_numbers, by_name, finite, named, whole
from servoctl.codegen.function import compiled
from servoctl.codegen.paths import Followed
from servoctl.errors import ServoError, SpecificationError
from servoctl.markup import Detailed
from servoctl.model.equations import EQUATIONS, SIGNALS, Equations
from servoctl.model.following import instants_of, p_with
from servoctl.model.full import affirmed
from servoctl.model.jets import jet_names_to
from servoctl.model.report import describe, warn_of_products
from servoctl.model.rest import started
from servoctl.model.start import State
from servoctl.model.store import Store, pack, unpack
from servoctl.model.variants import FREE, place_of
from servoctl.progress import stage
from servoctl.reduction.appell import require_positive
from servoctl.reduction.idle import names_of, needed
from servoctl.reduction.reduce import reduce, require_parts
from servoctl.reduction.structure import structure
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program
from servoctl.spec.references import other_paths, paths_at, required_paths
from servoctl.values import evenly, read_only

if TYPE_CHECKING:
    from servoctl.model.streaming import Feedforward

SAMPLED = 50  # samples of a run at which its structure is decided; each takes tens of milliseconds


def derive(
    mechanism: Mechanism,
    program: Program,
    guess: Mapping[str, float] | None = None,
    keep: Sequence[str] = (),
) -> "Model":
    """Derive the reduced dynamics and the required actuation of a mechanism under its program (3.18).

    Parameters
    ----------
    mechanism : Mechanism
    program : Program
    guess : dict of str to float, optional
        Values of coordinates or derivatives near the motion. Ranks are decided at points of the constraint manifold
        near these values. Seldom needed.
    keep : sequence of str, optional
        Names of coordinates that are included although they play no part in the program. By default those are left
        out, with their actuators and material constraints, that nothing couples to the coordinates in residuals,
        weights, wishes, outputs and `guess`; the printed model counts them.

    Returns
    -------
    Model

    Raises
    ------
    SpecificationError
        For constraints that depend on or contradict each other, an unknown symbol, a switch in q.t, a singular mass
        matrix.
    NotRealisable
        If the actuators cannot realise the program.
    SingularProgram
        If a residual's gradient vanishes on its own solutions, or a rank cannot be decided.
    InconsistentStart
        If no state satisfies the constraints.

    Warns
    -----
    RuntimeWarning
        For a residual that is a product and vanishes about the guess by more than one of its factors.
    """
    require_parts(mechanism, program, guess)
    model = derived(needed(mechanism, program, keep, guess or {}), program, guess)
    r = model.reduction
    warn_of_products(r)
    return model


def derived(mechanism, program, guess=None):
    """The model of all coordinates, without warnings."""
    return Model._of(mechanism, program, guess)


def including(model: "Model", names: Iterable[str]) -> "Model":
    """The model with those coordinates among names of signals that play no part in its program; itself without any."""
    r = model.reduction
    if r.mechanism.whole is None:
        return model
    wider = needed(r.mechanism.whole, r.program, r.mechanism.q.names, names)
    if wider.q.names == r.mechanism.q.names:
        return model
    return derived(wider, r.program, model._store.specification[2]).with_parameters(**model.numbers)


def default_start(model: "Model", t: float = 0.0) -> State:
    """The start at t [s] near the guess that `derive` received, without held values; errors as by `Model.start`."""
    guess = model._store.specification[2] or {}
    return model.start(t, {name: value for name, value in guess.items() if name in model.state_names})


class Model(Detailed):
    """Reduced dynamics and required actuation of a program; made by `derive`.

    Functions are derived, or read from disk, at their first use. A model is a value: models of the same specification
    and numbers are equal. It pickles with both; the copy derives its functions again.

    Attributes
    ----------
    reduction : Reduction
        The rows of the motion.
    parameters : (n_p,) array
        Values of the parameters.
    """

    def __init__(self, reduction, store, values=None, functions=None, variants=None, paths=None):
        q = reduction.mechanism.q
        self.reduction, self._store = reduction, store
        self.parameters = read_only(reduction.context.values.copy() if values is None else values)
        paths = {name: q.family.paths[name] for name in reduction.references} if paths is None else paths
        self.paths = paths_at(paths, reduction.mechanism.parameters, self.parameters)
        # Models that differ only in numbers share their functions.
        self._functions = {} if functions is None else functions
        self._variants = {None: self} if variants is None else variants  # with other pivots: one set for all of them

    @classmethod
    @stage("deriving")
    def _of(cls, *specification):
        """The model of the arguments of `reduce`; its reduction is read from disk if another process has written it."""
        store = Store(*specification)
        return cls(store.reduction(reduce), store)

    def __eq__(self, other):
        if not isinstance(other, Model):
            return NotImplemented
        known = self._store.fingerprint is not None and self._store.fingerprint == other._store.fingerprint
        same = known and place_of(self) == place_of(other) and self.paths == other.paths
        return self is other or (same and np.array_equal(self.parameters, other.parameters))

    def __hash__(self):
        return hash(self._store.fingerprint)

    def __reduce__(self):
        mechanism, _, *choices = self._store.specification
        return _unpickled, (mechanism, pack(self.reduction), choices, self.parameters, self.paths)

    def with_parameters(self, **changes: float) -> "Model":
        """The same model with other parameters.

        It shares all functions, unless a decision about a zero or a rank is another one with the new numbers.

        Parameters
        ----------
        **changes : float
            Parameters by name, SI.

        Returns
        -------
        Model

        Raises
        ------
        NameUnknown
            For a name that is no parameter.
        SpecificationError
            For a value that is not finite, or makes a mass negative, or the duration of a path not positive.
        """
        r = self.reduction
        current = self.numbers
        changes = by_name(changes, current, "parameter", "The parameters")
        values = r.mechanism.parameters.values({**current, **changes})
        if not (np.array_equal(values, self.parameters) or affirmed(self, values[:, None])[0]):
            require_positive(r.mechanism, replace(r.points, values=values))
            self._store.require_unchanged()
            return self._of(r.mechanism, r.program, r.context.guess, None, values).with_references(**self.paths)
        return Model(r, self._store, values, self._functions, paths=self.paths)

    def with_references(self, **paths) -> "Model":
        """The same model along other paths: nothing is derived, and nothing compiled.

        Parameters
        ----------
        **paths : Path
            Of one component each, by the names of the references; what SciPy makes is one, too.

        Returns
        -------
        Model

        Raises
        ------
        NameUnknown
            For a name that is no reference.
        SpecificationError
            For what is no path of one component.
        """
        return self._along(other_paths(self.paths, paths))

    def _along(self, paths):
        """The model along paths of all references by name."""
        return Model(self.reduction, self._store, self.parameters, self._functions, paths=paths)

    def _with(self, other, variants=None):
        """The reduction of another model with the numbers and paths of this one."""
        return Model(other.reduction, other._store, self.parameters, other._functions, variants, self.paths)

    @cached_property
    def _followed(self):
        return Followed([path.held() for path in required_paths(self.paths).values()])

    @cached_property
    def _rates_followed(self):
        return {}  # tables of the paths with derivatives by parameters, by the places of these

    @cached_property
    def p(self):
        """The parameters of compiled functions: those of the model, after the place of the paths that it follows."""
        return read_only(p_with(self, self.parameters)) if self.paths else self.parameters

    @property
    def numbers(self):
        """Values of the parameters by name, SI."""
        return dict(zip(self.reduction.mechanism.parameters.names, self.parameters.tolist(), strict=True))

    @property
    def free(self):
        """The number of free initial values: the dimension of the internal dynamics."""
        return self.reduction.free

    @property
    def flat(self):
        """Whether the program determines the motion completely, without internal dynamics."""
        return self.free == 0

    @cached_property
    def state_names(self):
        """Names of the state X = (q, γ', ..., γ^(s̄-1)), a tuple."""
        return tuple(name for k in range(self.reduction.top) for name in self.reduction.mechanism.q.jet_names(k))

    @cached_property
    def jet_names(self):
        """Names of the jets Z = (X, γ^(s̄)), a tuple."""
        return (*self.state_names, *self.reduction.mechanism.q.jet_names(self.reduction.top))

    @property
    def n(self):
        """The number of quasi-velocities."""
        return self.reduction.mechanism.q.n

    @property
    def nq(self):
        """The number of coordinates."""
        return self.reduction.mechanism.q.nq

    @property
    def actuators(self):
        """Names of the mechanism's actuators, or of the inputs that drive it."""
        return self.reduction.mechanism.actuators or self.reduction.mechanism.inputs

    @property
    def outputs(self):
        """Names of the mechanism's outputs."""
        mechanism = self.reduction.mechanism
        return tuple(name for name in mechanism.outputs if name not in mechanism.inputs)

    @cached_property
    def equations(self):
        """The model's equations as expressions."""
        if "equations" not in self._functions:
            self._functions["equations"] = Equations(self.reduction)
        return self._functions["equations"]

    def once(self, name, build):
        """The value of `build()`, which is called once for a name by all processes that share a cache.

        Parameters
        ----------
        name : str
        build : callable
        """
        if name not in self._functions:
            entry = f"{FREE} {name}" if self.reduction.orthogonal else name
            self._functions[name] = self._store.recall(entry, build)
        return self._functions[name]

    def function(self, name):
        """One of the model's compiled functions of (t, x, p), built at first use.

        Parameters
        ----------
        name : str
            "ode", "ode_projected", "ode_poles", "ode_jacobian", "ode_poles_jacobian", "path", "invariants",
            "matrices", "balanced", "full", or "accelerations".

        Returns
        -------
        Compiled
        """
        named(name, EQUATIONS, "function")

        def build():
            f, *options = EQUATIONS[name](self.equations)
            return compiled(f, name, *options)

        return self.once(name, build)

    def signals(self, kind, rate=0):
        """Names of a group of signals, and the compiled function (t, Z, p) of their `rate`-th time derivatives.

        Parameters
        ----------
        kind : str
            A key of `SIGNALS`.
        rate : int
        """
        named(kind, SIGNALS, "group of signals")
        rate = whole("rate", rate, most=MOST_JETS)

        def build():
            names, f = self.equations.signals(kind, rate)
            return names, compiled(f, f.name())

        return self.once(f"signals {kind}{rate or ''}", build)

    def feedforward(self, start: State, rate: float = 1000.0) -> "Feedforward":
        """Forces along references that arrive in samples: `step = model.feedforward(start)`, then `step(jets)`.

        For a controller's loop in real time, `export_c(model, folder, references="argument")` writes the same in C.

        Parameters
        ----------
        start : State
            Of the first sample, by `start`: along any path, or near the first jets if all of the motion follows.
        rate : float, optional
            Samples per second [Hz]; default 1000.

        Returns
        -------
        Feedforward
            Takes value and derivatives of each reference, `step({"X": (x, dx, ...)})`, and returns forces by name.

        Raises
        ------
        SpecificationError
            If the model follows no references, the start is none, or the rate is not positive.
        """
        from servoctl.model.streaming import Feedforward

        if not self.paths:
            raise SpecificationError(
                "The model follows no references.",
                "A feedforward takes the jets of references, sample by sample.",
                do="Write the program with r = q.references(X=None), or simulate its plan.",
            )
        return Feedforward(self, start, rate)

    def start(
        self,
        /,
        t: float = 0.0,
        guess: Mapping[str, float] | None = None,
        hold: Mapping[str, ca.SX] | None = None,
        **held: float,
    ) -> State:
        """Consistent initial values: those passed are fixed, the others follow from the constraints and their rates.

        Where several states have the held values, the one nearest to the guess is taken; the printed state names others
        that a short search finds.

        Parameters
        ----------
        t : float
            Time of the start [s].
        guess : dict of str to float, optional
            Approximate values. Where a path begins at rest, the start is the state of rest nearest to them. Elsewhere
            they are kept if that is consistent, else the state is nearest to them by the kinetic energy, coordinates
            first; values without a guess are as near to zero as the invariants then allow. A coordinate that the model
            leaves out, and that is named here or held, is a part of the state, and of the motions that begin there.
        hold : dict of str to SX, optional
            Further conditions by name: expressions of t, the coordinates and their derivatives of any order that are
            zero at the start, such as `{"heading": ca.atan2(dy, dx) - 0.5}`.
        **held : float
            Exact values of coordinates, derivatives and outputs.

        Returns
        -------
        State

        Raises
        ------
        NameUnknown
            For a name that is no state and no output.
        SpecificationError
            For a value that is no finite number, or a condition that is no expression of the mechanism's symbols.
        InconsistentStart
            If a held value contradicts an invariant, or the search for a consistent state fails.
        SingularProgram
            If the machine stands still, its constraints leave a coordinate open there, and the motion has no limit.
        """
        model = including(self, [*names_of(held), *names_of(guess)])
        return started(model, finite("t", t, "time"), held, guess, hold)

    def structure(self, motion=None, jets=None):
        """Index, relative degrees, zeros at infinity and essential orders (see `reduction.structure`).

        Parameters
        ----------
        motion : Run, State or (N,) array, optional
            A run, of which at most 50 samples are taken, a start, or times [s]. Default: seeded points of the manifold
            and the start near the guess of `derive`, where there is one.
        jets : (n_z, N) array, optional
            At these times.

        Returns
        -------
        Structure
        """
        if motion is None:
            return self.once("structure", lambda: structure(self.reduction, start=self._default_start()))
        model = including(self, names_of(motion))
        t, jets = _samples(model, motion, jets)
        return structure(model.reduction, instants_of(model, t), jets, model.parameters)

    def _default_start(self):
        """The instant and the values of the start without held or guessed values; None if there is none."""
        with suppress(ServoError):
            start = default_start(self)
            return instants_of(self, [start.t]), start.values

    def _lines(self, full):
        return describe(self, full)


def _samples(model, motion, jets):
    """Times (N,) and jets (n_z, N) of a run, at most `SAMPLED` of them, of a start, or as given."""
    names = model.jet_names
    if isinstance(motion, State):
        motion, names, jets = [motion.t], motion.names, motion.values[:, None]
    elif hasattr(motion, "jet_names"):
        some = evenly(len(motion.t), SAMPLED)
        motion, names, jets = motion.t[some], motion.jet_names, motion.jets[:, some]
    t, jets = np.atleast_1d(as_numbers(motion)), np.atleast_1d(as_numbers(jets))
    count = len(jets)
    fits = t.ndim == 1 and len(t) and jets.shape == (count, len(t)) and names[:count] == jet_names_to(model, count)
    if not (fits and count >= len(model.state_names) and np.isfinite(t).all() and np.isfinite(jets).all()):
        raise SpecificationError(
            f"The motion has times of shape {t.shape} and jets of shape {jets.shape}.",
            f"Of each instant it has the finite jets {', '.join(model.state_names)} of this model.",
            do="Write model.structure(run), model.structure(start) or model.structure(run.t, run.jets).",
            times=t.shape,
            jets=jets.shape,
        )
    return t, jets


def _unpickled(mechanism, content, choices, parameters, paths):
    reduction = unpack(content, mechanism)
    return Model(reduction, Store(mechanism, reduction.program, *choices), parameters, paths=paths)
