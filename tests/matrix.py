"""Every scene, and ten more machines, in other coordinates and from other guesses; by hand, half an hour of CPU time.

    python tests/matrix.py [--scenes NAME ...] [--log FILE]

In other coordinates (origins, zeros of angles, units, axes, names) a program has the same verdict, flatness, method and
signals. From guesses that are off by a part of the motion's size it has the plan of its rest; where it begins in motion
it has that of its start, with a warning where the first transient exceeds all later peaks. A line is printed for each
case, and a table at the end. What the log has is not run again.
"""

import argparse
import json
import os
import re
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import test_no_special_origin as origins
import test_strangers as strangers
from moved import moved, values

import servoctl as sv
from servoctl.errors import ServoError
from servoctl.gallery import Scene, gallery

FLAT, INTEGRATED, RELAXED = 1e-9, 1e-7, 1e-6  # of a signal's size: instant by instant; ten times a tolerance; a least
SMALLEST = 1e-6  # of the largest signal of its kind: what is smaller has no size of its own
LONG = 60.0  # CPU s of a plan, beyond which a scene gets one change only
PARTS = (0.05, 0.3)  # of the motion's size, by which guesses are off


def machine(build, guess=None, duration=6.0, lengths="x l X Z", **options):
    """A machine of the tests as a scene that says which coordinates are lengths."""
    return Scene(partial(_in_units, build, lengths.split(), options), "", guess=guess or {}, t_span=(0.0, duration))


def _in_units(build, lengths, options):
    mechanism, program = build(**options)
    mechanism.units = {name: "m" if name in lengths else "rad" for name in mechanism.q.names} | mechanism.units
    return mechanism, program


MACHINES = {
    "crab-crane": machine(origins.crab_crane),
    "crab-crane-undamped": machine(origins.crab_crane, inertia=1.5, damping=0.0),
    "crab-crane-of-a-point": machine(origins.crab_crane, inertia=0.0),
    "damped-crane": machine(origins.damped_crane, {"l": 4.0}),
    "crane-in-redundant-coordinates": machine(origins.redundant_crane, {"l": 4.0}),
    "tool-below": machine(origins.tool_below),
    "arm-on-a-spring": machine(origins.passive_arm, duration=3.0),
    "slewing-crane": machine(strangers.slewing_crane, {"l": 3.0, "luff": 0.8}, lengths="l"),
    "elastic-arm": machine(strangers.elastic_arm, duration=2.0),
    "arm-on-a-circle": machine(strangers.arm_on_a_circle, strangers.CIRCLE, duration=3.0),
}
SCENES = {**gallery, **MACHINES}


def changes(mechanism):
    """Other coordinates: {label: (shifts, scales, whether names are reversed)}."""
    q, fixed = mechanism.q, {i for places, _ in mechanism.q.spheres for i in places}
    names = [name for i, name in enumerate(q.names) if i not in fixed]
    lengths = [name for name in names if mechanism.units.get(name) == "m"]
    angles = [name for name in names if mechanism.units.get(name) == "rad"]
    found = {"names": ({}, {}, True)}
    if names:
        found["mirrored"] = {}, dict.fromkeys(names, -1.0), False
    for shift in (1.0, -1.0, 10.0, -10.0, 100.0) if lengths else ():
        found[f"lengths {shift:+g}"] = dict.fromkeys(lengths, shift), {}, False
    for shift in (0.3, np.pi / 2, np.pi, 6.0) if angles else ():
        found[f"angles {shift:+.2g}"] = dict.fromkeys(angles, shift), {}, False
    for unit, scale in {"mm": 1e-3, "km": 1e3}.items() if lengths else ():
        found[unit] = {}, dict.fromkeys(lengths, scale), False
    return found


