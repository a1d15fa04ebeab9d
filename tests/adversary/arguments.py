"""Odd values for every argument of every public call: what is neither accepted nor refused in words, and what hangs.

`python tests/adversary/arguments.py` prints each leak; `--only NAME ...` takes the calls whose names contain one of these.
"""

import argparse
import contextlib
import functools
import io
import math
import os
import tempfile
import warnings
from collections import Counter

import casadi as ca
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from scipy import stats
from work import TooMuchWork, at_most

import servoctl as sv
from servoctl.errors import ServoError
from servoctl.shell.main import main

WORDS = ("accepted", "refused")
MOST_CALLS = 20_000_000  # of functions, within a call before it counts as hanging

ODD = {
    "None": None, "text": "abc", "a number in text": "1.0", "bytes": b"x",
    "[]": [], "0": 0, "-1": -1, "2**63": 2**63, "1e-300": 1e-300, "1e300": 1e300, "NaN": math.nan,
    "inf": math.inf, "1j": 1j, "True": True, "complex64": np.complex64(2 + 3j), "longdouble": np.longdouble(0.1),
    "(2, 3) array": np.ones((2, 3)), "array of text": np.array(["a"]), "complex array": np.array([1j, 2.0]),
    "uneven": [[1, 2], [3]], "MX": ca.MX.sym("x"), "SX": ca.SX.sym("zz"),
    "function": lambda *_: 1, "{'x': 1e300}": {"x": 1e300}, "{'zz': 1}": {"zz": 1.0}, "{None: 1}": {None: 1.0},
}  # fmt: skip
# how the names of calls begin that solve for long, and the odd values for them
SLOW = ("relaxed", "fastest", "tradeoff", "figures.", "map.plot", "computed", "minimum_phase")
FEW = ("None", "text", "1e-300", "NaN", "1j", "(2, 3) array", "uneven", "SX", "function", "{'zz': 1}")


def point():
    """A driven point in the plane with a further output."""
    p, q = sv.parameters(m=2.0), sv.coordinates("x y")
    x, y = q
    return sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, (x, y)), potential=x**2 + y**2, actuators={"pull": x, "lift": y}, parameters=p,
        outputs={"far": x + y},
    )  # fmt: skip


@functools.cache
def scene():
    """Values that calls need: mechanism, program, model, plan, plant, law, loop, study, map."""
    mechanism = point()
    q = mechanism.q
    x, y = q
    r = q.references(X=sv.paths.rest_to_rest(0.0, 1.0, duration=1.0))
    program = sv.Program({"X": x - r.X, "Y": y})
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(), (0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 101))
    ideal = sv.derive(mechanism, sv.Program({"X": x - ca.sin(q.t)}, by="ideal"))
    free = sv.simulate(ideal, ideal.start(y=0.1, dy=0.0), (0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 51))
    plant = sv.plant(mechanism)
    law = sv.lqr(plan, plant)
    closed = sv.close(plant, law, plan.state(0.0), (0.0, 1.0))
    study = sv.sweep(doubled, [{"a": 1.0}, {"a": 2.0}, {"a": 3.0}], progress=False)
    return {
        "mechanism": mechanism, "q": q, "program": program, "model": model, "plan": plan, "ideal": ideal, "free": free,
        "plant": plant, "law": law, "closed": closed, "study": study, "map": sv.stability(ideal, free),
        "folder": tempfile.mkdtemp(), "times": np.linspace(0.0, 1.0, 9),
    }  # fmt: skip


