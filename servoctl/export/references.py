"""References in exported C: their paths as tables beside the functions, or their jets as an argument."""

from dataclasses import field

import casadi as ca
import numpy as np

from servoctl.codegen.paths import RULES, jets_in
from servoctl.errors import SpecificationError
from servoctl.export.files import Array, Constant, text_of
from servoctl.spec.references import require_fixed, required_paths
from servoctl.values import frozen

OPEN = 3  # the rule of an end of a path outside of which nothing is said, after the numbers of `RULES`


@frozen
class InC:
    """What a C file has of a model's references."""

    functions: dict  # by name, without the place of paths in p
    arrays: tuple = ()  # of the interface
    text: str = ""  # in C, before the functions
    sizes: dict = field(default_factory=dict)  # macros

    @property
    def arguments(self):
        """Further arguments of C functions."""
        return tuple(array.input() for array in self.arrays)


def references_of(model, functions, argument, real):
    """Those of a model's functions: their jets are an argument, or taken from tables of the paths."""
    if not model.paths:
        return InC(functions)
    count = max(f.size2_in(3) if jets_in(f) else 0 for f in functions.values())
    functions = {name: _without_place(f, argument) for name, f in functions.items()}
    if not argument:
        tables, sizes = _tables(model, count, real)
        text = f"#include <stdint.h>\n\n{text_of('piece.h')}{tables}{text_of('references.c')}"
        return InC(functions, (), text, sizes)
    jet, n = model.reduction.mechanism.q.family.jet, len(model.parameters)
    jets = tuple(jet(name, k).name() for k in range(count) for name in model.paths)
    array = Array("ref", "References with their time derivatives, SI", jets)
    return InC(functions, (array,), text_of("join.c"), {"NP": n, "NALL": n + len(jets)})


def _without_place(f, argument):
    """A function without the place of paths in p; with jets as an argument, these are the last of its parameters."""
    t, x, p, *r = f.sx_in()
    rest = ca.SX.sym("p", p.numel() - 1)
    y = f.call([t, x, ca.vertcat(0, rest), *r])
    return ca.Function(f.name(), [t, x, ca.vertcat(rest, *map(ca.vec, r))] if argument else [t, x, rest, *r], y)


def _tables(model, count, real):
    """C text of the paths that a model follows, of which `count` derivatives are needed, and its macros."""
    parameters = model.reduction.mechanism.parameters
    require_fixed(model.paths, parameters, parameters.names, "A table in C leaves it to the caller to change")
    texts, rows = [], []
    for i, (name, path) in enumerate(required_paths(model.paths).items()):
        _require_ascending(name, path, real)
        pieces, _, size = path.coefficients.shape
        rules = [*map(_rule, (path.before, path.after), path.classes[[0, -1]], (count, count)), *path.rests]
        numbers = Constant(f"breaks_{i}", path.breaks), Constant(f"numbers_{i}", path.coefficients.ravel())
        texts += [f"\n{constant.declaration('')} = {constant.text};\n" for constant in numbers]
        rows.append(f"    {{{pieces}, {size}, {size}, {', '.join(map(str, rules))}, breaks_{i}, numbers_{i}}},\n")
    text = "".join([*texts, f"\nstatic const Path paths[] = {{\n{''.join(rows)}}};\n\n"])
    return text, {"NREFERENCES": len(rows), "MOST": max(count - 1, 0), "OPEN": OPEN}


def _rule(given, class_, count):
    """The number of what a path does outside an end of a class; it is held where all that is needed vanishes there."""
    return RULES[given or "hold"] if given or class_ >= count - 1 else OPEN


def _require_ascending(name, path, real):
    """Refuse a path whose breaks are no different numbers as floats."""
    falling = np.flatnonzero(~(np.diff(path.breaks.astype(np.float32)) > 0)) if real == "float" else []
    if len(falling):
        low, high = path.breaks[falling[0] :][:2].tolist()
        raise SpecificationError(
            f"The path of the reference {name!r} has breaks at t = {low!r} and {high!r} s.",
            "As floats, with seven digits, they are one instant.",
            do='Export it with real="double", or begin the path nearer to t = 0.',
            name=name,
            breaks=(low, high),
        )
