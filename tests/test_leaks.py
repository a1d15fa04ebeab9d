"""Odd input of every kind to every public function: errors of CasADi, numpy and scipy never reach the user."""

import functools
import math

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.errors import ServoError
from servoctl.model.model import derive


def plane(**options):
    q = sv.coordinates("x y")
    x, y = q
    options = {"actuators": {"pull": x, "lift": y}} | options
    return q, sv.Mechanism(q, gibbs=sv.particle(q, 2.0, (x, y)), **options)


ODD = {
    "None": None, "text": "abc", "no text": "", "bytes": b"x", "[]": [], "()": (), "{}": {}, "-1": -1, "1.5": 1.5,
    "NaN": math.nan, "inf": math.inf, "1j": 1j, "True": True, "(2, 3) array": np.ones((2, 3)),
    "array of NaN": np.array([np.nan]), "array of text": np.array(["a"]), "uneven": [[1, 2], [3]], "[None]": [None],
    "array of objects": np.array([ca.SX.sym("x"), None], dtype=object), "['a']": ["a"], "{1}": {1},
    "MX": ca.MX.sym("x"), "SX": ca.SX.sym("zz"), "SX matrix": ca.SX.sym("A", 2, 3), "empty SX": ca.SX(0, 0),
    "SX of NaN": ca.SX(math.nan), "SX of inf": ca.SX(math.inf), "DM": ca.DM([1, 2]), "Sparsity": ca.Sparsity(2, 2),
    "function": lambda: 1, "object": object(), "type": int, "{'a': 1}": {"a": 1}, "{1: 2}": {1: 2},
    "{'x': None}": {"x": None}, "{'x': 'y'}": {"x": "y"}, "{'x': []}": {"x": []}, "{'x': NaN}": {"x": math.nan},
    "{'x': MX}": {"x": ca.MX.sym("x")}, "{None: 1}": {None: 1.0},
}  # fmt: skip


@functools.cache
def cart(by):
    q, _ = plane()
    p = sv.parameters(m=1.0)
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=p.m * sv.particle(q, 1.0, (x, y)), actuators={"pull": x}, parameters=p)
    return derive(mechanism, sv.Program({"east": x - ca.sin(q.t)}, by=by))


def targets():
    q, mechanism = plane()
    x, y = q
    p = sv.parameters(m=1.0)
    S, spin = sv.particle(q, 1.0, (x, y)), q.d(1)[0]
    program = sv.Program({"east": x - ca.sin(q.t), "north": y})
    redundant = {"east": x - ca.sin(q.t)}
    eye = [[1, 0], [0, 1]]
    return {
        "coordinates": sv.coordinates,
        "parameters": lambda v: sv.parameters(m=v),
        "parameters.values": p.values,
        "parameters.values of m": lambda v: p.values({"m": v}),
        "q.d": q.d,
        "q.w": q.w,
        "q.dt": q.dt,
        "q.dt order": lambda v: q.dt(x, v),
        "q.order": q.order,
        "with_quasi_velocities names": lambda v: q.with_quasi_velocities(v, eye),
        "with_quasi_velocities V": lambda v: q.with_quasi_velocities("u v", v),
        "with_quasi_velocities V entry": lambda v: q.with_quasi_velocities("u v", [[1, 0], [0, v]]),
        "with_quasi_velocities h": lambda v: q.with_quasi_velocities("u v", eye, h=v),
        "with_quasi_velocities invariants": lambda v: q.with_quasi_velocities("u v", eye, invariants=v),
        "particle q": lambda v: sv.particle(v, 1.0, x),
        "particle mass": lambda v: sv.particle(q, v, x),
        "particle position": lambda v: sv.particle(q, 1.0, v),
        "particle position entry": lambda v: sv.particle(q, 1.0, (x, v)),
        "rigid_body q": lambda v: sv.rigid_body(v, 1.0, (1, 1, 1), rates=(0, 0, 1)),
        "rigid_body mass": lambda v: sv.rigid_body(q, v, (1, 1, 1), position=(x, y), rates=(0, 0, spin)),
        "rigid_body inertia": lambda v: sv.rigid_body(q, 1.0, v, rates=(0, 0, spin)),
        "rigid_body inertia entry": lambda v: sv.rigid_body(q, 1.0, (1, 1, v), rates=(0, 0, spin)),
        "rigid_body position": lambda v: sv.rigid_body(q, 1.0, (1, 1, 1), position=v, rates=(0, 0, spin)),
        "rigid_body rates": lambda v: sv.rigid_body(q, 1.0, (1, 1, 1), rates=v),
        "rigid_body rotation": lambda v: sv.rigid_body(q, 1.0, (1, 1, 1), rotation=v),
        "body_rates": lambda v: sv.body_rates(q, v),
        "body_rates q": lambda v: sv.body_rates(v, ca.SX.eye(3)),
        "Mechanism q": lambda v: sv.Mechanism(v, gibbs=S),
        "Mechanism gibbs": lambda v: sv.Mechanism(q, gibbs=v),
        "Mechanism kinetic": lambda v: sv.Mechanism(q, kinetic=v),
        "Mechanism balance": lambda v: sv.Mechanism(q, balance=v),
        "Mechanism potential": lambda v: sv.Mechanism(q, gibbs=S, potential=v),
        "Mechanism parameters": lambda v: sv.Mechanism(q, gibbs=S, parameters=v),
        **{f"Mechanism {k}": lambda v, k=k: sv.Mechanism(q, gibbs=S, **{k: v})
           for k in ("actuators", "forces", "constraints", "outputs")},
        **{f"Mechanism {k} entry": lambda v, k=k: sv.Mechanism(q, gibbs=S, **{k: {"x" if k == "forces" else "a": v}})
           for k in ("actuators", "forces", "constraints", "outputs")},
        "Program": sv.Program,
        "Program entry": lambda v: sv.Program({"east": v}),
        "Program by": lambda v: sv.Program(redundant, by=v),
        "Program weights": lambda v: sv.Program(redundant, weights=v),
        "derive mechanism": lambda v: derive(v, program),
        "derive program": lambda v: derive(mechanism, v),
        "derive residual": lambda v: derive(mechanism, sv.Program({"east": v, "north": y})),
        "derive weights": lambda v: derive(mechanism, sv.Program(redundant, weights=v)),
        "derive weight": lambda v: derive(mechanism, sv.Program(redundant, weights={"pull": v})),
        "derive guess": lambda v: derive(mechanism, program, v),
        "derive guess value": lambda v: derive(mechanism, program, {"x": v}),
        "start t": lambda v: cart("ideal").start(v),
        "start guess": lambda v: cart("ideal").start(guess=v),
        "start guess value": lambda v: cart("ideal").start(guess={"y": v}),
        "start held": lambda v: cart("ideal").start(y=v),
        "with_parameters": lambda v: cart("actuators").with_parameters(m=v),
    }  # fmt: skip