def calls():
    """Public calls by name: a callable and its arguments, all of them good."""
    s = scene()
    q, plan, plant, law, closed, study = (s[k] for k in ("q", "plan", "plant", "law", "closed", "study"))
    (_, y), t = q, q.t
    span, x0, near, folder = (0.0, 0.2), plan.state(0.0), s["ideal"].start(y=0.1, dy=0.0), s["folder"]
    noise, bounded = {"x": 1e-3}, sv.plant(s["mechanism"], limits={"pull": 50.0})
    path = sv.paths.rest_to_rest(0.0, 1.0, duration=1.0)
    return {
        "simulate": (sv.simulate, dict(model=s["ideal"], start=near, t_span=span, method="RK4", drift="project",
                                       accuracy=None, t_eval=[0.0, 0.1], progress=False)),
        "simulate flat": (sv.simulate, dict(model=s["model"], start=s["model"].start(), t_span=span, method=None,
                                            drift=None, t_eval=[0.0, 0.1], progress=None)),
        "Taylor": (sv.methods.Taylor, dict(order=8, jets=3, rtol=1e-6, atol=1e-6)),
        "RungeKutta": (sv.methods.RungeKutta, dict(order=4, step=0.1)),
        "RadauIIA": (sv.methods.RadauIIA, dict(order=5, step=0.1, rtol=1e-6, atol=1e-6)),
        "Adaptive": (sv.methods.Adaptive, dict(name="RK45", rtol=1e-6, atol=1e-6)),
        "Project": (sv.methods.Project, dict(every=2)),
        "Poles": (sv.methods.Poles, dict(values=0.1)),
        "Poles row": (lambda poles: sv.simulate(s["ideal"], near, span, "RK4", drift=sv.methods.Poles({"X": poles})),
                      dict(poles=[-5.0, -6.0])),
        "verify": (sv.verify, dict(run=s["free"], segments=3)),
        "verify closed": (sv.verify, dict(run=closed)),
        "internal_dynamics": (sv.internal_dynamics, dict(run=s["free"])),
        "minimum_phase": (sv.minimum_phase, dict(model=s["model"], parameter="m", values=(1.5, 2.5), at=s["model"].start())),
        "stability": (sv.stability, dict(model=s["ideal"], run=s["free"], order=12)),
        "tradeoff": (sv.tradeoff, dict(model=s["ideal"], start=near, t_span=span, methods={"RK4": [0.1]}, drift=[None],
                                       outputs=["y"], budget=0.1, progress=False)),
        "sampled_bound": (sv.sampled_bound, dict(rho=2, delay=1)),
        "plant": (sv.plant, dict(mechanism=s["mechanism"], forces={"x": -y}, damping={"x": 1.0},
                                 limits={"pull": (-1.0, 2.0)}, rate_limits={"pull": 3.0}, lag={"lift": 0.1}, delay=0.01,
                                 m=3.0)),
        "plant limit": (lambda limit: sv.plant(s["mechanism"], limits={"pull": limit}), dict(limit=2.0)),
        "plant.state": (plant.state, dict(values={"x": 0.1, "y": 0.0, "dx": 0.0, "dy": 0.0})),
        "plant.rates": (plant.rates, dict(t=0.0, x=np.zeros(4), u=np.zeros(2), d=np.zeros(2))),
        "plant.linearised": (plant.linearised, dict(t=[0.0], x=np.zeros((4, 1)), u=np.zeros((2, 1)))),
        "lqr": (sv.lqr, dict(plan=plan, plant=plant, rate=50.0, Q={"x": 10.0}, R={"pull": 1.0}, integral={"X": 1.0},
                             varying=False)),
        "lqr weight": (lambda weight: sv.lqr(plan, plant, Q={"x": weight}), dict(weight=10.0)),
        "pd": (sv.pd, dict(plan=plan, plant=plant, rate=50.0, kp={"pull": 10.0}, kd={"pull": 1.0})),
        "pd gain": (lambda gain: sv.pd(plan, plant, kp={"pull": gain}, kd={"pull": 1.0}), dict(gain=10.0)),
        "computed": (sv.computed, dict(plan=plan, plant=plant, rate=50.0, poles=0.1, delay=0)),
        "feedforward": (sv.feedforward, dict(plan=plan, plant=plant, rate=50.0)),
        "limited": (sv.limited, dict(law=law, plant=bounded, bounds=None,
                                     weights=None, priority=None, horizon=0.2)),
        "output_feedback": (sv.output_feedback, dict(law=law, plant=plant, noise={"x": 1e-3, "y": 1e-3}, process=None)),
        "Sensors": (sv.Sensors, dict(noise=noise, quantisation=noise, seed=1)),
        "Sensors value": (lambda sigma: sv.Sensors({"x": sigma}, seed=1), dict(sigma=1e-3)),
        "Timing": (sv.Timing, dict(rate=100.0, delay=1, substeps=2)),
        "close": (sv.close, dict(plant=plant, law=law, x0=x0, t_span=span, sensors=sv.Sensors(noise, seed=1),
                                 timing=sv.Timing(), disturbance={"x": 1.0}, plan=plan)),
        "close disturbance": (lambda force: sv.close(plant, law, x0, span, disturbance={"x": force}), dict(force=1.0)),
        "close start": (lambda value: sv.close(plant, law, {"x": value, "y": 0.0, "dx": 0.0, "dy": 0.0}, span), dict(value=0.1)),
        "close_many": (sv.close_many, dict(run=closed, cases=[{"m": 2.1}], scale=None, record=["x"], every=10,
                                           executor=1)),
        "close_many case": (lambda m: sv.close_many(closed, [{"m": m}]), dict(m=2.1)),
        "limit_report": (sv.limit_report, dict(run=sv.close(bounded, sv.limited(law, bounded), x0, span), scene=None)),
        "fastest": (sv.fastest, dict(mechanism=s["mechanism"], program=s["program"], limits={"pull": 50.0}, t_span=(0.0, 1.0),
                                     start=None, guess=None, parameters=None, shape=False)),
        "slowed": (sv.Program({"Y": y - ca.sin(t)}).slowed, dict(q=q, factor=2.0, at=0.0)),
        "grid": (lambda a: sv.grid(a=a), dict(a=[1.0, 2.0])),
        "monte_carlo": (lambda n, seed, a: sv.monte_carlo(n, seed=seed, a=a), dict(n=3, seed=1, a=stats.uniform(1.0, 2.0))),
        "sweep": (sv.sweep, dict(case=doubled, cases=[{"a": 1.0}], executor=None, seed=None, progress=False)),
        "sweep value": (lambda value: sv.sweep(lambda a: {"b": value}, [{"a": 1.0}], progress=False), dict(value=1.0)),
        "Study": (sv.types.Study, dict(kind="sweep", columns={"a": [1.0]}, meta={})),
        "Study.column": (study.column, dict(name="a")),
        "Study.where": (lambda a: study.where(a=a), dict(a=1.0)),
        "Study.take": (study.take, dict(rows=[0])),
        "Study.csv": (study.csv, dict(path=os.path.join(folder, "a.csv"))),
        "Study.save": (study.save, dict(path=os.path.join(folder, "study"))),
        "load": (sv.load, dict(path=plan.save(os.path.join(folder, "plan.npz")))),
        "load a study": (sv.load, dict(path=study.save(os.path.join(folder, "again")))),
        "export_c": (sv.export_c, dict(source=s["model"], folder=os.path.join(folder, "c"), name="point",
                                       start=s["model"].start())),
        "run.at": (plan.at, dict(t=0.5)),
        "run.state": (plan.state, dict(t=0.5)),
        "run[]": (plan.__getitem__, dict(name="x")),
        "run.signals": (plan.signals, dict(kind="inputs", rate=0)),
        "run.extrema": (plan.extrema, dict(name="x")),
        "run.save": (plan.save, dict(path=os.path.join(folder, "plan2.npz"))),
        "closed.planned": (closed.planned, dict(name="x")),
        "closed.state": (closed.state, dict(t=0.1)),
        "closed.save": (closed.save, dict(path=os.path.join(folder, "closed.npz"))),
        "law.schedule_at": (law.schedule_at, dict(t=0.1)),
        "start": (s["ideal"].start, dict(t=0.0, guess={"y": 0.1}, y=0.1)),
        "structure": (s["model"].structure, dict(motion=plan.t[3:4], jets=plan.jets[:, 3:4])),
        "with_parameters": (s["model"].with_parameters, dict(m=2.5)),
        "map.eigenvalues": (s["map"].eigenvalues, dict(drift=0.1)),
        "map.radius": (s["map"].radius, dict(method="RK4", step=0.1, drift=None, order=None)),
        "map.largest_step": (s["map"].largest_step, dict(method="RK4", drift=0.1, order=None)),
        "map.plot": (s["map"].plot, dict(method="RK4", poles=None)),
        "with_references": (s["model"].with_references, dict(X=path)),
        "references": (lambda path: sv.coordinates("x y").references(X=path), dict(path=path)),
        "references.d": (q.references(**{f"r{len(q.family)}": None}).d, dict(k=1)),
        "path": (path, dict(t=0.5)),
        "path.jets": (path.jets, dict(t=[0.0, 0.5], order=2)),
        "path.then": (path.then, dict(other=path)),
        "path.at_rate": (path.at_rate, dict(factor=2.0)),
        "path *": (lambda factor: factor * path, dict(factor=2.0)),
        "path +": (lambda other: path + other, dict(other=1.0)),
        "paths.rest_to_rest": (sv.paths.rest_to_rest, dict(start=0.0, end=1.0, duration=1.0, smoothness=4, t_start=0.0)),
        "paths.spline": (sv.paths.spline, dict(times=[0.0, 1.0, 2.0], points=[0.0, 1.0, 0.0], smoothness=2, ends="rest")),
        "paths.trapezoid": (sv.paths.trapezoid, dict(distance=1.0, duration=1.0, ramp=0.2, smoothness=4, t_start=0.0)),
        "paths.s_curve": (sv.paths.s_curve, dict(start=0.0, end=1.0, speed=1.0, acceleration=2.0, jerk=9.0, t_start=0.0)),
        "paths.polynomials": (sv.paths.polynomials, dict(breaks=[0.0, 1.0], coefficients=[[1.0], [0.0]], smoothness=0,
                                                         before="hold", after="hold")),
        "paths.function": (sv.paths.function, dict(f=lambda t: [t**2, 2 * t, 2.0], span=(0.0, 1.0), smoothness=2,
                                                   tolerance=1e-9, before="continue", after=None)),
        "paths.fit": (sv.paths.fit, dict(t=s["times"], x=s["times"]**2, smoothness=2, tolerance=1e-3)),
        "paths.as_path": (sv.paths.as_path, dict(thing=path, smoothness=None, before=None, after=None)),
        "curves.line": (sv.curves.line, dict(s=t, start=(0.0, 0.0), end=(1.0, 1.0))),
        "curves.circle": (sv.curves.circle, dict(angle=t, centre=(0.0, 0.0), radius=1.0, axes=None)),
        "rotations.vectors": (sv.rotations.vectors, dict(rotations=[np.eye(3), np.eye(3)])),
        "figures.signals": (lambda run, names, ax, units: sv.figures.signals(run, names, ax=ax, units=units),
                          dict(run=plan, names=["x"], ax=None, units=None)),
        "figures.actuation": (sv.figures.actuation, dict(run=plan, ax=None, units=None, names=None)),
        "figures.path": (sv.figures.path, dict(run=plan, x="x", y="y", ax=None, units=None)),
        "figures.residuals": (sv.figures.residuals, dict(run=plan, ax=None)),
        "figures.closed": (sv.figures.closed, dict(run=closed, units=None)),
        "figures.sweep": (sv.figures.sweep, dict(study=study, names=["a"], against=None, units=None)),
        "figures.save_figures": (sv.figures.save_figures, dict(run=plan, folder=os.path.join(folder, "figures"), units=None,
                                                           title="")),
    }  # fmt: skip


