"""C export: a model's feedforward and residuals, or a law's step, without libraries and without static memory.

The header has an enum of the indices of every array.
"""

import os
import re
import warnings
from pathlib import Path

import casadi as ca
import numpy as np

from servoctl.checks import as_path, named, positive, require_kind, without_effect
from servoctl.codegen.function import Compiled
from servoctl.control.law import Law
from servoctl.errors import SpecificationError
from servoctl.export.files import Array, Constant, Contents, Routine, Scalar, identifier, write
from servoctl.export.references import references_of
from servoctl.inversion.verdict import GROWS, HYPERBOLIC_ZEROS, verdict
from servoctl.model.model import Model
from servoctl.model.start import State
from servoctl.reduction.reduce import require_outputs

ITERATIONS, TOLERANCE = 30, 1e-13  # of Newton's method, as in `Compiled.newton`
IN_FLOATS = {  # corrections that end it, at once and where they no longer fall; tolerances of an allocation
    "TOLERANCE": 1e-6,
    "STALLED": 1e-3,
    "QP_MET": 1e-5,
    "QP_DEPENDENT": 1e-3,
    "QP_TINY": 1e-30,
    "MET": 1e-4,
    "GIVEN_WAY": 1e-4,
}
LARGEST_CONDITION = 1e5  # of the metric of an allocation in floats, which have seven digits
TIME = Scalar("t")
FINITE = "Returns 0, or -1 if a time or an answer is no finite number: nothing is then changed."
EXCLUDED = " There is no command where limits and bounds exclude each other."
RESERVED = "auto break case char const continue default do double else enum extern float for goto if inline int long "
RESERVED += "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile "
RESERVED += "while class new delete this template typename operator private public protected friend namespace using"


def export_c(
    source: Model | Law,
    folder: str | os.PathLike,
    *,
    name: str | None = None,
    start: State | None = None,
    real: str = "double",
    thinned: float | None = None,
    references: str = "table",
) -> tuple[Path, Path]:
    """Write a model's feedforward and residuals, or a law's step, as NAME.c and NAME.h: self-contained C99.

    Main arguments

    Parameters
    ----------
    source : Model or Law
        A model becomes `NAME_feedforward`, `NAME_actuation`, `NAME_residuals` and `NAME_outputs`. If its program
        determines the motion completely, the feedforward finds the actuation at a time by Newton's method; else it
        computes the actuation at a state, and `NAME_advance` is a Runge-Kutta step of the state. A law becomes
        `NAME_start` and `NAME_step`.
    folder : str or Path
        It is created if it does not exist; files of the same name are replaced.

    Other arguments

    name : str, optional
        Name of the files and prefix of all C names; default "model" or "law".
    start : State, optional
        Consistent start of the model, written as `NAME_x0` with its time `NAME_t0`.
    real : {"double", "float"}
        Type of all numbers. In floats Newton's method ends where rounding does: at about 1e-6 of the coordinates.
    thinned : float, optional
        Largest error of an entry of a law's schedule, relative to the largest magnitude of that entry along the
        schedule. Rows between those that are needed for it are left out, and computed by cubic polynomials. Default:
        all rows are written.
    references : {"table", "argument"}
        Of a model with references, whether their paths are written into the file, or `NAME_feedforward(t, ref, ...)`
        and the others take the references with their derivatives at t, for a path that the controller makes itself. A
        program that leaves motion free then has no `NAME_advance`: its state is integrated by `NAME_rates`.

    Returns
    -------
    (Path, Path)
        The C file and its header.

    Raises
    ------
    SpecificationError
        If the name is no C identifier, the source has no expressions, a law has a start, a model is thinned, or a
        reference has no path for its table. In floats also if costs of an allocation differ too much, or a spline has
        more data than floats count or breaks that are one instant in floats.
    NameUnknown
        If `real` is another type, or `references` neither "table" nor "argument".
    ServoError
        If the files cannot be written.

    Warns
    -----
    RuntimeWarning
        If `NAME_advance` would integrate unstable internal dynamics.
    """
    step = getattr(source, "step", None)
    law = hasattr(source, "schedule") and isinstance(getattr(getattr(step, "law", None), "step", step), Compiled)
    if not law and not hasattr(source, "reduction"):
        raise _without_expressions(source)
    without_effect(["start"] if law and start is not None else [], "for a law, which starts with its controller state")
    without_effect(["thinned"] if not law and thinned is not None else [], "for a model, which has no schedule")
    start = None if start is None else require_kind(State, "start", start, "model.start(...)")
    named(real, ("double", "float"), "type of numbers")
    named(references, ("table", "argument"), "form of references")
    argument = references == "argument"
    follows = not law and source.paths
    without_effect(["references"] if argument and not follows else [], "for what follows no references")
    thinned = None if thinned is None else positive("thinned", thinned)
    name = ("law" if law else "model") if name is None else name
    _require_name(name)
    folder = as_path(folder, "The folder")
    found = None if law or source.flat else verdict(source, start)
    if found is not None and found.dynamics in (HYPERBOLIC_ZEROS, GROWS):
        warnings.warn(
            f"{name}_advance integrates forward what this program leaves free, which is {found}. Export a law about a "
            "plan of sv.inverse instead, or steer the state by feedback.",
            RuntimeWarning,
            stacklevel=2,
        )
    contents = _of_law(source, thinned) if law else _of_model(source, start, argument, real)
    if real == "float":
        _require_condition(source)
        contents.sizes.update({key: value for key, value in IN_FLOATS.items() if key in contents.sizes})
    return write(folder, name, contents, real)


