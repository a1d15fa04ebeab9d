"""Derivatives of a run's signals by parameters and initial values."""

import textwrap
from collections.abc import Sequence
from dataclasses import field

import numpy as np

from servoctl.checks import named, texts
from servoctl.errors import IntegrationStopped, SpecificationError, unknown
from servoctl.markup import Shown
from servoctl.methods.choice import Bounded
from servoctl.methods.motion import breakpoints
from servoctl.methods.sizes import motion_sizes
from servoctl.model.equations import invariant_names, signal_groups
from servoctl.model.following import instant_by, moved_by, p_with_rates
from servoctl.model.switching import switching
from servoctl.run import ByName, Run, require_run
from servoctl.sensitivities.boundary import bounded_tangent
from servoctl.sensitivities.tangent import invariants_by, start_of, tangent_at, variational
from servoctl.values import Value, frozen

RTOL = 1e-11  # of a step of the variational equation
STIFF = ("Radau", "RadauIIA")  # methods of runs whose variational equation is stiff, too
DEPENDS = 1e-8  # of a column of the invariants' Jacobian: what is left after others, below which it depends on them
BESIDE_KNOT = 1e-9  # of the span: instants before and after a knot at which rates are compared
JUMPS = 1e-6  # of the rates: a larger difference there is a jump
STENCIL = 9  # samples of the polynomial by which a derivative is known between them: error of order h^9


@frozen(eq=False)
class Sensitivity(ByName, Value, Shown):
    """Derivatives of signals along a run by parameters and initial values; made by `sensitivity`.

    `s["trolley", "m_load"]` is ∂trolley/∂m_load at the samples, (N,), SI. `list`, `len` and `in` go by these pairs.

    Attributes
    ----------
    run : Run
    of, to : tuple of str
        Names of the signals, and of the parameters and initial values.
    values : dict of (str, str) to (N,) array
    independent : tuple of str
        Initial values that do not depend on others: the derivative by a parameter, or by one of them, is taken with
        the rest of them constant. Empty where the program determines the motion.
    """

    run: Run = field(repr=False)
    of: tuple
    to: tuple
    values: dict = field(repr=False)
    independent: tuple = ()

    @property
    def t(self):
        """Samples [s], (N,) array."""
        return self.run.t

    @property
    def names(self):
        """All pairs (signal, parameter or initial value)."""
        return tuple(self.values)

    def __getitem__(self, pair):
        of, to = pair if isinstance(pair, tuple) and len(pair) == 2 else (pair, None)
        return self.values[named(of, self.of, "signal"), named(to, self.to, "parameter or initial value")]

    def number(self, name: str) -> float:
        """The value of a parameter, or an initial value.

        Parameters
        ----------
        name : str
            One of `to`.
        """
        numbers, name = self.run.model.numbers, named(name, self.to, "parameter or initial value")
        return numbers[name] if name in numbers else float(start_of(self.run)[1][self.run.jet_names.index(name)])

    def change(self, name: str) -> float:
        """One percent of a number, 0.01 of its unit where that is zero: the change to which figures refer.

        Parameters
        ----------
        name : str
            One of `to`.
        """
        return 0.01 * (abs(self.number(name)) or 1.0)

    def extrema(self, of: str) -> dict[str, tuple[float, float]]:
        """Derivatives of the least and of the greatest value of a signal, refined between samples.

        Parameters
        ----------
        of : str

        Returns
        -------
        dict of str to (float, float)
            By parameter or initial value: of the minimum and of the maximum.

        Notes
        -----
        At an extremum the signal does not change with time, so that d max y/dp = ∂y/∂p there.
        """
        times = [t for t, _ in self.run.extrema(named(of, self.of, "signal"))]
        return {to: tuple(_between(self.run, self[of, to], t) for t in times) for to in self.to}

    def plot(self, ax=None, units=None):
        """Draw how each signal changes if each number grows by one percent.

        Parameters
        ----------
        ax : Axes or sequence of Axes, optional
            One for each signal; default: a new figure.
        units : dict of str to str, optional
            Units of the signals by name.

        Returns
        -------
        (n,) array of Axes
        """
        from servoctl.figures.sensitivity import draw_sensitivity

        return draw_sensitivity(self, ax, units)

    def __repr__(self):
        t = self.t
        what = f"{_counted(self.of, 'signal')} by {_counted(self.to, 'number')}"
        lines = [f"Sensitivity: {what}, t = {t[0]:g} .. {t[-1]:g} s"]
        for of in self.of[:8]:
            sizes = {to: np.nanmax(np.abs(self[of, to])) * self.change(to) for to in self.to}
            largest = sorted(sizes, key=sizes.get, reverse=True)[:3]
            shown = ", ".join(f"{to} ({_growth_in_words(self.number(to))}): {sizes[to]:.3g}" for to in largest)
            lines.append(f"  {of} changes at most with {shown}")
        if self.independent:
            lines.append(f"  constant else at the start: {', '.join(self.independent)}")
        return "\n".join(textwrap.fill(line, 118, subsequent_indent="    ") for line in lines)