@functools.cache
def swaying():
    """A cart that carries a pendulum, with its load moved from rest to rest: what the inverse calls need, as a dict."""
    p, q = sv.parameters(M=2.0, m=1.0, g=9.81), sv.coordinates("x a")
    x, a = q
    load = ca.vertcat(x + ca.sin(a), -ca.cos(a))
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.M, x) + sv.particle(q, p.m, load), potential=p.m * p.g * load[1], parameters=p,
        actuators={"cart": x}, outputs={"load": load[0]},
    )  # fmt: skip
    r = q.references(X=sv.paths.rest_to_rest(0.0, 0.2, duration=0.5))
    program = sv.Program({"X": x - r.X})
    model = sv.derive(mechanism, program)
    run = sv.simulate(model, model.start(), (0.0, 0.5), "RK4", t_eval=np.linspace(0.0, 0.5, 51))
    return {"mechanism": mechanism, "program": program, "model": model, "run": run, "plant": sv.plant(mechanism)}


def sliding():
    """The plant of a mass on a line under a force, and a program that moves it from rest to rest in half a second."""
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, x), actuators={"pull": x})
    r = q.references(X=sv.paths.rest_to_rest(0.0, 0.2, duration=0.5))
    return sv.plant(mechanism), sv.Program({"X": x - r.X})


