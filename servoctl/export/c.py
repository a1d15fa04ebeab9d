"""C export: a model's feedforward and residuals, or a law's step, without a library or memory of their own.

Every function takes and gives arrays in the order of an enum in the header, and keeps nothing between two calls.
"""

import os
import re

import casadi as ca
import numpy as np

from servoctl.codegen.function import Compiled
from servoctl.errors import SpecificationError
from servoctl.export.files import Array, Constant, Routine, identifier, write
from servoctl.model.start import State

ITERATIONS, TOLERANCE = 30, 1e-13  # of Newton's method, as in `Compiled.newton`
RESERVED = "auto break case char const continue default do double else enum extern float for goto if inline int long "
RESERVED += "register restrict return short signed sizeof static struct switch typedef union unsigned void volatile "
RESERVED += "while class new delete this template typename operator private public protected friend namespace using"


def export_c(source, folder, *, name=None, start=None):
    """Write a model's feedforward and residuals, or a law's step, as NAME.c and NAME.h: self-contained C99.

    Main arguments

    Parameters
    ----------
    source : Model or Law
        A model gives `NAME_feedforward` (a program that determines the motion completely: time -> actuation by Newton's
        method; else: state -> actuation, with `NAME_advance` for a Runge-Kutta step of the state),
        `NAME_actuation`, `NAME_residuals` and `NAME_outputs`; a law gives `NAME_start` and `NAME_step`.
    folder : str or Path
        Made where it is missing; files of the same name are replaced.

    Other arguments

    name : str, optional
        Prefix of all names and of the files; default "model" or "law".
    start : State, optional
        A consistent start of the model, written as `NAME_x0` with its time `NAME_t0`.

    Returns
    -------
    (Path, Path)
        The C file and its header.

    Raises
    ------
    SpecificationError
        If the name is no C identifier, the source is neither model nor law, a start is given for a law.
    ServoError
        If the files cannot be written.
    """
    law = hasattr(source, "schedule") and isinstance(source.step, Compiled)
    if not law and not hasattr(source, "reduction"):
        raise _without_expressions(source)
    if law and start is not None:
        raise SpecificationError(
            "A start was given for a law.", "A law starts with its own memory.", do="Leave the start out."
        )
    if start is not None and not isinstance(start, State):
        raise SpecificationError(
            f"A {type(start).__name__} was given as start.",
            "A start satisfies every invariant at its time.",
            nearest="model.start(...).",
            do="Give that.",
        )
    name = ("law" if law else "model") if name is None else name
    if not re.fullmatch(r"[A-Za-z]\w*", name if isinstance(name, str) else "", re.ASCII) or name in RESERVED.split():
        raise SpecificationError(
            f"The export is to be named {name!r}.",
            "The name begins every function of the C file: letters, digits and underscores, and no word of C or C++.",
            nearest=f"{identifier(str(name))!r}." if identifier(str(name)) != name else "",
            do="Choose such a name.",
            name=name,
        )
    if not isinstance(folder, (str, os.PathLike)):
        raise SpecificationError(
            f"folder={folder!r} was given."[:200], "The files are written into a folder.", '"export".', "Give its path."
        )
    return write(folder, name, *(_of_law(source) if law else _of_model(source, start)))


def _without_expressions(source):
    """The refusal of what C cannot be written from."""
    if not hasattr(source, "schedule"):
        return SpecificationError(
            f"A {type(source).__name__} is to be exported.",
            "C is written from a Model or a Law.",
            nearest="derive(mechanism, program) makes a Model.",
            do="Give one of these.",
        )
    given, rule = f"The law {source.name!r} is to be exported.", "C is written from the expressions of a law's step: "
    inside = getattr(source.step, "law", None)
    if inside is None:
        return SpecificationError(given, rule + "one written in Python has none.", "sv.lqr and others.", "Export one.")
    return SpecificationError(
        given,
        rule + "a limited law solves a quadratic program instead.",
        nearest=f"The law inside, {inside.name!r}, whose commands the machine cuts off at its limits.",
        do="Export the law that was given to `limited`.",
    )


# --- what is exported


def _of_model(model, start):
    actuation, control = model.signals("reaction" if model.ideal else "actuation")
    places, residual = model.signals("residuals")
    outputs, output = model.signals("outputs")
    named = model.reduction.mechanism.parameters.names
    p = Array("p", "Parameters p, SI", named)
    x = Array("x", "State x = (q, w, ...), SI", model.state_names)
    z = Array("z", "Jets z = (x, highest derivative), SI", model.jet_names)
    u = Array("u", "Reaction u, SI" if model.ideal else "Actuation u, SI", actuation)
    levels = [f"D{level} {row}" if level else row for row, level in places]
    r = Array("r", "Residuals r, each with its time derivatives, SI", levels)
    arrays, at = [p, x, z, u, r], ("double t", z.given(), p.given())
    routines = [
        Routine("actuation", control._f, "u at time t [s] and jets z of the motion.", (*at, u.changed())),
        Routine("residuals", residual._f, "r at time t [s] and jets z: zero on the motion.", (*at, r.changed())),
    ]
    if outputs:
        arrays.append(Array("y", "Outputs y, SI", outputs))
        routines.append(Routine("outputs", output._f, "y at time t [s] and jets z.", (*at, arrays[-1].changed())))
    constants = [Constant("p", model.parameters, "Parameters p, with the values they have in the model")]
    if start is not None:
        constants += [Constant("t0", start.t, "Time of the start [s]")]
        constants += [Constant("x0", start.values, "State x at the start")]
    feedforward = _algebraic if model.flat and model.reduction.top == 2 else _integrated
    return arrays, [c for c in constants if np.size(c.values)], [*routines, *feedforward(model, x, z, p, u)]