def _counted(names, what):
    return f"{len(names)} {what}{'s' * (len(names) != 1)}"


def _growth_in_words(number):
    return "1 %" if number else "0.01"


def sensitivity(run: Run, of: str | Sequence[str] | None = None, to: str | Sequence[str] | None = None) -> Sensitivity:
    """Derivatives of a run's signals by parameters and initial values, without differences.

    Where the program determines the motion they follow from the implicit function theorem at each sample, otherwise
    from the variational equation along the run; for bounded motions from its boundary value problem.

    Parameters
    ----------
    run : Run
    of : str or sequence of str, optional
        Names of signals: coordinates, their derivatives up to γ^(s̄), actuation, outputs, multipliers. Default: the
        actuation, or the reaction of an ideal program.
    to : str or sequence of str, optional
        Names of parameters, and of coordinates and velocities for their initial values. Default: all parameters.

    Returns
    -------
    Sensitivity

    Raises
    ------
    NameUnknown
        For a name that the run does not have.
    SpecificationError
        If the run has no model, an initial value follows from the others, or the motion crosses kinks or switches of
        the state.
    IntegrationStopped
        If the variational equation cannot be integrated along the run.

    Notes
    -----
    Initial values that the constraints determine change with the others. Those that `model.start` held are constant
    where they are not differentiated by.
    """
    model = require_run(run, "sensitivity")
    _require_smooth(model)
    default = [name for name, kind in signal_groups(model.reduction).items() if kind in ("actuation", "reaction")]
    of = tuple(dict.fromkeys(default if of is None else texts(of, "The names of signals")))
    to = tuple(dict.fromkeys(list(model.numbers) if to is None else texts(to, "The names of parameters")))
    known = (*model.jet_names, *signal_groups(model.reduction))
    if not of or not to:
        raise SpecificationError(
            f"The derivatives are of {len(of)} signals by {len(to)} numbers.",
            "They are of at least one signal by at least one parameter or initial value.",
            do=f"Name {'initial values' if of else 'signals'}, such as {(model.state_names if of else known)[0]!r}.",
            of=of,
            to=to,
        )
    for name in of:
        named(name, known, "signal")
    initial = tuple(name for name in to if name not in model.numbers)
    for name in initial:
        if name not in model.state_names:
            raise unknown(name, (*model.numbers, *model.state_names), "parameter or initial value")
    names = tuple(name for name in to if name in model.numbers)
    kinds = tuple(dict.fromkeys(signal_groups(model.reduction)[name] for name in of if name not in model.jet_names))
    S, independent = _of_state(model, run, names, initial)
    rows = dict(zip(_rows(model, kinds), _tangents(run, S, names, initial, kinds), strict=True))
    columns = (*names, *initial)
    values = {(a, b): rows[a][columns.index(b)] for a in of for b in to}
    return Sensitivity(run, of, to, values, independent)


def _require_smooth(model):
    """Refuse a motion with switches of the state."""
    if switching(model) is not None:
        raise SpecificationError(
            "The motion has kinks or switches of the state.",
            "Derivatives are those along one smooth motion of the model.",
            do="Smooth the switch, such as tanh(v/v0) for sign(v).",
        )


def _rows(model, kinds):
    """Names of the rows of a tangent: jets, then the signals of each group."""
    return [*model.jet_names, *(name for kind in kinds for name in model.signals(kind)[0])]