def inverses():
    """Calls that report on programs, invert and relax them, with events, sensitivities and identification."""
    s, sway, span = scene(), swaying(), (0.0, 0.5)
    x, _ = s["q"]
    mechanism, program, plant, closed, free = (s[k] for k in ("mechanism", "program", "plant", "closed", "free"))
    near, slide = s["ideal"].start(y=0.1, dy=0.0), sliding()
    noise = dict.fromkeys(("x", "y", "dx", "dy"), 1e-3)
    log = {"t": closed.t[:8], **{k: v[:8] for k, v in closed.input.items()}, **{k: v[:8] for k, v in closed.measured.items()}}
    event = sv.Event("y", 0.05)
    return {
        "report": (sv.report, dict(what=sway["run"], limits={"cart": 50.0})),
        "report limit": (lambda limit: sv.report(s["plan"], limits={"pull": limit}), dict(limit=50.0)),
        "report mechanism": (sv.report, dict(what=mechanism, start=program)),
        "inverse": (sv.inverse, dict(mechanism=mechanism, program=program, t_span=span, start=None, method=None,
                                     limits={"pull": 50.0}, bounds={"x": (-1.0, 2.0)}, weight=None)),
        "inverse start": (lambda value: sv.inverse(mechanism, program, span, start={"x": value}), dict(value=0.0)),
        "inverse limit": (lambda limit: sv.inverse(mechanism, program, span, limits={"pull": limit}), dict(limit=50.0)),
        "inverse bound": (lambda bound: sv.inverse(mechanism, program, span, bounds={"far": bound}), dict(bound=50.0)),
        "relaxed": (sv.relaxed, dict(plant=slide[0], program=slide[1], t_span=span, weight=1e-4, limits={"pull": 50.0},
                                     bounds={"x": (-1.0, 2.0)}, start=None, end="rest")),
        "relaxed weight": (lambda weight: sv.relaxed(*slide, span, weight={"X": weight}), dict(weight=1e-4)),
        "relaxed limit": (lambda limit: sv.relaxed(*slide, span, limits={"pull": limit}), dict(limit=50.0)),
        "relaxed bound": (lambda bound: sv.relaxed(*slide, span, bounds={"x": bound}), dict(bound=(-1.0, 2.0))),
        "relaxed start": (lambda value: sv.relaxed(*slide, span, start={"x": value}), dict(value=0.0)),
        "relaxed end": (lambda value: sv.relaxed(*slide, span, end={"x": value}), dict(value=1.0)),
        "simulate events": (sv.simulate, dict(model=s["ideal"], start=near, t_span=span, method="RK4",
                                              events={"down": event})),
        "simulate event": (lambda event: sv.simulate(s["ideal"], near, span, "RK4", events=[event]), dict(event=event)),
        "simulate event value": (lambda value: sv.simulate(s["ideal"], near, span, "RK4", events=lambda t, x: value),
                                 dict(value=1.0)),
        "Event": (sv.Event, dict(signal="y", value=0.05, terminal=2, direction=-1.0)),
        "sensitivity": (sv.sensitivity, dict(run=free, of="y", to=["m", "y"])),
        "sensitivity flat": (sv.sensitivity, dict(run=s["plan"], of=["pull"], to="m")),
        "Sensitivity": (sv.sensitivity(free, "y", "m").extrema, dict(of="y")),
        "Sensitivity[]": (sv.sensitivity(free, "y", "m").__getitem__, dict(pair=("y", "m"))),
        "identify": (sv.identify, dict(plant=plant, measured=closed, parameters=["m"], noise=noise, start=None)),
        "identify log": (lambda t, pull, x: sv.identify(plant, log | {"t": t, "pull": pull, "x": x}, ["m"], noise=noise),
                         {k: log[k] for k in ("t", "pull", "x")}),
        "identify guess": (lambda m: sv.identify(plant, closed, {"m": m}, noise=noise), dict(m=1.5)),
        "identify noise": (lambda sigma: sv.identify(plant, closed, ["m"], noise=noise | {"x": sigma}), dict(sigma=1e-3)),
        "identify start": (lambda x: sv.identify(plant, closed, ["m"], noise=noise, start={"x": x}), dict(x=0.0)),
        "Program by wishes": (sv.Program, dict(residuals={"X": x}, weights={"pull": 2.0}, toward={"pull": 1.0})),
        "Program of wishes": (lambda wish: sv.derive(mechanism, sv.Program({"X": x}, toward={"pull": wish})),
                              dict(wish=2.0)),
    }  # fmt: skip