def _algebraic(model, x, z, p, u):
    """Feedforward of a program that determines the motion: Newton's method on (q' , γ', γ'') as `path` gives them."""
    f, nq, n = model.function("path")._f, model.nq, model.n
    body = f"""
    double y[{f.numel_out(0)}];
    for (int iteration = 0; iteration <= {ITERATIONS}; iteration++) {{
        double defect = 0;
        @_path(t, x, p, y);
        for (int i = 0; i < {nq}; i++) {{
            const double e = fabs(y[i]) / (1 + fabs(x[i]));
            if (!(e < INFINITY)) return -1;
            if (e > defect) defect = e;
        }}
        if (defect <= {TOLERANCE!r}) {{
            for (int i = 0; i < {nq}; i++) z[i] = x[i];
            for (int i = 0; i < {2 * n}; i++) z[{nq} + i] = y[{2 * nq} + i];
            for (int i = 0; i < {n}; i++) x[{nq} + i] = z[{nq} + i];
            @_actuation(t, z, p, u);
            return iteration;
        }}
        for (int i = 0; i < {nq}; i++) x[i] += y[i];
    }}
    return -1;
"""
    about = (
        "Feedforward: jets z and u at time t [s], by Newton's method. The coordinates in x are its guess, and x "
        "becomes the state: that of one instant is the guess of the next. Returns the number of corrections; -1 where "
        "no solution was found: z and u are then unchanged, and x is to be set again."
    )
    arguments = ("double t", x.changed(), p.given(), z.changed(), u.changed())
    return [Routine("path", f), Routine("feedforward", body, about, arguments, "int")]


def _integrated(model, x, z, p, u):
    """Feedforward of a program with internal dynamics: the state of the plan is integrated beside it."""
    f, size, n = model.function("ode")._f, len(model.state_names), model.n
    arguments = f.sx_in()
    rates = ca.Function("rates", arguments, [f(*arguments)[:size]])
    feedforward = f"""
    double dx[{size}];
    @_rates(t, x, p, dx);
    for (int i = 0; i < {size}; i++) z[i] = x[i];
    for (int i = 0; i < {n}; i++) z[{size} + i] = dx[{size - n} + i];
    @_actuation(t, z, p, u);
"""
    stages = "".join(
        f"    for (int i = 0; i < {size}; i++) y[i] = x[i] + {c} * h * k[{j}][i];\n"
        f"    @_rates(t + {c} * h, y, p, k[{j + 1}]);\n"
        for j, c in enumerate((0.5, 0.5, 1.0))
    )
    advance = f"""
    double k[4][{size}], y[{size}];
    @_rates(t, x, p, k[0]);
{stages}    for (int i = 0; i < {size}; i++) x[i] += h / 6 * (k[0][i] + 2 * k[1][i] + 2 * k[2][i] + k[3][i]);
"""
    at = ("double t", x.given(), p.given())
    return [
        Routine(
            "rates", rates, "dx/dt at time t [s] and state x of the plan; not finite where its equations lose rank.",
            (*at, x.changed("dx")),
        ),
        Routine(
            "feedforward", feedforward, "Feedforward: jets z and u at time t [s] and state x of the plan.",
            (*at, z.changed(), u.changed()),
        ),
        Routine(
            "advance", advance,
            "Takes the plan's state x from time t to t + h [s]: a step of Runge and Kutta's of order 4.",
            ("double t", "double h", x.changed(), p.given()),
        ),
    ]  # fmt: skip


def _of_law(law):
    f, table = law.step._f, np.atleast_2d(np.asarray(law.schedule, dtype=float))
    width, last = len(table), table.shape[1] - 1
    y = Array("y", "Measurement y, SI", law.measures)
    u = Array("u", "Command u, SI", law.inputs)
    z = Array("z", "Memory z", law.state_names)
    ny, nu, nz = (len(array.names) for array in (y, u, z))
    start = f"""
    for (int i = 0; i < {nz}; i++) z[i] = @_z0[i];
"""
    step = f"""
    double x[{max(ny + nz, 1)}] = {{0}}, all[{f.numel_out(0)}];
    double k = floor((t - ({float(law.t0)!r})) * {float(law.rate)!r} + 0.5);
    k = k > 0 ? k : 0;
    k = k < {last} ? k : {last};
    for (int i = 0; i < {ny}; i++) x[i] = y[i];
    for (int i = 0; i < {nz}; i++) x[{ny} + i] = z[i];
    @_law(t, x, @_table + {width} * (int)k, all);
    for (int i = 0; i < {nu}; i++) u[i] = all[i];
    for (int i = 0; i < {nz}; i++) z[i] = all[{nu} + i];
"""
    about = (
        "One sample of the law: command u of the measurement y and the memory z, which becomes the next one. To be "
        f"called every {1 / law.rate:.9g} s from t = {law.t0:g} s; after its last row the table stays there."
    )
    constants = [Constant("z0", np.asarray(law.state, dtype=float), "Memory z at the start")] if nz else []
    return (
        [y, u, z],
        [*constants, Constant("table", table.T.ravel())],
        [
            Routine("law", f),
            Routine(
                "start",
                start if nz else "\n    (void)z;\n",
                "Sets the memory z to its value at the start.",
                (z.changed(),),
            ),
            Routine("step", step, about, ("double t", y.given(), z.changed(), u.changed())),
        ],
    )