TARGETS = targets()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("target", TARGETS)
def test_no_error_of_another_package_leaks(target):
    """Whatever is given is accepted, or refused by an error of servoctl's own."""
    leaks = {}
    for name, value in ODD.items():
        try:
            TARGETS[target](value)
        except ServoError:
            continue
        except Exception as error:
            leaks[name] = f"{type(error).__name__}: {str(error).splitlines()[0][:60] if str(error) else ''}"
    assert not leaks


SILENT = {  # and what would be found out late, or never
    "particle mass": ("NaN", "inf", "(2, 3) array", "[]", "SX matrix", "empty SX", "DM", "Sparsity"),
    "particle position": ("[]", "empty SX", "(2, 3) array", "SX matrix"),
    "rigid_body mass": ("NaN", "inf", "(2, 3) array", "[]", "SX matrix", "empty SX", "DM"),
    "rigid_body inertia entry": ("NaN", "inf"),
    "with_quasi_velocities V entry": ("NaN", "inf", "array of NaN", "SX of NaN"),
    "with_quasi_velocities invariants": ("{1: 2}", "{None: 1}"),
    "Mechanism actuators": ("{1: 2}", "{None: 1}"),
    "Mechanism actuators entry": ("inf", "-1", "1.5", "True", "SX of inf"),
    "Mechanism constraints": ("{'x': None}", "{1: 2}", "{None: 1}"),
    "Mechanism outputs": ("{'x': None}", "{1: 2}", "{None: 1}"),
    "Mechanism forces entry": ("inf",),
    "Program weights": ("{'x': None}", "{'x': 'y'}", "{'x': []}", "{'x': NaN}", "{'x': MX}"),
    "derive weight": ("-1", "[]", "empty SX", "NaN", "inf"),
    "start t": ("NaN", "inf", "SX", "SX of NaN", "SX of inf"),
    "q.w": ("NaN", "inf", "1.5", "1j", "-1"),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("target", SILENT)
def test_what_has_no_meaning_does_not_pass_in_silence(target):
    accepted = []
    for name in SILENT[target]:
        try:
            TARGETS[target](ODD[name])
        except Exception:  # of whatever type: leaks are the business of the test above
            continue
        accepted.append(name)
    assert accepted == []