def specifications():
    """Calls by which a designer writes a mechanism and a program."""
    s = scene()
    q, symbols = s["q"], sv.parameters(m=2.0)
    x, y = q
    plain = {"gibbs": sv.particle(q, symbols.m, (x, y)), "parameters": symbols}
    turn = sv.coordinates("a b c")
    angle, *_ = turn
    about_z = ca.vertcat(
        ca.horzcat(ca.cos(angle), -ca.sin(angle), 0), ca.horzcat(ca.sin(angle), ca.cos(angle), 0),
        ca.horzcat(0, 0, 1),
    )  # fmt: skip
    velocity = ca.vertcat(*q.d())
    return {
        "coordinates": (sv.coordinates, dict(names="x y")),
        "parameters": (lambda m: sv.parameters(m=m), dict(m=2.0)),
        "Parameters.values": (symbols.values, dict(changes={"m": 3.0})),
        "quasi-velocities": (lambda names, V, h, invariants: sv.coordinates("x y").with_quasi_velocities(
            names, V, h, invariants), dict(names="u v", V=ca.SX.eye(2), h=None, invariants=None)),
        "q.w": (q.w, dict(k=0)),
        "q.gamma": (q.gamma, dict(k=1)),
        "q.jet": (q.jet, dict(k=1)),
        "q.jet_names": (q.jet_names, dict(k=1)),
        "q.d": (q.d, dict(k=1)),
        "q.dt": (q.dt, dict(expression=x, k=1)),
        "q.order": (q.order, dict(expression=x)),
        "q.derivatives": (q.derivatives, dict(expressions=[x], k=1)),
        "q.where": (q.where, dict(symbol=x)),
        "particle": (sv.particle, dict(q=q, mass=2.0, position=(x, y))),
        "rigid_body": (sv.rigid_body, dict(q=turn, mass=2.0, inertia=(1.0, 1.0, 2.0), position=None, rotation=about_z)),
        "rigid_body rates": (sv.rigid_body, dict(q=turn, mass=2.0, inertia=(1.0, 1.0, 2.0), rates=[0, 0, turn.d()[0]])),
        "body_rates": (sv.body_rates, dict(q=turn, rotation=about_z)),
        "Mechanism": (sv.Mechanism, dict(q=q, potential=x**2, actuators={"pull": x, "lift": y}, forces={"x": -x},
                                         constraints={"rail": y}, outputs={"far": x + y}, **plain)),
        "Mechanism entries": (lambda actuator, force, output: sv.Mechanism(
            q, actuators={"pull": actuator}, forces={"x": force}, outputs={"far": output}, **plain),
            dict(actuator=x, force=-x, output=x + y)),
        "Mechanism kinetic": (sv.Mechanism, dict(q=q, kinetic=ca.dot(velocity, velocity) / 2)),
        "Mechanism balance": (sv.Mechanism, dict(q=q, balance=ca.vertcat(*q.d(2)))),
        "Program": (sv.Program, dict(residuals={"X": x - ca.sin(q.t)}, by="ideal", weights=None, toward=None)),
        "Program residual": (lambda residual: sv.Program({"X": residual}), dict(residual=x - ca.sin(q.t))),
        "Program weight": (lambda weight: sv.Program({"X": x}, weights={"pull": weight}), dict(weight=2.0)),
        "Program wish": (lambda wish: sv.Program({"X": x}, toward={"pull": wish}), dict(wish=2.0)),
        "derive": (sv.derive, dict(mechanism=s["mechanism"], program=s["program"], guess=None)),
    }  # fmt: skip


