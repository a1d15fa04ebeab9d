"""The model: a reduction as functions on numbers, built at their first use."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np

from servoctl.checks import MOST_JETS, as_numbers, by_name, finite, named, whole
from servoctl.codegen.function import Compiled, compiled
from servoctl.errors import ServoError, SingularProgram, SpecificationError
from servoctl.jets.series import Flow
from servoctl.jets.tape import REAL
from servoctl.markup import Detailed
from servoctl.model import saddle
from servoctl.model.equations import (
    EQUATIONS,
    SIGNALS,
    Equations,
    gradient_jets,
    leading_names,
    monitored_rows,
    residual_rows,
)
from servoctl.model.report import describe, warn_of_products
from servoctl.model.rest import started
from servoctl.model.start import State
from servoctl.model.store import Store, pack, unpack
from servoctl.model.validity import affirmed, points_with
from servoctl.progress import stage
from servoctl.reduction.appell import require_positive
from servoctl.reduction.definite import Definite, definite
from servoctl.reduction.idle import names_of, needed
from servoctl.reduction.knots import require_smooth
from servoctl.reduction.manifold import ON_MANIFOLD, solve
from servoctl.reduction.reduce import holds, reduce, require_parts, strong
from servoctl.reduction.structure import structure
from servoctl.spec.mechanism import Mechanism
from servoctl.spec.program import Program
from servoctl.tolerances import ENTRY, RESOLVED
from servoctl.values import evenly, read_only

SAMPLED = 50  # samples of a run at which its structure is decided; each takes tens of milliseconds
AS_DERIVED = "as derived"  # a model with the parameters at which its ranks were decided
STRONG = 0.1  # of its usual size: pivots above this serve for other parameters, or again
DIAGONAL = "diagonal"  # pivots of definite matrices, beside places of other pivots
MOST_VARIANTS = 8  # of a model that it holds: motions from one start meet the same ones again


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
        For constraints that depend on or contradict each other, an unknown symbol, a path that is not smooth
        enough, a singular mass matrix.
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
    return _derived(mechanism, program, guess)


@stage("deriving")
def _derived(*specification):
    """The model of the arguments of `reduce`; its reduction is read from disk if another process has written it."""
    store = Store(*specification)
    return Model(store.reduction(reduce), store)


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
    state_names : tuple of str
        Names of the state X = (q, γ', ..., γ^(s̄-1)).
    jet_names : tuple of str
        Names of the jets Z = (X, γ^(s̄)).
    """

    def __init__(self, reduction, store, values=None, knots=None, functions=None, variants=None):
        q = reduction.mechanism.q
        self.reduction, self._store = reduction, store
        self.parameters = read_only(reduction.context.values.copy() if values is None else values)
        self._knots = reduction.knots if knots is None else knots
        self.state_names = tuple(name for k in range(reduction.top) for name in q.jet_names(k))
        self.jet_names = (*self.state_names, *q.jet_names(reduction.top))
        # Models that differ only in numbers share their functions.
        self._functions = {} if functions is None else functions
        self._knots_within = {}  # by time span
        self._variants = {None: self} if variants is None else variants  # with other pivots: one set for all of them

    def __eq__(self, other):
        if not isinstance(other, Model):
            return NotImplemented
        known = self._store.fingerprint is not None and self._store.fingerprint == other._store.fingerprint
        same = known and self.place == other.place
        return self is other or (same and np.array_equal(self.parameters, other.parameters))

    def __hash__(self):
        return hash(self._store.fingerprint)

    def __reduce__(self):
        mechanism, _, *choices = self._store.specification
        return _unpickled, (mechanism, pack(self.reduction), choices, self.parameters, self._knots)

    def names_to(self, size):
        """Names of the first `size` jets, beyond γ^(s̄) if necessary."""
        if size <= len(self.jet_names):
            return self.jet_names[:size]
        q, names, k = self.reduction.mechanism.q, list(self.jet_names), self.reduction.top
        while len(names) < size:
            k += 1
            names += q.jet_names(k)
        return tuple(names[:size])

    def including(self, names: Iterable[str]) -> "Model":
        """The model with those coordinates among names of signals that play no part in the program; itself without any.

        Parameters
        ----------
        names : iterable of str
            Coordinates and their derivatives; other names are ignored.

        Returns
        -------
        Model
        """
        r = self.reduction
        if r.mechanism.whole is None:
            return self
        wider = needed(r.mechanism.whole, r.program, self.coordinate_names, names)
        if wider.q.names == self.coordinate_names:
            return self
        return derived(wider, r.program, self._store.specification[2]).with_parameters(**self.numbers)

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
            For a value that is not finite, makes a mass negative, or makes a path less smooth than required.
        """
        r = self.reduction
        current = self.numbers
        changes = by_name(changes, current, "parameter", "The parameters")
        values = r.mechanism.parameters.values({**current, **changes})
        if not affirmed(self, values):
            require_positive(r.mechanism, replace(r.points, values=values))
            if not self._holds(values):
                self._store.require_unchanged()
                return _derived(r.mechanism, r.program, r.context.guess, None, values)
        return Model(r, self._store, values, require_smooth(r.switches, values, r.smoothness), self._functions)

    def _holds(self, values):
        """Whether every decision of the derivation is the same with other parameters."""
        return holds(self.reduction, values) and self._constant_pivots_hold(values)

    def _constant_pivots_hold(self, values):
        f = self.once("constant pivots", lambda: self.equations.constant_pivots())
        return bool(strong(*(f(p).full() for p in (values, self.reduction.context.values))).all())

    def near(self, t, jets, sizes=()):
        """The model of the same specification, derived with pivots chosen at an instant of the motion.

        Parameters
        ----------
        t : float
            [s]
        jets : (n_z,) array
        sizes : dict of str to float, optional
            Sizes relative to which jets are near zero; default, also in place of rounding: their sizes where ranks were
            decided, at most 1.

        Returns
        -------
        Model
        """
        jets = np.asarray(jets, dtype=float) + 0.0  # without the sign of a zero
        default = self.once("jet sizes", lambda: self.equations.jet_sizes)
        self._store.require_unchanged()
        sizes = {name: size for name, size in dict(sizes).items() if size > ENTRY * default.get(name, 0.0)}
        place = (float(t), dict(zip(self.jet_names, jets.tolist(), strict=True)), default | sizes)
        key = repr(place)
        if key in self._variants:
            return self._variants[key]
        near = self._near_before(t, jets, sizes) or self._derived_near(place)
        if near.free != self.free:
            raise SpecificationError(
                f"Near t = {t:.6g} s the program has {near.free} free initial values, elsewhere {self.free}.",
                "The number of free initial values is the same along a motion.",
                do="Derive two models, one for each regime.",
                t=float(t),
                free=near.free,
                expected=self.free,
            )
        numbers = self.parameters, self._knots, near._functions, self._variants
        self._keep(key, Model(near.reduction, near._store, *numbers))
        return self._variants[key]

    def there(self, t, jets):
        """The model, or where its pivots vanish the one with pivots chosen there, if any.

        Parameters
        ----------
        t : float
            [s]
        jets : (n_z,) array

        Returns
        -------
        Model
        """
        try:
            return self if self.strength(t, jets) > RESOLVED else self.near(t, jets)
        except ServoError:
            return self

    def _derived_near(self, place):
        r = self.reduction
        guess = None if r.context.scales is None else self._store.specification[2] or {}
        return _derived(r.mechanism, r.program, guess, place, self.parameters)

    def _near_before(self, t, jets, sizes):
        """The variant near an instant with the parameters of the derivation, if it serves with these; else None."""
        r = self.reduction
        same = np.array_equal(self.parameters, r.context.values)
        own = self if same else Model(r, self._store, functions=self._functions)
        first = self._functions.setdefault(AS_DERIVED, own)
        if first is self:
            return None
        try:
            near = first.near(t, jets, sizes)
        except ServoError:
            return None
        here = Model(near.reduction, near._store, self.parameters, self._knots, near._functions)
        serves = here.strength(t, jets) > STRONG and (same or near._holds(self.parameters))
        return here if serves else None

    @property
    def without_choice(self):
        """The model with diagonal entries of definite matrices as pivots (`reduction.definite`); None without such."""
        first = self._variants[None]
        applies = not (self.diagonal or first.flat) and saddle.applies(first.reduction)
        return first._formed(DIAGONAL) if applies else None

    def reordered(self, t, jets):
        """The model with the same rows, and pivots of their leading matrix chosen at an instant.

        Parameters
        ----------
        t : float
            [s]
        jets : (n_z,) array

        Returns
        -------
        Model or None
            None if the pivots stay, or are not those of the leading matrix.
        """
        r = self.reduction
        if self.diagonal or self.equations.sparse or (r.cascade is None and self.flat and self.nq != self.n):
            return None
        try:
            order = r.order_at(float(t), np.asarray(jets, dtype=float), self.parameters)
        except SingularProgram:
            return None
        return None if order == r.order else self._formed(order)

    def _formed(self, form):
        """The model with the same rows, and pivots by their places, or from the diagonal; None without the latter."""
        key, r = repr((*(self._store.specification[3] or ()), form)), self.reduction
        if key not in self._variants:
            reduction = definite(r) if form == DIAGONAL else r.with_order(form)
            store, functions = self._store.part(form), self._functions.setdefault(str(form), {})
            made = reduction and Model(reduction, store, self.parameters, self._knots, functions, self._variants)
            self._keep(key, made)
        return self._variants[key]

    def _keep(self, key, variant):
        """Hold a variant, in place of the oldest one where there are too many."""
        if len(self._variants) > MOST_VARIANTS:
            del self._variants[next(known for known in self._variants if known is not None)]
        self._variants[key] = variant

    @property
    def diagonal(self):
        """Whether pivots are diagonal entries of definite matrices."""
        return isinstance(self.reduction.realisation, Definite)

    @property
    def place(self):
        """How pivots were chosen: (t, jets, sizes) of `near`, then their places or `DIAGONAL`; None as by `derive`."""
        form = DIAGONAL if self.diagonal else self.reduction.order
        near = self._store.specification[3] or ()
        return (*near, form) if form else near or None

    def at(self, place):
        """The variant of a `place`; this model if that is None."""
        place = place or ()
        near, form = place[:3] if len(place) > 1 else (), place[-1] if len(place) % 3 == 1 else None
        model = self
        if near:
            t, jets, sizes = near
            model = self.near(t, [jets[name] for name in self.jet_names], sizes)
        if form is None:
            return model
        return model._formed(form if form == DIAGONAL else tuple((i, j) for i, j in form))

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

    @property
    def n(self):
        """The number of quasi-velocities."""
        return self.reduction.mechanism.q.n

    @property
    def nq(self):
        """The number of coordinates."""
        return self.reduction.mechanism.q.nq

    @property
    def coordinate_names(self):
        """Names of the coordinates."""
        return self.reduction.mechanism.q.names

    @property
    def left_out(self):
        """Names of the mechanism's coordinates that play no part in the program."""
        return self.reduction.mechanism.left_out.get("coordinate", ())

    @property
    def actuators(self):
        """Names of the mechanism's actuators, or of the inputs that drive it."""
        return self.reduction.mechanism.actuators or self.reduction.mechanism.inputs

    @property
    def ideal(self):
        """Whether an ideal reaction realises the program, instead of the actuators."""
        return self.reduction.program.by == "ideal"

    @property
    def outputs(self):
        """Names of the mechanism's outputs."""
        mechanism = self.reduction.mechanism
        return tuple(name for name in mechanism.outputs if name not in mechanism.inputs)

    @property
    def residual_names(self):
        """Names of the rows whose residuals a run reports."""
        mechanism = self.reduction.mechanism
        return (*residual_rows(self.reduction), *mechanism.reported, *mechanism.q.invariants)

    @property
    def knots(self):
        """Instants [s] at which paths switch between smooth pieces."""
        return self._knots.times

    def require_smooth(self, span):
        """Knots of the paths within a time span; SpecificationError if a path is not smooth enough there.

        Of a spline of many pieces they are those between the first and the last that are inspected; the others, at
        which series end, are `ends_of_pieces`.
        """
        r = self.reduction
        if r.timed and span not in self._knots_within:

            def build():
                return require_smooth(r.switches, self.parameters, r.smoothness, span).times

            # The entries of the store belong to the numbers of the specification.
            stored = np.array_equal(self.parameters, r.context.values)
            self._knots_within[span] = self._store.recall(f"knots {span}", build) if stored else build()
        return self._knots_within.get(span, ())

    def ends_of_pieces(self, span):
        """Instants (N,) within a time span between which splines of many pieces are polynomials."""
        return self.reduction.switches.ends_of_pieces(self.parameters, span)

    @property
    def raised(self):
        """How often each row is differentiated to the common order s̄, {row name: ρ}: the number of its poles."""
        return {row.name: self.reduction.top - row.order for row in self.reduction.rows}

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
            self._functions[name] = self._store.recall(name, build)
        return self._functions[name]

    def function(self, name):
        """One of the model's compiled functions of (t, x, p), built at first use.

        Parameters
        ----------
        name : str
            "ode", "ode_projected", "ode_poles", "ode_jacobian", "ode_poles_jacobian", "path", "invariants",
            "matrices", "balanced", or "accelerations".

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

    @cached_property
    def signal_groups(self):
        """The group of each signal that is no jet, {signal name: key of `SIGNALS`}."""
        mechanism, program = self.reduction.mechanism, self.reduction.program
        names = mechanism.q.force_names
        groups = dict.fromkeys(mechanism.outputs, "outputs") | dict.fromkeys(mechanism.inputs, "given_inputs")
        groups |= {"energy": "energy"}
        if program.by == "actuators":
            groups = dict.fromkeys(mechanism.actuators, "actuation") | groups
        else:
            groups |= dict.fromkeys((f"reaction_{name}" for name in names), "reaction")
            groups |= dict.fromkeys((f"multiplier_{name}" for name in program.residuals), "multipliers")
        groups |= dict.fromkeys((f"multiplier_{name}" for name in mechanism.constraints), "multipliers")
        if not mechanism.q.plain:
            rates = (f"{d}{name}" for d in ("d", "d2") for name in mechanism.q.names)
            groups |= dict.fromkeys(rates, "coordinate_rates")
        return groups

    def with_highest(self, t, states, p=None):
        """The jets of a motion from its states: with the derivatives that the model determines.

        Parameters
        ----------
        t : (N,) array
            [s]
        states : (n_x, N) array
        p : (n_p,) or (n_p, N) array, optional
            Parameters; default: those of the model.

        Returns
        -------
        (n_z, N) array
        """
        (n_x, n), p = (len(self.state_names), self.n), self.parameters if p is None else p
        if not self.flat:
            return np.concatenate([states, self.function("ode").grid(t, states, p)[n_x - n : n_x]])
        first = self.nq if self.reduction.mechanism.q.plain else 3 * self.nq
        return np.concatenate([states, self.function("path").grid(t, states[: self.nq], p)[first + n : first + 2 * n]])

    def extended(self, t, jets, size):
        """Jets of a motion beyond those known, from derivatives of its rows (`reduction.manifold.solve`).

        Parameters
        ----------
        t : (N,) array
            [s]
        jets : (n, N) array
            At least the state.
        size : int
            Number of the jets.

        Returns
        -------
        (size, N) array
            NaN where the rows do not determine them.
        """
        r, q = self.reduction, self.reduction.mechanism.q
        level = (size - q.nq) // q.n
        scale = np.repeat([1.0, *(factorial(k) for k in range(1, level + 1))], [q.nq, *level * [q.n]])[:, None]
        z = np.zeros((size, len(t)), dtype=REAL)
        z[: len(jets)] = jets / scale[: len(jets)]
        points = replace(r.points, t=np.asarray(t), z=z, values=self.parameters, residual=np.zeros(len(t)))
        if r.cascade is not None:
            deeper, good = r.cascade.continued(points, level, r.top - 1)
            solved = deeper[:size]
        else:
            solved, residual = solve(Flow(q, r.rows, level, points), t, z)
            good = residual < ON_MANIFOLD
        result = np.where(good, (solved * scale).astype(float), np.nan)
        result[: len(jets)] = jets
        return result

    def invariant_names(self):
        """(level, name) of each invariant of the state, in the order of the function "invariants"."""
        return self.once("invariant names", lambda: [(level, name) for level, name, _ in self.equations.invariant_rows])

    @cached_property
    def row_pivots(self):
        """Names of the pivots by which the rows divide, and which depend on the motion; those of L come after them."""
        rows = {name for name, _ in self.reduction.pivots}
        return self.once("row pivots", lambda: [name for name, _ in self.equations.pivots if name in rows])

    def pivots_at(self, t, jets):
        """Pivots at an instant, (n_g,) array.

        Parameters
        ----------
        t : float
            [s]
        jets : (n_z,) array
        """
        here = self.reduction.points.at(np.array([t]), jets[:, None], self.parameters)
        return here.evaluate([pivot for _, pivot in self.equations.pivots])[0][:, 0].astype(float)

    def strength(self, t, jets):
        """The smallest pivot at an instant, relative to its size where pivots were chosen; 0 if one has no value.

        Parameters
        ----------
        t : float
            [s]
        jets : (n_z,) array
        """
        pivots, sizes = np.abs(self.pivots_at(t, jets)), self.pivot_sizes
        relative = pivots / np.where(sizes > 0, sizes, 1.0)
        return float(np.nan_to_num(relative, nan=0.0, posinf=0.0).min(initial=1.0))

    @cached_property
    def rank_points(self):
        """States (n_x, points) at which ranks were decided, with the model's own parameters."""
        return points_with(self)

    @cached_property
    def pivot_sizes(self):
        """Largest size of each pivot at the points where the pivots were chosen, (n_g,) array."""
        return self.once("pivot sizes", lambda: self.equations.pivot_sizes)

    @cached_property
    def active_states(self):
        """Which states (n_x,) the rates or the invariants depend on: errors in the others stay as they are."""

        def build():
            parts = (self.function(name).expression.jac_sparsity(0, 1) for name in ("ode", "invariants"))
            rates, invariants = (np.array(ca.DM.ones(part)) for part in parts)
            return np.concatenate([rates[: len(self.state_names)], invariants]).any(axis=0)

        return self.once("active states", build)

    @cached_property
    def column_sizes(self):
        """Column sizes (n,) (see `ranks.column_sizes`) of L and of Bᵀ at the points where ranks were decided."""
        return self.once("column sizes", lambda: self.equations.column_sizes)

    def row_stories(self):
        """How each row was derived, by name; "" for rows of the specification."""
        return {row.name: row.story for row in self.reduction.rows}

    def balances(self):
        """The coordinate or quasi-velocity, by index, of each row of L that is a row TᵀM of (3.18), by index."""
        q = self.reduction.mechanism.q
        names = [f"balance of {name}" for name in q.force_names]
        rows = enumerate(monitored_rows(self.reduction))
        return {a: names.index(row.name) for a, row in rows if row.name in names and row.order == 2 and not row.story}

    def leading_names(self):
        """Names of the rows of L and of Bᵀ, whose ranks must not change."""
        return leading_names(self.reduction)

    def gradient_jets(self, row):
        """Names of the jets on which a row's leading gradient depends."""
        return gradient_jets(self.reduction, row)

    def operations(self):
        """Number of operations of each function built so far, by name."""
        signals = {value[1].name: value[1] for value in self._functions.values() if isinstance(value, tuple)}
        return {name: f.operations for name, f in (self._functions | signals).items() if isinstance(f, Compiled)}

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
        model = self.including([*names_of(held), *names_of(guess)])
        return started(model, finite("t", t, "time"), held, guess, hold)

    def default_start(self, t=0.0):
        """The start near the guess that `derive` received, without held values; errors as by `start`.

        Parameters
        ----------
        t : float
            [s]

        Returns
        -------
        State
        """
        guess = self._store.specification[2] or {}
        return self.start(t, {name: value for name, value in guess.items() if name in self.state_names})

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
        model = self.including(names_of(motion))
        t, jets = _samples(model, motion, jets)
        return structure(model.reduction, t, jets, model.parameters)

    def _default_start(self):
        """The time and the values of the start without held or guessed values; None if there is none."""
        with suppress(ServoError):
            start = self.default_start()
            return start.t, start.values

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
    fits = t.ndim == 1 and len(t) and jets.shape == (count, len(t)) and names[:count] == model.names_to(count)
    if not (fits and count >= len(model.state_names) and np.isfinite(t).all() and np.isfinite(jets).all()):
        raise SpecificationError(
            f"The motion has times of shape {t.shape} and jets of shape {jets.shape}.",
            f"Of each instant it has the finite jets {', '.join(model.state_names)} of this model.",
            do="Write model.structure(run), model.structure(start) or model.structure(run.t, run.jets).",
            times=t.shape,
            jets=jets.shape,
        )
    return t, jets


def _unpickled(mechanism, content, choices, parameters, knots):
    reduction = unpack(content, mechanism)
    store = Store(mechanism, reduction.program, *choices)
    model = Model(reduction, store, parameters, knots)
    form = DIAGONAL if model.diagonal else reduction.order
    return Model(reduction, store.part(form), parameters, knots) if form else model