def _require_name(name):
    if not re.fullmatch(r"[A-Za-z]\w*", name if isinstance(name, str) else "", re.ASCII) or name in RESERVED.split():
        raise SpecificationError(
            f"The name of the export is {name!r}.",
            "A name has letters, digits and underscores, begins with a letter, and is no keyword of C or C++.",
            nearest=f"{identifier(name)!r}." if isinstance(name, str) and identifier(name) != name else "",
            do="Choose another name.",
            name=name,
        )


def _without_expressions(source):
    """The SpecificationError of a source without expressions."""
    if not hasattr(source, "schedule"):
        kind = type(source).__name__
        return SpecificationError(
            f"The source of the export is a {kind}.",
            "C code is written from a Model or a Law.",
            do="Pass derive(mechanism, program), or a law such as sv.lqr(...).",
            type=kind,
        )
    return SpecificationError(
        f"The step of the law {source.name!r} is a Python function.",
        "C code is written from the expressions of a law's step.",
        do="Export a law with expressions, such as sv.lqr(...).",
        law=source.name,
    )


def _require_condition(source):
    """Refuse an allocation whose weights are further apart than the digits of a float."""
    allocation = getattr(source, "allocation", None)
    if allocation is None:
        return
    m = len(allocation.sizes)
    H = np.asarray(source.schedule)[-m * m :].T.reshape(-1, m, m) * np.outer(allocation.sizes, allocation.sizes)
    condition = float(np.linalg.cond(H).max())
    if not condition <= LARGEST_CONDITION:
        raise SpecificationError(
            f"In the allocation of {source.name!r} the costs of inputs differ by a factor of {condition:.2g}.",
            f"In floats, with seven digits, they differ by {LARGEST_CONDITION:g} at most.",
            do='Export it with real="double", or pass weights nearer to each other in place of a priority.',
            law=source.name,
            condition=condition,
        )


