"""Instants at which paths switch, and the smoothness of residuals there, from the expressions themselves."""

from copy import copy
from functools import cached_property
from math import factorial

import casadi as ca
import numpy as np

from servoctl.errors import SpecificationError
from servoctl.jets.lookup import Lookup
from servoctl.jets.pieces import FEWEST, by_pieces
from servoctl.jets.series import Series
from servoctl.jets.tape import Tape
from servoctl.values import evenly, frozen

MOST_BRANCHES = 24  # affine pieces that are followed through one operation
SCAN = 801  # instants of a scan for switches that are not affine in t
PARTS, DIVISIONS = 1024, 6  # of an interval of the scan, whose signs are evaluated at once: all digits of a double
INSPECTED = 9  # knots of a table, with their neighbours, whose class is inspected: a spline has the same at each
BISECTIONS = 60  # of an interval of the scan, for all knots of a table at once: more than a double has digits
KNOWN = 8  # sets of numbers whose knots are remembered
SAME_INSTANT = 1e-9  # switches closer than this fraction of the time from first to last are one
NEAR_ZERO = 0.5  # of the values beside it: a parabola's least value below this is looked at closely
WIDE, NARROW = 1e-4, 1e-7  # distances of far and close series from an instant, relative to its neighbourhood
JUMP = 1e-6  # jumps below this fraction of the largest value of a derivative nearby are rounding errors
BY_ROUNDING = 1e-12  # of the values: what differs by no more within a neighbourhood is rounding, as of splines
STAYS = 0.5  # a jump keeps more than this fraction of its size from far to close series; other differences shrink
AROUND = np.delete(np.linspace(-1.0, 1.0, 41), 20)  # places in the neighbourhood for the size of a derivative
EXTRA = 4  # additional coefficients for shifting series to the instant itself
ALONE = 0.5  # s, the neighbourhood of a single switch


@frozen
class Knots:
    """Instants at which residuals switch between smooth pieces."""

    times: tuple  # ascending [s]
    classes: dict  # for each residual a list of (instant, k): it is not smooth there, but of class C^k