def further():
    """Calls on models, plants, laws, studies and systems of python-control."""
    s = scene()
    plan, plant, law, ideal = (s[k] for k in ("plan", "plant", "law", "ideal"))
    (_, y), saved, span = s["q"], plan.save(os.path.join(s["folder"], "loaded.npz")), (0.0, 0.2)
    x0 = {"x": 0.1, "y": 0.0, "dx": 0.0, "dy": 0.0}
    trade = sv.tradeoff(ideal, ideal.start(y=0.1, dy=0.0), span, {"RK4": [0.1, 0.05]}, [None], progress=False)
    linear = sv.interop.linearise(plant, 0.0, plan.state(0.0), rate=100.0), sv.interop.linearise(law, 0.0)
    return {
        "simulate accuracy": (sv.simulate, dict(model=ideal, start=ideal.start(y=0.1, dy=0.0), t_span=span,
                                                accuracy=1e-6)),
        "simulate plant": (sv.simulate, dict(model=plant, start=x0, t_span=span, method="RK4", inputs={"pull": 1.0},
                                             t_eval=[0.0, 0.1])),
        "simulate input": (lambda value: sv.simulate(plant, x0, span, "RK4", inputs={"pull": value}), dict(value=1.0)),
        "Bounded": (sv.methods.Bounded, dict(window=10.0, rtol=1e-6)),
        "start hold": (lambda hold: ideal.start(hold=hold), dict(hold={"apart": y - 0.1})),
        "start held value": (lambda value: ideal.start(guess={"y": value}), dict(value=0.1)),
        "start held expression": (lambda value: ideal.start(hold={"apart": value}), dict(value=y - 0.1)),
        "load with model": (sv.load, dict(path=saved, model=s["model"])),
        "internal_dynamics period": (sv.internal_dynamics, dict(run=s["free"], period=1.0)),
        "model.function": (ideal.function, dict(name="ode")),
        "model.signals": (ideal.signals, dict(kind="outputs", rate=0)),
        "run.variant": (plan.variant, dict(i=0)),
        "run.residual": (plan.residual.__getitem__, dict(name="X")),
        "plant.p": (plant.p, dict(u=np.zeros(2), d=np.zeros(2))),
        "plant.function": (plant.function, dict(name="ode")),
        "Sensors.noisy": (sv.Sensors({"x": 1e-3}, seed=1).noisy, dict(measures=("x",), count=3)),
        "Controller": (sv.types.Controller, dict(law=law)),
        "lqr varying": (sv.lqr, dict(plan=plan, plant=plant, rate=50.0, Q=None, R=None, integral=None)),
        "map.growth": (s["map"].growth, dict(method="RK4", step=0.1, drift=None, order=None)),
        "TradeOff.pareto": (trade.pareto, dict(cost="seconds", of="error")),
        "TradeOff.recommend": (lambda error: trade.recommend(error=error), dict(error=1.0)),
        "TradeOff.recommend time": (lambda seconds: trade.recommend(seconds=seconds), dict(seconds=10.0)),
        "TradeOff.plot": (trade.plot, dict(ax=None, cost="seconds", title="", of="error")),
        "figures.efforts": (sv.figures.efforts, dict(run=plan)),
        "disturbances.gust": (sv.disturbances.gust, dict(size=1.0, start=0.0, end=1.0, rise=0.1)),
        "disturbances.step": (sv.disturbances.step, dict(size=1.0, at=0.1)),
        "disturbances.noise": (sv.disturbances.noise, dict(std=1.0, bandwidth=10.0, seed=0)),
        "interop.nlsys": (sv.interop.nlsys, dict(thing=plant, rate=50.0, substeps=2, disturbed=("x",), name="system")),
        "interop.linearise": (sv.interop.linearise, dict(thing=plant, t=0.0, x=plan.state(0.0), u=np.zeros(2),
                                                         rate=None, disturbed=("x",), name=None)),
        "interop.linearise law": (sv.interop.linearise, dict(thing=law, t=0.0, x=None, controller_state=None)),
        "interop.linearise model": (sv.interop.linearise, dict(thing=ideal, t=0.0, x=ideal.start(y=0.1))),
        "interop.along": (lambda **options: list(sv.interop.along(**options)),
                          dict(thing=plant, run=plan, times=[0.0, 0.5])),
        "interop.loop_gain": (sv.interop.loop_gain, dict(plant=linear[0], law=linear[1], at="pull")),
        "interop.start": (sv.interop.start, dict(closed=s["closed"])),
        "sweep case": (sv.sweep, dict(case=doubled, cases=[{"a": 1.0}])),
    }  # fmt: skip


