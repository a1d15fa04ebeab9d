"""A function of (t, x, p) on NumPy arrays: single points, grids, Runge-Kutta, Taylor, and Newton along a path.

Loops, buffers and long grids take compiled code if it is on disk; else CasADi evaluates until their evaluations have
taken as long as compiling takes (`compiler.library`). The two agree to rounding only: a repeated call has the same bits
where `compiler.fixed` says which of them is used. Then it depends on the call alone. Single points and short grids are
left to CasADi, as is everything where there is no compiler; single points of a function that is called often are
compiled too, with CasADi's operations one by one, so that their bits stay.
"""

import functools
import hashlib
import itertools
import math

import casadi as ca
import numpy as np

from servoctl.codegen import compiler, emit
from servoctl.codegen.compiler import CALLS
from servoctl.codegen.interpreted import BLOCK, MANY_POINTS, Interpreter, restored, restored_grid, weighted
from servoctl.codegen.native import Library, builtin
from servoctl.codegen.paths import none_chosen
from servoctl.errors import SpecificationError
from servoctl.jets.branches import contains

STEP = 6  # evaluations that take as long as a Taylor step, or a block of a path, with what surrounds them in Python
FULLY_OPTIMISED = 6_000  # statements of C: up to here -O3 takes at most 1.5 s; more are as fast with -O1
ALONG_A_PATH = "-O2 -fno-tree-pre -fno-tree-vrp -fno-gcse -fno-tree-slp-vectorize"  # Newton: 3/4 of the time of -O3
TAYLOR_COMPILED = 15_000  # operations: beyond, compiling takes as long as 50,000 steps that CasADi evaluates


def compiled(f, name, loops=(), project=None, others=None, sizes=None):
    """Make a compiled function of an SX function f(t, x, p) with one dense column output y (n_y).

    Of the `loops`, "rk", "newton" and "taylor" are methods of the result, the others are called by `Compiled.native`,
    as are `others`, functions of the same form in its library. `project`, (t, x, p) -> change of x, restores
    invariants; loops may call it after their steps. `sizes` are constants of the loops: for "newton" the number of
    "pivots" (default: 0); for "taylor" the numbers "nq" of coordinates and "n" of quasi-velocities, the order s̄ "top",
    the highest index of coefficients "last", "plain" (1 if q' = γ', else 0), for `whole` "rates" and
    "invariants", the numbers of values of these functions in `others`, and, beside "settled" there, (t, x, p) ->
    (x, γ^(s̄)), "free": 0 for each entry of γ', ..., γ^(s̄-1) that it gives, 1 for those integrated. Raises
    SpecificationError for an operation that is not elementary.
    """
    for part in filter(None, (f, project, *(others or {}).values())):
        _require_elementary(part)
    return Compiled(f, name, tuple(loops), project, others, sizes)


def _require_elementary(f):
    for operation in {f.instruction_id(k) for k in range(f.n_instructions())} - emit.EMITTED:
        raise SpecificationError(
            f"The function {f.name()} contains the operation {_name_of(operation)}.",
            "Only scalar arithmetic and the elementary functions of CasADi's SX are compiled.",
            do="Write the expression with these, or expand() the function that it calls.",
            function=f.name(),
            operation=_name_of(operation),
        )


def _name_of(operation):
    """CasADi's name of an instruction, such as OP_SIN."""
    return next((name for name in dir(ca) if name.startswith("OP_") and getattr(ca, name) == operation), operation)