class Switches:
    """The switches in residuals that depend on t and parameters alone.

    Residuals without such switches are left out. `timed` are the sides of each switch, (int, int or None), as nodes of
    the tape; they are searched by default.
    """

    def __init__(self, q, residuals, parameters, timed=None):
        self.q, self._symbols, self._known = q, parameters, {}
        self.parameters = [p.element_hash() for p in parameters]
        self._read(residuals)
        self.timed = timed
        if timed is None:
            self.timed = self._timed() if any(s.element_hash() == q.t.element_hash() for s in self.symbols) else []
            self._read({name: residuals[name] for name in self._switching()})
            self.timed = self._timed() if self.timed else []

    def __reduce__(self):
        return Switches, (self.q, self.residuals, self._symbols, self.timed)

    def _read(self, residuals):
        self.residuals, self.symbols = residuals, ca.symvar(ca.vertcat(ca.SX(0, 1), *residuals.values()))
        self.__dict__.pop("tape", None)

    def _switching(self):
        """Names of the residuals that contain a switch in t."""
        if not self.timed:
            return []
        sides, reached = set(self.timed), []
        for i, (_, args, data) in enumerate(self.tape.nodes):
            other = i if isinstance(data, Lookup) else args[1] if len(args) > 1 else None
            switch = args and (args[0], other) in sides
            reached.append(bool(switch) or any(reached[a] for a in args))
        return [name for name, node in zip(self.residuals, self.tape.outputs, strict=True) if reached[node]]

    @cached_property
    def numbers(self):
        """Indices of the parameters on which the residuals depend."""
        return [self.parameters.index(h) for h in (s.element_hash() for s in self.symbols) if h in self.parameters]

    def knots(self, values, needs, span=None):
        """The switching instants and the classes there; see `times` and `classes`.

        Those of the last few numbers in the residuals are known.
        """
        key = *values[self.numbers].tolist(), frozenset(needs.items())
        for known in ((*key, "any span"), (*key, span)):
            if known in self._known:
                return self._known[known]
        instants, others = self._affine(values)
        times = self._times(values, instants, others, span)
        knots = Knots(tuple(times), self.classes(values, needs, times))
        self._known[(*key, span if others else "any span")] = knots
        if len(self._known) > KNOWN:
            self._known.pop(next(iter(self._known)), None)
        return knots

    @cached_property
    def tape(self):
        """The tape of the residuals."""
        return Tape(self.symbols, list(self.residuals.values()))

    @cached_property
    def _numeric_tape(self):
        """The tape, for numbers, without the sums over the pieces of splines."""
        if sum(node[::2] == ("constant", "le") for node in self.tape.nodes) < FEWEST:
            return self.tape
        tape = copy(self.tape)
        tape.nodes = by_pieces(tape, (i for sides in self.timed for i in sides if i is not None))
        return tape

    def _timed(self):
        """The sides of switches that depend on t and not on jets."""
        depends = []
        for node in self.tape.nodes:
            if node.kind == "input":
                place = self.q.where(self.symbols[node.data])
                depends.append({"p" if place is None else "t" if place[0] == "t" else "jets"})
            else:
                depends.append(set().union(*(depends[a] for a in node.args)) if node.args else set())
        tables = ((node.args[0], i) for i, node in enumerate(self.tape.nodes) if _counts(node))
        switches = [*self.tape.switches, *tables]
        sides = ((a, b, depends[a] | (depends[b] if b is not None else set())) for a, b in switches)
        return [(a, b) for a, b, both in sides if "t" in both and "jets" not in both]

    def __bool__(self):
        return bool(self.timed)

    def times(self, values, span=None):
        """Instants at which a switch changes sides, ascending, for parameters `values` (n_p,).

        A span (t0, t1) is scanned for switches that are not affine in t, and so is the time between those that are.
        """
        return self._times(values, *self._affine(values), span)

    def _affine(self, values):
        """Instants of switches whose sides are affine in t (a set), and the sides of the others (a list)."""
        pieces = []
        for node in self.tape.nodes if self.timed else ():
            pieces.append(self._pieces(node, pieces, values))
        instants, others = set(), []
        for a, b in self.timed:
            if self._is_table(b) and pieces[a] is not None:
                instants |= {*_of_affine(pieces[a], _some(self.tape.nodes[b].data.numbers)).tolist()}
                continue
            first, second = pieces[a], pieces[b] if b is not None else ((0.0, 0.0),)
            if first is None or second is None:
                others.append((a, b))
                continue
            instants |= {(d0 - c0) / (c1 - d1) for c0, c1 in first for d0, d1 in second if c1 != d1}
        return instants, others

    def ends_of_pieces(self, values, span):
        """Ascending instants within a span at which the coefficients from tables change, an array."""
        tables = [(a, b) for a, b in self.timed if self._is_table(b)]
        if not tables:
            return np.empty(0)
        pieces, instants = [], []
        for node in self.tape.nodes:
            pieces.append(self._pieces(node, pieces, values))
        for a, b in tables:
            knots, affine = self.tape.nodes[b].data.numbers, pieces[a] is not None
            instants.append(_of_affine(pieces[a], knots) if affine else self._reached(values, a, knots, span))
        instants = np.unique(np.concatenate(instants))
        return instants[(instants >= span[0]) & (instants <= span[1])]

    def _is_table(self, node):
        return node is not None and _counts(self.tape.nodes[node])

    def _at(self, node, t, values):
        """Values of a node at times (N,)."""
        return np.broadcast_to(self._run(t, values, 1).c[node][0], t.shape).astype(float)

    def _reached(self, values, argument, knots, span):
        """Instants in a span at which a node, an argument that is monotone between instants of a scan, is at knots."""

        def at(t):
            return self._at(argument, t, values)

        grid = np.linspace(*span, SCAN)
        ends = np.array([at(grid)[:-1], at(grid)[1:]])
        first, last = np.searchsorted(knots, [ends.min(axis=0), ends.max(axis=0)], "right")
        crossed = np.concatenate([np.arange(i, j) for i, j in zip(first, last, strict=True)]).astype(int)
        within = np.repeat(np.arange(SCAN - 1), last - first)
        low, high, rising = grid[within], grid[within + 1], (ends[1] > ends[0])[within]
        for _ in range(BISECTIONS if crossed.size else 0):
            middle = (low + high) / 2
            before = (at(middle) < knots[crossed]) == rising
            low, high = np.where(before, middle, low), np.where(before, high, middle)
        return high

    def _times(self, values, instants, others, span):
        """Instants of all switches, ascending: affine ones, and others within these and a span."""
        window = [*instants, *(span or ())]
        if others and window and max(window) > min(window):
            ends = min(window), max(window)
            instants |= self._scan(values, *ends, [sides for sides in others if not self._is_table(sides[1])])
            for a, b in (sides for sides in others if self._is_table(sides[1])):
                instants |= {*self._reached(values, a, _some(self.tape.nodes[b].data.numbers), ends).tolist()}
        times = sorted(instants)
        width = max(times[-1] - times[0], SAME_INSTANT) if times else 1.0
        return [t for i, t in enumerate(times) if i == 0 or t - times[i - 1] > SAME_INSTANT * width]

    def _pieces(self, node, pieces, values):
        """The affine pieces c0 + c1 t that a node may take, from those of earlier nodes; None if one is not affine."""
        if node.kind == "input":
            place = self.q.where(self.symbols[node.data])
            if place is None:
                index = self.parameters.index(self.symbols[node.data].element_hash())
                return ((float(values[index]), 0.0),)
            return ((0.0, 1.0),) if place[0] == "t" else None
        if node.kind == "const":
            return ((float(node.data), 0.0),)
        if node.kind == "constant":
            return None if isinstance(node.data, Lookup) else ((0.0, 0.0), (1.0, 0.0))
        if node.kind == "gate":
            taken = pieces[node.args[1]]
            return taken and tuple({(0.0, 0.0), *taken})
        args = [pieces[a] for a in node.args]
        if any(a is None for a in args) or node.kind not in _PIECE:
            return None
        if node.kind in ("fmin", "fmax"):
            result = {*args[0], *args[1]}
        elif node.kind == "fabs":
            result = {*args[0], *((-c0, -c1) for c0, c1 in args[0])}
        else:
            options = [(a,) for a in args[0]] if len(args) == 1 else [(a, b) for a in args[0] for b in args[1]]
            result = {_PIECE[node.kind](node.data, *o) for o in options}
        result = tuple(r for r in result if r is not None)
        return result if 0 < len(result) <= MOST_BRANCHES else None

    def _scan(self, values, t0, t1, switches):
        """Instants between t0 and t1 at which switches, the sides of each, change sides.

        Between three instants a side may change twice: the parabola through them shows where, if it comes near zero.
        """

        def sides(t):
            c = self._run(t, values, 1).c
            return [np.broadcast_to(c[a][0] - (c[b][0] if b is not None else 0.0), t.shape) for a, b in switches]

        grid, instants = np.linspace(t0, t1, SCAN), set()
        for s, g in enumerate(sides(grid)):

            def side(t, s=s):
                return sides(np.atleast_1d(t))[s]

            decided = np.flatnonzero(g != 0)
            instants |= {float(end) for end, value in zip(grid[[0, -1]], g[[0, -1]], strict=True) if value == 0}
            t, g = grid[decided], g[decided].astype(float)
            pairs = [(t[i], t[i + 1], g[i]) for i in np.flatnonzero(g[:-1] * g[1:] < 0)]
            for i in np.flatnonzero(_grazes(t, g)):
                sign = np.sign(g[i])
                least = _least(lambda t, f=side, sign=sign: float(sign * f(t)[0]), t[i - 1], t[i + 1])
                if sign * side(least)[0] < 0:
                    pairs += [(t[i - 1], least, g[i - 1]), (least, t[i + 1], -g[i - 1])]
            instants |= {_changes(side, *pair) for pair in pairs}
        return instants

    def _run(self, t, values, depth):
        """The series of the residuals at times t, to so many coefficients."""
        t = np.asarray(t, dtype=np.longdouble)
        inputs = []
        for i, s in enumerate(self.symbols):
            place = self.q.where(s)
            if place is None:
                first = np.longdouble(values[self.parameters.index(s.element_hash())])
            elif place[0] == "t":
                first = t
            else:
                # No switch depends on jets; these values keep divisions by them from zero.
                first = np.longdouble(0.3 + 0.1 * ((7 * i) % 10))
            inputs.append([first, *(float(k == 1 and place is not None and place[0] == "t") for k in range(1, depth))])
        series = Series(self._numeric_tape, inputs)
        with np.errstate(all="ignore"):
            for _ in range(depth):
                series.advance()
        return series

    def classes(self, values, needs, times):
        """The class of each residual at each switching instant, as lists of (time, class) by name.

        These are the instants at which a derivative jumps, of those up to the residual's order in `needs`; the class is
        the order of the lowest of them less one.
        """
        if not times:
            return {}
        near = np.array([_neighbourhood(times, i) for i in range(len(times))])
        far, close = WIDE * near, NARROW * near
        t = np.array([times - far, times + far, times - close, times + close, *(times + near * x for x in AROUND)])
        series = self._run(t.ravel(), values, max(needs.values(), default=0) + EXTRA + 1)
        result = {}
        for name, c in zip(self.residuals, series.outputs, strict=True):
            c = np.array([np.broadcast_to(x, t.size) for x in c]).reshape(len(c), *t.shape)
            for i, when in enumerate(times):
                wide = jump(c[:, 0, i], c[:, 1, i], far[i])
                narrow = jump(c[:, 2, i], c[:, 3, i], close[i])
                least = np.maximum(JUMP * np.abs(c[:, :, i]).max(axis=1), np.nan_to_num(STAYS * np.abs(wide)))
                least = np.maximum(least, BY_ROUNDING * np.abs(c[0, :, i]).max() / near[i] ** np.arange(len(c)))
                rough = np.flatnonzero(np.abs(narrow) > least)
                if rough.size and rough[0] <= needs.get(name, -1):
                    result.setdefault(name, []).append((when, int(rough[0]) - 1))
        return result