def _tangents(run, S, names, initial, kinds):
    """Tangents (rows, K, N) of jets and signals at the samples, from those S (n_x, K, N) of the state."""
    parts, K = [], len(names) + len(initial)
    for first, end, model in run.variants or ((0, len(run.t), run.model),):
        moved, t = moved_by(model, names), run.t[first:end]
        f, p = tangent_at(model, names, moved, len(initial), kinds), p_with_rates(model, moved)
        of_state = S[:, :, first:end].swapaxes(0, 1).reshape(-1, len(t))
        y = f.grid(t, np.concatenate([run.jets[: len(model.jet_names), first:end], of_state]), p)
        sizes = [len(model.jet_names), *(len(model.signals(kind)[0]) for kind in kinds)]
        blocks = zip(np.split(y, np.cumsum(sizes[:-1]) * K), sizes, strict=True)
        parts.append(np.concatenate([block.reshape(K, size, -1).swapaxes(0, 1) for block, size in blocks]))
    return np.concatenate(parts, axis=2)


def _of_state(model, run, names, initial):
    """The tangent (n_x, K, N) of the state along a run, without rows where the program determines it.

    Returns with it the names of the initial values that do not depend on others.
    """
    if not model.flat and run.method != str(Bounded()):
        S, independent = _tangent_at_start(run, names, initial)
        return _integrated(model, run, names, S), independent
    _require_free(model, initial, ())
    return np.zeros((0, len(names), len(run.t))) if model.flat else bounded_tangent(model, run, names), ()


# --- programs that leave something to integrate -----------------------------------------------------------------------


def _tangent_at_start(run, names, initial):
    """The tangent (n_x, K) of the first state, and the names of the initial values that do not depend on others."""
    model = run.variant(0)
    t, x = start_of(run)
    m, n_x = len(invariant_names(model)), len(x)
    moved = moved_by(model, names)
    y = invariants_by(model, names, moved)(t, x, p_with_rates(model, moved))
    G = y[m:].reshape(n_x + len(names), m).T
    G, by_parameters = G[:, :n_x], G[:, n_x:]
    held = run.start.held if run.start is not None else ()
    rank = {name: 2 if name in initial else int(name in held) for name in model.state_names}
    dependent = _dependent(G, [rank[name] for name in model.state_names])
    free = np.setdiff1d(np.arange(n_x), dependent)
    independent = tuple(model.state_names[i] for i in free)
    _require_free(model, initial, independent)
    S = np.zeros((n_x, len(names) + len(initial)))
    for k, name in enumerate(initial):
        S[model.state_names.index(name), len(names) + k] = 1.0
    right = -np.column_stack([by_parameters, G @ S[:, len(names) :]])
    S[dependent] = np.linalg.solve(G[:, dependent], right) if m else 0.0
    return S, independent


def _dependent(G, ranks):
    """Indices (m,) of the entries that the Jacobian G (m, n_x) of the invariants determines, of low rank first."""
    from scipy.linalg import qr

    size = np.linalg.norm(G, axis=1, keepdims=True)
    rest, ranks, chosen = G / np.where(size > 0, size, 1.0), np.array(ranks), []
    original = np.linalg.norm(rest, axis=0)
    for rank in np.unique(ranks) if len(G) else ():
        columns = np.flatnonzero(ranks == rank)
        Q, R, order = qr(rest[:, columns], mode="economic", pivoting=True)
        columns = columns[order[: len(R)]]
        independent = np.abs(np.diag(R)) > DEPENDS * original[columns]
        chosen += columns[independent].tolist()
        rest = rest - Q[:, independent] @ (Q[:, independent].T @ rest)
    return np.sort(chosen).astype(int)


def _require_free(model, initial, independent):
    """Refuse initial values that follow from others."""
    for name in initial:
        if name not in independent:
            raise SpecificationError(
                f"The derivative by the initial value of {name!r} was named.",
                f"{len(independent)} initial values of this motion are free, the others follow from its constraints.",
                do=f"Name others, such as {', '.join(independent)}." if independent else "Name parameters.",
                name=name,
                free=independent,
            )