class Compiled:
    """A function y = f(t, x, p) whose loops and long grids are compiled; made by `compiled`.

    Several threads may call it and its loops at once. It pickles: the copy loads its library from the cache, or builds
    it again. States, parameters and outputs are `n_x`, `n_p` and `n_y` in number; `expression` is the SX function,
    `others` are further ones in the same library, and `sizes` are constants of the loops.
    """

    __slots__ = "__dict__", "__weakref__", "_builtin"

    def __init__(self, f, name, loops, project=None, others=None, sizes=None):
        self.name, self.loops, self._project = name, loops, project
        self.others, self.sizes = others or {}, sizes or {}
        self.n_x, self.n_p, self.n_y = f.numel_in(1), f.numel_in(2), f.numel_out(0)
        self.expression, self._symbol = f, f"servoctl_{name}"
        self._x_shape, self._p_shape = (self.n_x,), (self.n_p,)
        self._interpreter = Interpreter(f, project, self.sizes, self.others.get("settled"))
        self._builtin, self._calls, self._in_loops = None, 0, {"_library": 1, "_lanes": 1}  # since the last look for it

    def __reduce__(self):
        parts = (self.expression, self.name, self.loops, self._project, self.others, self.sizes)
        known = {"operations": self.operations, "identity": self.identity} if self.loops else {}
        return Compiled, parts, known

    def __eq__(self, other):
        return self is other or (isinstance(other, Compiled) and self.identity == other.identity)

    def __hash__(self):
        return hash((self.name, self.n_x, self.n_p, self.n_y))

    def __repr__(self):
        how = "compiled" if self.backend == "c" else "evaluated by CasADi"
        return f"{self.name}: y[{self.n_y}] of t, x[{self.n_x}], p[{self.n_p}]; {self.operations} operations, {how}"

    @functools.cached_property
    def operations(self):
        """Number of arithmetic operations of one evaluation."""
        return emit.operations(self.expression)

    @functools.cached_property
    def identity(self):
        """Hash of what determines the C text, which takes longer to write."""
        functions = {"": self.expression, "project": self._project, **self.others}
        parts = ((name, f.serialize()) for name, f in functions.items() if f is not None)
        return hashlib.sha256(repr((self.name, self.loops, self.sizes, *parts)).encode()).hexdigest()

    @property
    def interpreted(self):
        """Evaluation by CasADi, whether or not a library is loaded: a few points do not pay for one."""
        return self._interpreter

    @property
    def backend(self):
        """``"c"`` once the library is loaded, ``"casadi"`` until then."""
        loaded = self.__dict__
        return loaded.get("_lanes", loaded.get("_library", self._interpreter)).backend

    def __call__(self, t, x, p):
        """Evaluate at one point: t [s], x (n_x,) and p (n_p,), SI; returns a new (n_y,) array.

        Raises SpecificationError if x or p has another shape.
        """
        if self._builtin is not None:
            return self._builtin(float(t), self._array("x", x, self._x_shape), self._array("p", p, self._p_shape))
        self._calls += 1
        if self._calls == CALLS and compiler.compiler() and not contains(self.expression, ca.OP_ERFINV):
            library = compiler.library(emit.emit_builtin(self.expression, self._symbol), exact=True)
            self._builtin = library and builtin(library, self._symbol, self.__call__)
            if self._builtin:
                self.__class__ = _Often
        row_y, run = self._place(self._interpreter, t, x, p)
        run()
        return row_y.copy()

    def buffer(self):
        """Arrays t (1,), x (n_x,), p (n_p,), y (n_y,) and a call without arguments that computes y from the others.

        For loops in Python over single evaluations. They belong to the calling thread; its other evaluations overwrite
        them.
        """
        self._in_loops["_library"] = math.inf
        return self._library.workspace.buffer

    def grid(self, t, x, p):
        """Evaluate at N points: times (N,) or one [s], states x (n_x, N), parameters p (n_p,) or (n_p, N); (n_y, N).

        Raises SpecificationError if the shapes disagree.
        """
        n = np.shape(x)[-1] if np.ndim(x) == 2 else np.size(t)
        x = self._array("x", x, (self.n_x, n))
        t = self._array("t", np.broadcast_to(t, (n,)) if np.ndim(t) == 0 else t, (n,))
        p = self._array("p", p, (self.n_p, n) if np.ndim(p) == 2 else self._p_shape)
        y = np.empty((self.n_y, n))
        self._in_loops["_lanes" if n > MANY_POINTS and "newton" not in self.loops else "_library"] += n / BLOCK
        (self._lanes if n > MANY_POINTS else self._library if self.loops else self._interpreter).grid(t, x, p, y)
        return y

    def rk(self, t0, x0, h, n_steps, p, tableau, every=1, project_every=0):
        """Integrate dx/dt, the first n_x outputs, by explicit Runge-Kutta steps of h [s] from t0 and x0 (n_x,).

        Step k starts at t0 + k h; a negative h runs backwards. The run ends before the first state that is not finite.
        `tableau` has the coefficients a (s, s), strictly lower triangular, b (s,) and c (s,) of s stages. Of the steps
        every `every`-th is logged, and the start and the end always; the state is projected after every
        `project_every`-th, never for 0. Returns the logged times t (N,), states (n_x, N) and further outputs
        (n_y - n_x, N). Raises SpecificationError for a function without this loop, another shape, or a count out of
        range.
        """
        self._require_loop("rk")
        x0, p = self._array("x0", x0, self._x_shape), self._array("p", p, self._p_shape)
        if n_steps < 0 or every < 1:
            raise SpecificationError(
                f"n_steps={n_steps} and every={every}.",
                "n_steps is at least 0, every at least 1.",
                n_steps=n_steps,
                every=every,
            )
        tableau = tuple(np.ascontiguousarray(part, dtype=float) for part in tableau)
        log = np.append(np.arange(0, n_steps, every), n_steps)
        states, outputs = np.empty((self.n_x, log.size)), np.empty((self.n_y - self.n_x, log.size))
        counts = (int(n_steps), int(every), int(project_every) if self._project is not None else 0)
        self._in_loops["_library"] += n_steps * len(tableau[1])
        n = 1 + self._library.rk(float(t0), x0, float(h), counts, p, tableau, states, outputs)
        return t0 + log[:n] * h, states[:, :n], outputs[:, :n]

    def continuation(self, cuts, x0, p, longest, most):
        """Follow a path by steps of its own; the outputs are the Newton step delta, dx/dt, d²x/dt², others, pivots.

        A step is predicted by the rates and corrected. It is halved until Newton's corrections shrink quickly, the
        predictions from both its ends are right up to a small part of the way, and no pivot (the last
        ``sizes["pivots"]`` outputs) changes its sign or its size by more than a factor of 4: the path cannot change to
        another branch of the solution. `cuts` (C,) has the start, instants at which steps end, and the end, in order,
        also backwards; x0 (n_x,) starts the iteration there. Returns at most `most` nodes (M, 1 + n_x + n_y), t, x and
        outputs at the ends of steps no longer than `longest` [s], and the number of evaluations. If M < most, the path
        ends where the last node lies.
        """
        self._require_loop("newton")
        cuts = self._array("cuts", cuts, (np.size(cuts),))
        x0, p = self._array("x0", x0, self._x_shape), self._array("p", p, self._p_shape)
        nodes = np.empty((most, 1 + self.n_x + self.n_y))
        n, iterations = self._library.continuation(cuts, x0, p, float(longest), nodes)
        self._in_loops["_library"] += iterations
        return nodes[:n], iterations

    def newton(self, t, nodes, p):
        """Solve at times t (N,) along the path of a `continuation`, in the order of its nodes.

        A point is predicted by Hermite's interpolation between two nodes and corrected until every
        |delta_i| <= 1e-13 (1 + |x_i|); by further steps of the path from the node before it, where that fails.
        Compiled code takes eight points at once, CasADi 128. Returns the solutions x at the first K times, dx/dt,
        d²x/dt² and others, (n_y - pivots, K), and the number of evaluations; K < N if the iteration fails at t[K], or a
        rate is not finite there.
        """
        self._require_loop("newton")
        t, p = self._array("t", t, (np.size(t),)), self._array("p", p, self._p_shape)
        nodes = self._array("nodes", nodes, (len(nodes), 1 + self.n_x + self.n_y))
        z = np.empty((self.n_y - self.sizes.get("pivots", 0), t.size))
        n, iterations = self._library.newton(t, nodes, p, z)
        self._in_loops["_library"] += iterations if n < BLOCK else STEP * iterations / BLOCK + n % BLOCK
        return z[:, :n], iterations

    def taylor(self, t0, x0, ends, p, rtol, atol, max_steps, project_every=0):
        """Steps of the Taylor method; the outputs are coefficients of q (unless plain) and γ by index, then pivots.

        A step is as long as its last term meets the tolerance at every level of the state: `rtol` relative to the
        level's largest entry, and `atol`, a number, or (n_x,) where each entry of a level is measured in its own. The
        size of q is its largest way from x0 so far or, where that is more, what q' moves it in the step. A step ends
        at each of `ends`, in the direction of motion; between two of them paths have one branch, which the last
        parameter, an instant, selects. The state is projected after every `project_every`-th step, never for 0.
        Returns t, x and outputs at the starts of the S steps, and t and x at the end of the last one, as
        (S + 1, 1 + n_x + n_y); it lies before the last end if the step length vanishes, or S is `max_steps`.
        """
        self._require_loop("taylor")
        library, every = self._library, project_every if self._project is not None else 0
        self._place(library, t0, x0, p)
        atol, weights = (atol, None) if isinstance(atol, float) else weighted(atol)
        rows = library.taylor(ends, rtol, atol, every, max_steps, weights)
        self._in_loops["_library"] += STEP * len(rows)
        return rows

    def whole(self, start, p, tolerances, most, times, net):
        """A whole motion by the Taylor method in one call, with what shows whether nothing along it needs a decision.

        `start` has t0, the state there and the ends of `taylor`; `times` (N,) are samples in the order of the motion.
        In `net`, at (M,) parts of each step and at a distance of instants [s], series are compared with the equations,
        not at the end if that is a knot (its third entry). Returns rows of the steps, as `taylor` does; the jets q, γ',
        ..., γ^(s̄) at the samples, by "settled" if there is one; and facts: how far γ^(s̄) of the series is from that of
        "rates" (n,), the longest step (1,), the largest sizes of the states (n_x,), of q from the start, the least size
        of each pivot, 0 where its sign changes, and the largest one, and (1,) the largest of the "invariants" at the
        end, relative to its gradient times the state. None if the steps do not reach the end, samples are not finite,
        or nothing is compiled.
        """
        self._require_loop("taylor")
        library = self._library
        self._place(library, start[0], start[1], p)
        n, sizes = self.sizes["n"], self.sizes
        pivots = self.n_y - sizes["last"] * (n + (0 if sizes["plain"] else sizes["nq"]))
        lengths = n, 1, self.n_x, pivots, pivots, 1
        rows = sizes["nq"] + sizes["top"] * n
        times = np.ascontiguousarray(times, dtype=float)
        found = library.whole(start[2], tolerances, most, times, net, (rows, sum(lengths)))
        if found is None:
            return None
        ends = list(itertools.accumulate(lengths, initial=0))
        return *found[:2], [found[2][a:b] for a, b in itertools.pairwise(ends)]

    def jets(self, log, k, t, p, levels, by_rows=False):
        """The jets q, γ', ..., γ^(levels), (nq + levels n, N), at times t (N,) within the steps k (N,) of `taylor`.

        `levels` is below ``sizes["last"]``. With `by_rows`, "settled" gives the rates up to γ^(s̄), if there is one;
        levels must then include them. Not where a pivot may vanish.
        """
        k, t = np.ascontiguousarray(k, dtype=np.int64), np.ascontiguousarray(t, dtype=float)
        z = np.empty((self.sizes["nq"] + levels * self.sizes["n"], t.size))
        p = self._array("p", p, self._p_shape)
        settled = (self.n_x + self.sizes["n"]) * by_rows
        self._library.jets(np.ascontiguousarray(log), k, t, p, (levels, settled), z)
        return z

    def restore(self, t, x, p):
        """The state (n_x,) with its invariants restored by `project`, by CasADi; x if there is no `project`."""
        return x if self._project is None else restored(self._project, t, x, p)

    def restore_grid(self, t, x, p):
        """States (n_x, N) at times (N,), each restored in the same way."""
        if self._project is None or not len(t):
            return x
        t, p = np.ascontiguousarray(t, dtype=float), np.ascontiguousarray(p[: self._project.numel_in(2)], dtype=float)
        return restored_grid(self._projection, t, x, p)

    @functools.cached_property
    def _projection(self):
        return Interpreter(self._project)

    def native(self, suffix, calls=math.inf):
        """A C function of the library, which is compiled if necessary; None without a compiler.

        Its name follows ``servoctl_NAME_``: "point", "grid", a key of `others`, or a function of a loop's file. `calls`
        are evaluations for which it is needed: None, too, while these do not make up for compiling it.
        """
        self._in_loops["_library"] += calls
        return self._library.native(suffix)

    def _require_loop(self, loop):
        if loop not in self.loops:
            raise SpecificationError(
                f"{self.name!r} has no loop {loop!r}.",
                f"Its loops are {', '.join(self.loops) or '(none)'}.",
                do=f"Make it with loops=({loop!r},).",
                name=self.name,
                loop=loop,
                loops=self.loops,
            )

    @property
    def too_long(self):
        """Whether compiling takes as long as all steps of a motion."""
        return "taylor" in self.loops and self.operations > TAYLOR_COMPILED

    @property
    def _library(self):
        """Evaluator of loops and buffers: compiled code, or CasADi where nothing is compiled."""
        return self._interpreter if self.too_long else self._loaded("_library")

    @property
    def _lanes(self):
        """Evaluator of long grids: a separate library, because twice the code takes twice the time to compile."""
        return self._library if "newton" in self.loops else self._loaded("_lanes")

    def _loaded(self, name):
        """Evaluator by a library; another one, or CasADi, as long as its calls do not make up for compiling it."""
        found = vars(self).get(name)
        if none_chosen():
            return self._interpreter
        if found is None and ((calls := self._in_loops[name]) or compiler.choice.get()):
            self._in_loops[name] = 0
            identity, emitted = f"{name} {FULLY_OPTIMISED} {self.identity}", functools.partial(self._emitted, name)
            if (library := compiler.library(identity, calls=calls, emitted=emitted)) is not None:
                found = vars(self)[name] = Library(library, self._symbol, self.n_x, self.n_p, self.n_y)
        return found or vars(self).get("_library", self._interpreter)

    def _emitted(self, name):
        """C text of a library, and how it is compiled."""
        if name == "_lanes":
            return emit.emit(self.expression, self._symbol), "-O1"
        text = self.source()
        if {*self.loops} <= {"rk", "radau"} or text.count(";") > FULLY_OPTIMISED:
            return text, "-O1"
        return text, ALONG_A_PATH if self.loops == ("newton",) else "-O3"  # as fast there, with the same bits

    def source(self):
        """C text of the library with the loops."""
        wide, parts = "newton" in self.loops, {"project": self._project, "others": self.others, "sizes": self.sizes}
        return emit.emit(self.expression, self._symbol, self.loops, **parts, wide=wide)

    def _place(self, evaluator, t, x, p):
        """Write t, x and p into an evaluator's workspace of this thread; return its y and its call."""
        row_t, row_x, row_p, row_y, run = evaluator.workspace.row
        row_t[0] = t
        try:
            row_x[:], row_p[:] = x, p
        except (TypeError, ValueError):  # not arrays of floats of the right shapes
            row_x[:], row_p[:] = self._array("x", x, self._x_shape), self._array("p", p, self._p_shape)
        return row_y, run

    def _array(self, what, value, shape):
        array = np.ascontiguousarray(value, dtype=float)
        array = array if array.flags.aligned else array.copy()
        if array.shape != shape:
            raise SpecificationError(
                f"{what} of {self.name!r} has the shape {array.shape}.",
                f"Its shape is {shape}.",
                name=self.name,
                array=what,
                shape=array.shape,
                expected=shape,
            )
        return array


class _Often(Compiled):
    """One that has been called often: a call is that of its builtin, which calls `Compiled.__call__` if need be."""

    __slots__ = ()
    _equals = Compiled  # in comparisons of values
    __call__ = Compiled._builtin  # found without a frame of Python: a third of the time of a call of few operations