COMMANDS = {  # arguments of the command, each with one place for an odd text
    "report": ["report", "?"],
    "run set": ["run", "constant-speed", "--set", "?"],
    "run hold": ["run", "constant-speed", "--hold", "?"],
    "run span": ["run", "constant-speed", "--t-span", "0", "?"],
    "run method": ["run", "constant-speed", "--method", "?"],
    "run rtol": ["run", "constant-speed", "--rtol", "?"],
    "run out": ["run", "constant-speed", "--no-figures", "--no-verify", "--out", "?"],
    "export": ["export", "constant-speed", "--out", "c", "--name", "?"],
    "cache": ["cache", "?"],
}
TEXTS = ("", "abc", "x=", "x=nan", "=1", "a\0b", "\ud800", "nan", "1e400", "-1", "-", "--", "n" * 300, "\n")


def commands():
    """Calls of the command line by name."""

    def command(arguments):
        def call(text):
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
                try:
                    code = main([text if part == "?" else part for part in arguments])
                except SystemExit as error:
                    code = error.code
            if code == 2:
                raise ServoError("refused")

        return call

    return {f"servoctl {name}": command(arguments) for name, arguments in COMMANDS.items()}


def doubled(a):
    """A case of a sweep."""
    return {"b": 2.0 * a}