def _of_model(model, start, argument, real):
    actuation, control = model.signals("reaction" if model.reduction.ideal else "actuation")
    places, residual = model.signals("residuals")
    require_outputs(model.reduction)
    outputs, output = model.signals("outputs")
    levels = [f"D{level} {row}" if level else row for row, level in places]
    units = model.reduction.mechanism.units
    p = Array("p", "Parameters p, SI", model.reduction.mechanism.parameters.names, units)
    x = Array("x", "State x = (q, w, ...), SI", model.state_names, units)
    z = Array("z", "Jets z = (x, highest derivative), SI", model.jet_names, units)
    u = Array("u", "Reaction u, SI" if model.reduction.ideal else "Actuation u, SI", actuation, units)
    r = Array("r", "Residuals r, each with its time derivatives, SI", levels)
    y = Array("y", "Outputs y, SI", outputs, units)
    functions = {"actuation": control.expression, "residuals": residual.expression}
    functions |= {"outputs": output.expression} if outputs else {}
    flat = model.flat and model.reduction.top == 2
    functions |= {"path": model.function("path").expression} if flat else {"rates": _rates_of_state(model)}
    references = references_of(model, functions, argument, real)
    first = TIME, *references.arguments
    at = (*first, z.input(), p.input())
    routines = [
        Routine("actuation", "u at time t [s] and jets z of the motion.", (*at, u.output())),
        Routine("residuals", "r at time t [s] and jets z: zero on the motion.", (*at, r.output())),
    ]
    routines += [Routine("outputs", "y at time t [s] and jets z.", (*at, y.output()))] if outputs else []
    constants = [Constant("p", model.parameters, "Parameters p, with the values they have in the model")]
    if start is not None:
        constants += [Constant("t0", start.t, "Time of the start [s]")]
        constants += [Constant("x0", start.values, "State x at the start")]
    last, sources, sizes = (_algebraic if flat else _integrated)(model, first, x, z, p, u, functions)
    if argument:  # no step: it would need the references at three instants
        last, sources = [one for one in last if one.name != "advance"], [one for one in sources if one != "advance.c"]
    return Contents(
        (p, x, *references.arrays, z, u, r, *([y] if outputs else [])),
        tuple(c for c in constants if np.size(c.values)),
        references.functions,
        (*routines, *last),
        tuple(sources),
        sizes | references.sizes,
        references.text,
    )


def _rates_of_state(model):
    """The rates of a model's state, without the other outputs of its differential equation."""
    f = model.function("ode").expression
    arguments = f.sx_in()
    names = f.name_in(), ["y"]
    return ca.Function("rates", arguments, [f.call(arguments)[0][: len(model.state_names)]], *names)


def _algebraic(model, first, x, z, p, u, functions):
    """Feedforward of a program that determines the motion: Newton's method along `path`."""
    about = (
        "Feedforward: jets z and u at time t [s], by Newton's method. The coordinates in x are its guess, and x "
        "becomes the state, the guess of the next instant. Returns the number of corrections, or -1 if the iteration "
        "fails or an answer is no finite number: z and u are then unchanged, and x must be set again."
    )
    arguments = (*first, x.output(), p.input(), z.output(), u.output())
    begin = model.nq if model.reduction.mechanism.q.plain else 3 * model.nq  # of γ' in the outputs of `path`
    sizes = {"N": model.n, "NQ": model.nq, "NY": functions["path"].numel_out(0), "FIRST": begin}
    sizes |= {"ITERATIONS": ITERATIONS, "TOLERANCE": TOLERANCE, "STALLED": 0.0, "NJ": len(z.names), "NU": len(u.names)}
    return [Routine("feedforward", about, arguments, "int")], ("answer.c", "newton.c"), sizes


def _integrated(model, first, x, z, p, u, functions):
    """Feedforward of a program with internal dynamics, and a step of the plan's state."""
    about = {
        "rates": "dx/dt at time t [s] and state x of the plan; not finite where its equations lose rank.",
        "feedforward": f"Feedforward: jets z and u at time t [s] and state x of the plan. {FINITE}",
        "advance": f"Takes the plan's state x from time t to t + h [s]: a Runge-Kutta step of order 4. {FINITE}",
    }
    at = (*first, x.input(), p.input())
    routines = [
        Routine("rates", about["rates"], (*at, x.output("dx"))),
        Routine("feedforward", about["feedforward"], (*at, z.output(), u.output()), "int"),
        Routine("advance", about["advance"], (TIME, Scalar("h"), x.output(), p.input()), "int"),
    ]
    sizes = {"N": model.n, "NX": functions["rates"].numel_out(0), "NJ": len(z.names), "NU": len(u.names)}
    return routines, ("answer.c", "integrated.c", "advance.c"), sizes