def _counts(node):
    """Whether a node counts the knots of a table."""
    return isinstance(node.data, Lookup) and node.data.counts


def _of_affine(pieces, knots):
    """Instants at which an argument of affine pieces c0 + c1 t is at knots."""
    return np.concatenate([np.empty(0), *((knots - c0) / c1 for c0, c1 in pieces if c1)])


def _some(knots):
    """The first and the last knots of a table and ones between, each with its neighbours: all are of the same kind."""
    places = 1 + evenly(len(knots) - 2, INSPECTED)
    return knots[np.unique(np.concatenate([places - 1, places, places + 1]))]


def _grazes(t, g):
    """Whether values g (N,) at times t (N,) have a least magnitude there, of one sign, and may come to zero nearby."""
    result = np.zeros(len(t), dtype=bool)
    if len(t) < 3:
        return result
    size, same = np.abs(g), (g[:-2] * g[1:-1] > 0) & (g[1:-1] * g[2:] > 0)
    left, right = np.diff(size)[:-1] / np.diff(t)[:-1], np.diff(size)[1:] / np.diff(t)[1:]
    with np.errstate(all="ignore"):
        bend = (right - left) / (t[2:] - t[:-2])
        vertex = size[1:-1] - (left + bend * np.diff(t)[:-1]) ** 2 / (4 * bend)
    result[1:-1] = same & (left <= 0) & (right >= 0) & (vertex < NEAR_ZERO * np.minimum(size[:-2], size[2:]))
    return result