def _integrated(model, run, names, S):
    """The tangent (n_x, K, N) of the state at the samples of a run, from its start S (n_x, K) on."""
    from scipy.integrate import solve_ivp

    (n_x, K), (t, x) = S.shape, start_of(run)
    method = "Radau" if run.method in STIFF else "DOP853"
    y, result = np.concatenate([x, S.T.ravel()]), np.repeat(S[:, :, None], len(run.t), axis=2)
    atol = _absolute(model, run, names, S)
    cuts = breakpoints((t, float(run.t[-1])), run.knots) if run.t[-1] != t else []
    forward = np.sign(run.t[-1] - t)
    for k, (a, b) in enumerate(zip(cuts[:-1], cuts[1:], strict=True)):
        if k:
            y[n_x:] += _shifted(model, run, names, a, y[:n_x], K).T.ravel()
        variant = _variant_at(run, a, b)
        moved = moved_by(variant, names)
        f, p = variational(variant, names, moved, K - len(names)), p_with_rates(variant, moved)
        inside = np.flatnonzero((forward * run.t >= forward * a) & (forward * run.t <= forward * b))
        solved = solve_ivp(
            lambda t, z, f=f, p=p: f(t, z, p),
            (a, b),
            y,
            method,
            dense_output=True,
            rtol=RTOL,
            atol=atol,
        )
        if solved.status:
            raise _ended(float(solved.t[-1]), solved.message)
        if len(inside):
            result[:, :, inside] = solved.sol(run.t[inside])[n_x:].reshape(K, n_x, -1).swapaxes(0, 1)
        y = solved.y[:, -1].copy()
    return result


def _variant_at(run, a, b):
    """The variant of the model in the middle of a piece."""
    return run.variant(int(np.argmin(np.abs(run.t - (a + b) / 2))))


def _absolute(model, run, names, S):
    """Absolute tolerances of the state and of its tangent, from the sizes of the motion and of the numbers."""
    t, x = start_of(run)
    sizes = motion_sizes(model, np.append(t, run.t), np.column_stack([x, run.jets[: len(S)]]))
    sizes = np.where(sizes > 0, sizes, 1.0)
    numbers = [abs(model.numbers[name]) or 1.0 for name in names]
    initial = [sizes[np.argmax(column != 0)] for column in S.T[len(names) :]]
    return RTOL * np.concatenate([sizes, *(sizes / number for number in [*numbers, *initial])])


def _ended(t, why):
    return IntegrationStopped(
        f"The variational equation could not be integrated beyond t = {t:.6g} s: {why.rstrip('.')}.",
        "Derivatives follow the motion from its start.",
        do="Check whether the run ends near a singularity there, or take a shorter one.",
        t=t,
    )


def _shifted(model, run, names, t, x, columns):
    """The jump (n_x, K) of the tangent at a knot t that moves with parameters, where the rates jump."""
    first = start_of(run)[0]
    length, f = abs(run.t[-1] - first), model.function("ode")
    sides = [f(t + side * BESIDE_KNOT * length, x, model.p)[: len(x)] for side in (-1.0, 1.0)]
    before, after = sides if run.t[-1] > first else sides[::-1]
    jump = np.zeros((len(x), columns))
    if np.abs(after - before).max() > JUMPS * np.abs(sides).max():
        for j, name in enumerate(names):
            jump[:, j] = (before - after) * (instant_by(model, name, t) or 0.0)
    return jump


# --- between samples --------------------------------------------------------------------------------------------------


def _between(run, values, t):
    """A signal (N,) at t [s], by the polynomial through the samples around it between two knots."""
    low = max((knot for knot in run.knots if knot <= t), default=-np.inf)
    high = min((knot for knot in run.knots if knot >= t), default=np.inf)
    inside = np.flatnonzero((run.t >= low) & (run.t <= high) & np.isfinite(values))
    window = inside[np.argsort(np.abs(run.t[inside] - t))[:STENCIL]]
    if len(window) < 2:
        return float(values[window[0]]) if len(window) else float("nan")
    s = (run.t[window] - t) / np.ptp(run.t[window])
    return float(np.polynomial.Polynomial.fit(s, values[window], len(s) - 1, domain=[-1, 1])(0.0))