def plan(build, span, guess, held):
    """A plan: the inverse of a program that rests where it begins, else its motion; in words and numbers, with errors."""
    begun, run, said, facts = time.process_time(), None, "", {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            model = sv.derive(*build, {**guess, **held} or None)
            state = model.start(span[0], guess, **held)
            if state.values[model.nq :].any():
                facts["verdict"] = sv.report(model, state).verdict
                run = sv.simulate(model, state, span)
            else:
                run = sv.inverse(*build, span, start={**guess, **held})
                told = re.search(r"as the program is ([^(]*?) \(|as (.*)", run.message)
                facts["verdict"] = told[1] or told[2]
            facts |= {"method": run.method, "flat": run.model.flat}
        except ServoError as error:
            run, said = getattr(error, "run", None), f"{type(error).__name__}: {error}"
    facts["error"] = said.partition(":")[0]
    more = {"seconds": round(time.process_time() - begun, 1), "said": said, "warned": [str(w.message) for w in caught]}
    return run, facts, more


def signals(run, mechanism, names, shifts, scales):
    """Coordinates and forces of a run by the names of the mechanism: {kind: {name: values}}."""
    units, forces, found = mechanism.units, {*mechanism.actuators, *mechanism.outputs}, {}
    for name in (*mechanism.q.names, *(name for name in run.names if name not in mechanism.q.names)):
        if name in mechanism.q.names:
            kind, value = units.get(name, ""), run[names[name]] * scales.get(name, 1.0) + shifts.get(name, 0.0)
            value = value - (2 * np.pi * np.round(value[0] / (2 * np.pi)) if kind == "rad" else 0.0)
            found.setdefault(kind, {})[name] = value
        elif name in run.names and (name in forces or name.startswith("multiplier_")):
            found.setdefault("forces", {})[name] = run[name]
    return found


def differing(facts, others):
    """Facts that differ, with both values."""
    return {key: [facts.get(key), others.get(key)] for key in facts | others if facts.get(key) != others.get(key)}


def worst(run, other, mechanism, names=None, shifts=None, scales=None, offsets=False):
    """The largest difference of a signal of two runs beside its size and tolerance, and its name; inf if times differ.

    With offsets, coordinates are compared by how far they move: where a rest may be anywhere, the guess says where.
    """
    same = names or dict(zip(mechanism.q.names, mechanism.q.names, strict=True))
    a = signals(run, mechanism, dict(zip(same, same, strict=True)), {}, {})
    b = signals(other, mechanism, same, shifts or {}, scales or {})
    if run.t.shape != other.t.shape or np.abs(run.t - other.t).max() > 1e-6 * np.ptp(run.t):
        return np.inf, f"times {run.t[[0, -1]].tolist()} and {other.t[[0, -1]].tolist()}"
    tolerance = {"algebraic": FLAT, "relaxed": RELAXED}.get(run.method, INTEGRATED)
    found = []
    for kind, some in a.items():
        sizes = {name: np.nanmax(np.abs(value)) for name, value in some.items()}
        for name, value in some.items():
            size = max(sizes[name], SMALLEST * max(sizes.values()), 1e-300)
            difference = value - b[kind][name]
            difference = difference - (difference[0] if offsets and kind != "forces" else 0.0)
            found.append((float(np.nanmax(np.abs(difference)) / size / tolerance), name))
    return max(found)


def in_other_coordinates(name, log):
    """A line for each change of coordinates."""
    scene, (mechanism, program) = SCENES[name], SCENES[name].build()
    found = changes(mechanism)
    run, facts, more = plan((mechanism, program), scene.t_span, scene.guess, scene.start)
    if more["seconds"] > LONG:
        found = {"mirrored": found["mirrored"]}
    for label, (shifts, scales, reverse) in found.items():
        if log.has(name, label):
            continue
        machine, other, names = moved(mechanism, program, shifts, scales, reverse)
        there = [values(some, names, shifts, scales) for some in (scene.guess, scene.start)]
        run_there, facts_there, more_there = plan((machine, other), scene.t_span, *there)
        both = run is not None and run_there is not None
        off, signal = worst(run, run_there, mechanism, names, shifts, scales) if both else (0.0, "")
        unlike = differing(facts, facts_there)
        fine = not unlike and off <= 1.0
        log.add(name, label, fine, off=off, signal=signal, unlike=unlike, method=facts.get("method", facts["error"]),
                **more_there, warned_here=more["warned"])  # fmt: skip


def transient(run):
    """By how much a force begins above all that it reaches once it stops falling, and which; independent of remarks."""
    names = [name for name in run.model.actuators if name in run.names]
    found = [(0.0, "")]
    for name in names:
        size = np.abs(run[name])
        rises = np.flatnonzero(np.diff(size) >= 0)
        later = size[rises[0] :].max() if len(rises) else size[-1]
        found.append((float(size[0] / max(later, 1e-9 * size.max(), 1e-300)), name))
    return max(found)


def from_other_guesses(name, log):
    """A line for each guess that is off."""
    scene, (mechanism, program) = SCENES[name], SCENES[name].build()
    model = sv.derive(mechanism, program, (scene.guess | scene.start) or None)
    start = model.start(scene.t_span[0], scene.guess | scene.start)
    run, facts, _ = plan((mechanism, program), scene.t_span, scene.guess | scene.start, {})
    free = [n for n in model.state_names if n in {*scene.guess, *scene.start, *start.free}]
    rests = not start.values[model.nq :].any()
    sizes = {n: np.ptp(run[n]) or np.abs(run[n]).max() or 1.0 for n in free} if run is not None else {}
    for part in PARTS if sizes else ():
        for k, sign in enumerate((1.0, -1.0)):
            label = f"guess off by {sign * part:+.0%}"
            if log.has(name, label):
                continue
            off_by = {n: part * sign * (-1) ** (k * i) * sizes[n] for i, n in enumerate(free)}
            guess = {n: float(start[n] + off_by[n]) for n in free}
            if rests:
                other, facts_there, more = plan((mechanism, program), scene.t_span, guess, {})
                off, signal = worst(run, other, mechanism, offsets=True) if other is not None else (np.inf, "")
                unlike = differing(facts, facts_there)
                log.add(name, label, off <= 1.0 and not unlike, off=off, signal=signal, unlike=unlike, **more)
            else:
                log.add(name, label, **_in_motion(mechanism, program, scene, guess))


def _in_motion(mechanism, program, scene, guess):
    """The plan from a guess of a program that begins in motion: what its start keeps, and what is said of its begin."""
    run, said, begun = None, "", time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            model = sv.derive(mechanism, program, guess)
            start = model.start(scene.t_span[0], guess)
            run = sv.simulate(model, start, scene.t_span)
        except ServoError as error:
            run, said = getattr(error, "run", None), f"{type(error).__name__}: {error}"
    if run is None:
        return {"fine": False, "said": said, "seconds": time.process_time() - begun}
    remarks = [text for text in sv.verify(run.model, run).remarks if "first transient" in text]
    above, force = transient(run)
    kept = all(abs(start[n] - guess[n]) <= 1e-9 * (1.0 + abs(guess[n])) for n in start.free if n in guess)
    return {"fine": kept and bool(remarks) == (above > 1.01), "above": above, "signal": force, "remarks": remarks,
            "kept": kept, "free": start.free, "said": said, "seconds": round(time.process_time() - begun, 1)}  # fmt: skip


class Log:
    """Lines of JSON in a file, and those of earlier runs."""

    def __init__(self, path):
        self.path = Path(path)
        self.lines = [json.loads(line) for line in self.path.read_text().splitlines()] if self.path.exists() else []

    def has(self, name, label):
        return any(line["scene"] == name and line["case"] == label for line in self.lines)

    def add(self, name, label, fine, **facts):
        self.lines.append({"scene": name, "case": label, "fine": bool(fine), **facts})
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(self.lines[-1]) + "\n")
        told = {key: facts[key] for key in ("off", "signal", "unlike", "above", "said", "seconds") if facts.get(key)}
        print(f"{name:28}{label:20}{'same' if fine else 'OTHER':7}{told}"[:300], flush=True)

    def table(self, names):
        print(f"\n{'scene':32}{'cases':>6}{'same':>6}{'worst, of the tolerance':>26}")
        for name in names:
            some = [line for line in self.lines if line["scene"] == name]
            offs = [line["off"] for line in some if line["fine"] and "off" in line]
            print(f"{name:32}{len(some):6}{sum(line['fine'] for line in some):6}{max(offs, default=0.0):26.2g}")
            for line in some:
                if not line["fine"]:
                    print(
                        f"    {line['case']}: " + str({key: line.get(key) for key in ("off", "unlike", "above")})[:200]
                    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[*SCENES], metavar="NAME")
    parser.add_argument("--log", default=os.path.join(os.environ.get("TMPDIR", "/tmp"), "matrix.jsonl"))
    arguments = parser.parse_args()
    log = Log(arguments.log)
    for name in arguments.scenes:
        in_other_coordinates(name, log)
        from_other_guesses(name, log)
    log.table(arguments.scenes)