def outcome(call, arguments):
    """How a call ends: "accepted", "refused", "hangs", or the error of another package."""
    try:
        with warnings.catch_warnings(), at_most(MOST_CALLS):
            warnings.simplefilter("ignore")
            call(**arguments)
    except ServoError:
        return "refused"
    except TooMuchWork:
        return "hangs"
    except Exception as error:
        where = f" ({type(error).__name__})"
        return f"{str(error).splitlines()[0][:90] if str(error) else 'no text'}{where}"
    finally:
        plt.close("all")
    return "accepted"


def fuzz(only=()):
    """Outcomes by (call, argument, odd value)."""
    outcomes = {}
    for name, (call, arguments) in (calls() | inverses() | specifications() | further()).items():
        if only and not any(word in name for word in only):
            continue
        good = outcome(call, arguments)
        assert good == "accepted", f"{name} with good arguments: {good}"
        for argument in arguments:
            for odd in FEW if name.startswith(SLOW) else ODD:
                with contextlib.redirect_stdout(None):
                    outcomes[name, argument, odd] = outcome(call, {**arguments, argument: ODD[odd]})
    for name, call in commands().items():
        if not only or any(word in name for word in only):
            outcomes |= {(name, "text", repr(text)[:20]): outcome(call, {"text": text}) for text in TEXTS}
    return outcomes


def leaks(outcomes):
    """Outcomes in which an argument was neither accepted nor refused in words."""
    return {f"{name}({argument}={odd})": text for (name, argument, odd), text in outcomes.items() if text not in WORDS}


def script():
    """Print leaks and hangs, and how often each outcome came."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", default=())
    parser.add_argument("--accepted", action="store_true", help="print what is accepted, too")
    args = parser.parse_args()
    matplotlib.use("Agg")
    os.chdir(tempfile.mkdtemp())
    outcomes = fuzz(args.only)
    for (name, argument, odd), text in outcomes.items():
        if text not in WORDS or (args.accepted and text == "accepted"):
            print(f"{name}({argument}={odd}): {text}")
    print(Counter(text if text in (*WORDS, "hangs") else "leak" for text in outcomes.values()))


if __name__ == "__main__":
    script()