def _least(function, a, b):
    from scipy.optimize import minimize_scalar

    return minimize_scalar(function, bounds=(a, b), method="bounded", options={"xatol": 1e-9 * (b - a)}).x


def _changes(side, low, high, first):
    """The instant between low and high at which a side changes its sign, which is that of `first` at low."""
    for _ in range(DIVISIONS):
        t = np.linspace(low, high, PARTS + 1)
        k = 1 + int(np.argmax(np.append(~(side(t[1:-1]) * first > 0), True)))
        low, high = t[k - 1], t[k]
    return float((low + high) / 2)


def jump(before, after, h):
    """Jumps (n,) of a function's Taylor coefficients at an instant, from those at -h and h [s] from it.

    Both series are shifted to the instant. Where the function is smooth, they differ by their truncation errors, which
    fall with h; a jump does not.
    """
    return np.subtract(_shift(after, -h), _shift(before, h))


def _neighbourhood(times, i):
    """Width of the neighbourhood of an instant: half the distance of the nearest other instant, if there is one."""
    distances = [abs(times[j] - times[i]) for j in (i - 1, i + 1) if 0 <= j < len(times)]
    return 0.5 * min(distances) if distances else ALONE


def _shift(c, h):
    """Taylor coefficients about a point h away."""
    n = len(c)
    return [
        sum(c[j] * float(factorial(j) // (factorial(k) * factorial(j - k))) * h ** (j - k) for j in range(k, n))
        for k in range(n)
    ]


def _times(_, a, b):
    return (a[0] * b[0], a[0] * b[1] + a[1] * b[0]) if a[1] * b[1] == 0 else None


_PIECE = {
    "add": lambda _, a, b: (a[0] + b[0], a[1] + b[1]),
    "sub": lambda _, a, b: (a[0] - b[0], a[1] - b[1]),
    "mul": _times,
    "div": lambda _, a, b: (a[0] / b[0], a[1] / b[0]) if b[1] == 0 and b[0] != 0 else None,
    "neg": lambda _, a: (-a[0], -a[1]),
    "scale": lambda data, a: (data * a[0], data * a[1]),
    "copy": lambda _, a: a,
    "fmin": None,
    "fmax": None,
}


def require_smooth(switches, values, needs, span=None):
    """The knots of paths that have the class that each residual needs, a dict by name.

    Raises SpecificationError if a path has a lower class at an instant, such as C^2 instead of C^4 at t = 3 s.
    """
    knots = switches.knots(values, needs, span)
    for name, instants in knots.classes.items():
        when, k = min(instants, key=lambda pair: pair[1])
        if k < needs.get(name, 0):
            what = f"The path in {name!r}" if isinstance(name, str) else str(name).capitalize()
            raise SpecificationError(
                f"{what} needs C^{needs[name]}, has {f'C^{k}' if k >= 0 else 'a jump'} at t = {when:.6g}.",
                f"The actuation contains its derivative {needs[name]}, which must be continuous.",
                do=f"Use sv.paths.rest_to_rest(..., smoothness={needs[name]}), or a spline of that class.",
                name=str(name),
                needs=needs[name],
                has=k,
                t=when,
            )
    return knots