def _of_law(law, thinned):
    allocation, table = getattr(law, "allocation", None), np.atleast_2d(np.asarray(law.schedule, dtype=float))
    units = getattr(getattr(law, "plan", None), "units", {})
    y = Array("y", "Measurement y, SI", law.measures, units)
    u = Array("u", "Command u, SI", law.inputs, units)
    z = Array("z", "Controller state z", law.state_names)
    about = (
        "One sample of the law: command u of the measurement y and the controller state z, which becomes the next one. "
        f"Call it every {1 / law.rate:.9g} s from t = {law.t0:g} s; after the schedule its last row applies. "
        f"{FINITE}{'' if allocation is None else EXCLUDED}"
    )
    routines = (
        Routine("start", "Sets the controller state z to its value at the start.", (z.output(),)),
        Routine("step", about, (TIME, y.input(), z.output(), u.output()), "int"),
    )
    state = np.asarray(law.state, dtype=float)
    stored, sizes = _schedule(table.T, thinned)
    constants = (Constant("z0", state if len(state) else np.zeros(1)), *stored)
    sizes |= {f"N{a.key.upper()}": len(a.names) for a in (y, u, z)} | {"WIDTH": len(table)}
    sizes |= {"ROWS": table.shape[1], "T0": float(law.t0), "RATE": float(law.rate)}
    if allocation is None:
        functions, sources = {"law": law.step.expression}, ()
        sizes["NO"] = law.step.expression.numel_out(0)
    else:
        indices = {"measured": allocation.measured, "integrators": allocation.law.integrators}
        constants += tuple(Constant(name, np.array([*(places or [0])])) for name, places in indices.items())
        functions, sources = allocation.functions, ("allocation.h", "limited.c")
        sizes |= allocation.sizes_in_c | {"NO": law.n_out}
    sources = (_OF_TABLE[thinned is not None], *sources, "law.c")
    return Contents((y, u, z), constants, functions, routines, sources, sizes)


_OF_TABLE = ("table.c", "thinned.c")


def _schedule(rows, thinned):
    """Constants of the schedule (N, width), and sizes."""
    if thinned is None or len(rows) < 3:
        return (Constant("table", rows.ravel()),), {}
    knots, slopes = thin(rows, thinned)
    table = np.hstack([rows[knots], slopes[knots]])
    return (Constant("knot", knots), Constant("table", table.ravel())), {"KNOTS": len(knots)}


def thin(rows, bound):
    """Rows between which cubic polynomials give all others.

    Returns the indices (K,) of these rows, with the first and the last, and the slopes (N, width) of all, changes from
    row to row. `bound` is the largest error of an entry, relative to its largest magnitude over all rows (N, width).
    """
    slopes, allowed = np.gradient(rows, axis=0), bound * np.abs(rows).max(axis=0)
    knots = [0]
    while knots[-1] < len(rows) - 1:
        first, reach = knots[-1], 1
        while first + 2 * reach < len(rows) and _fits(rows, slopes, first, first + 2 * reach, allowed):
            reach *= 2
        low, high = reach, min(2 * reach, len(rows) - 1 - first)
        while low < high:
            middle = (low + high + 1) // 2
            low, high = (middle, high) if _fits(rows, slopes, first, first + middle, allowed) else (low, middle - 1)
        knots.append(first + low)
    return np.array(knots), slopes


def _fits(rows, slopes, a, b, allowed):
    """Whether the cubic polynomial between rows a and b is within the bound at the rows between."""
    h, s = b - a, (np.arange(a + 1, b)[:, None] - a) / (b - a)
    r = 1 - s
    cubic = rows[a] + s * s * (1 + 2 * r) * (rows[b] - rows[a])
    cubic += h * s * r * (r * slopes[a] - s * slopes[b])
    return bool((np.abs(cubic - rows[a + 1 : b]) <= allowed).all())
