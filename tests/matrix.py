"""Every scene, and ten more machines, in other coordinates and from other guesses; by hand, half an hour of CPU time.

    python tests/matrix.py [--scenes NAME ...] [--log FILE]

In other coordinates (origins, zeros of angles, units, axes, names) a program has the same verdict, flatness, method and
signals. From guesses that are off by a part of the motion's size it has the plan of its rest; where it begins in motion
it has that of its start, with a warning where the first transient exceeds all later peaks. A line is printed for each
case, and a table at the end. What the log has is not run again.
"""

import argparse
import json
import re
import tempfile
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
SHIFTS, ZEROS, UNITS = (1.0, -1.0, 10.0, -10.0, 100.0), (0.3, np.pi / 2, np.pi, 6.0), {"mm": 1e-3, "km": 1e3}
PARTS = (0.05, -0.05, 0.3, -0.3)  # of the motion's size, by which guesses are off
MACHINES = {  # builder, guess, duration [s], lengths; the other coordinates are angles
    "crab-crane": (origins.crab_crane, {}, 6.0, "x"),
    "crab-crane-undamped": (partial(origins.crab_crane, inertia=1.5, damping=0.0), {}, 6.0, "x"),
    "crab-crane-of-a-point": (partial(origins.crab_crane, inertia=0.0), {}, 6.0, "x"),
    "damped-crane": (origins.damped_crane, {"l": 4.0}, 6.0, "x l"),
    "crane-in-redundant-coordinates": (origins.redundant_crane, {"l": 4.0}, 6.0, "x l X Z"),
    "tool-below": (origins.tool_below, {}, 6.0, "x"),
    "arm-on-a-spring": (origins.passive_arm, {}, 3.0, ""),
    "slewing-crane": (strangers.slewing_crane, {"l": 3.0, "luff": 0.8}, 6.0, "l"),
    "elastic-arm": (strangers.elastic_arm, {"elbow": 1.0}, 2.0, ""),
    "arm-on-a-circle": (strangers.arm_on_a_circle, strangers.CIRCLE, 3.0, ""),
}
SCENES = gallery | {n: Scene(build, "", guess=g, t_span=(0.0, end)) for n, (build, g, end, _) in MACHINES.items()}


def built(name):
    """A mechanism, whose coordinates have units, and its program."""
    mechanism, program = SCENES[name].build()
    lengths = MACHINES[name][-1].split() if name in MACHINES else []
    return _with({n: "m" if n in lengths else "rad" for n in mechanism.q.names}, mechanism), program


def _with(units, mechanism):
    mechanism.units = units | mechanism.units
    return mechanism


def changes(mechanism):
    """Other coordinates: {label: (shifts, scales, whether names are reversed)}; quaternions only get other names."""
    q, fixed = mechanism.q, {i for places, _ in mechanism.q.spheres for i in places}
    names = [name for i, name in enumerate(q.names) if i not in fixed]
    lengths, angles = ([n for n in names if mechanism.units.get(n) == unit] for unit in ("m", "rad"))
    found = {"names": ({}, {}, True), "mirrored": ({}, dict.fromkeys(names, -1.0), False)}
    found |= {f"lengths {c:+g}": (dict.fromkeys(lengths, c), {}, False) for c in SHIFTS if lengths}
    found |= {f"angles {c:+.2g}": (dict.fromkeys(angles, c), {}, False) for c in ZEROS if angles}
    return found | {unit: ({}, dict.fromkeys(lengths, s), False) for unit, s in UNITS.items() if lengths}


def plan(build, span, guess, held):
    """A plan: the inverse of a program that rests where it begins, else its motion; facts, and what more is told."""
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
    forces, found = {*mechanism.actuators, *mechanism.outputs}, {"forces": {}}
    for name in mechanism.q.names:
        kind, value = mechanism.units.get(name, ""), run[names.get(name, name)] * scales.get(name, 1.0)
        value = value + shifts.get(name, 0.0)
        value = value - (2 * np.pi * np.round(value[0] / (2 * np.pi)) if kind == "rad" else 0.0)
        found.setdefault(kind, {})[name] = value
    found["forces"] = {n: run[n] for n in run.names if n in forces or n.startswith("multiplier_")}
    return found


def compared(mechanism, one, other, names=(), shifts=(), scales=(), offsets=False):
    """Facts that differ, and the largest difference of a signal, beside its size and tolerance; inf if times differ.

    With offsets, coordinates are compared by how far they move: where a rest may be anywhere, the guess says where.
    """
    (run, facts), (there, facts_there) = one, other
    unlike = {k: [facts.get(k), facts_there.get(k)] for k in facts | facts_there if facts.get(k) != facts_there.get(k)}
    if run is None or there is None:
        return {"fine": not unlike, "off": 0.0, "unlike": unlike}
    if run.t.shape != there.t.shape or np.abs(run.t - there.t).max() > 1e-6 * np.ptp(run.t):
        return {"fine": False, "off": np.inf, "unlike": unlike, "ends": [run.t[-1], there.t[-1]]}
    a, b = signals(run, mechanism, {}, {}, {}), signals(there, mechanism, dict(names), dict(shifts), dict(scales))
    tolerance, found = {"algebraic": FLAT, "relaxed": RELAXED}.get(run.method, INTEGRATED), []
    for kind, some in a.items():
        sizes = {name: np.nanmax(np.abs(value)) for name, value in some.items()}
        for name, value in some.items():
            difference = value - b[kind][name]
            difference = difference - (difference[0] if offsets and kind != "forces" else 0.0)
            size = max(sizes[name], SMALLEST * max(sizes.values()), 1e-300)
            found.append((float(np.nanmax(np.abs(difference)) / size / tolerance), name))
    off, signal = max(found)
    return {"fine": off <= 1.0 and not unlike, "off": off, "signal": signal, "unlike": unlike}


def in_other_coordinates(name, log):
    """A line for each change of coordinates."""
    scene, build = SCENES[name], built(name)
    left = {label: change for label, change in changes(build[0]).items() if not log.has(name, label)}
    run, facts, more = plan(build, scene.t_span, scene.guess, scene.start) if left else ({}, {}, {"seconds": 0.0})
    for label, change in list(left.items())[: 1 if more["seconds"] > LONG else None]:
        *there, names = moved(*build, *change)
        known = [values(some, names, *change[:2]) for some in (scene.guess, scene.start)]
        run_there, facts_there, more_there = plan(there, scene.t_span, *known)
        found = compared(build[0], (run, facts), (run_there, facts_there), names, *change[:2])
        log.add(name, label, **found, **more_there, warned_here=more["warned"])


def transient(run):
    """By how much a force begins above all that it reaches once it stops falling, and which; independent of remarks."""
    found = [(0.0, "")]
    for name in set(run.model.actuators) & set(run.names):
        size = np.abs(run[name])
        later = size[np.append(np.diff(size) >= 0, True).argmax() :].max()
        found.append((float(size[0] / max(later, 1e-9 * size.max(), 1e-300)), name))
    return max(found)


def from_other_guesses(name, log):
    """A line for each guess that is off in all free values, by turns of one sign and of both."""
    scene, build, known = SCENES[name], built(name), SCENES[name].guess | SCENES[name].start
    left = {label: part for part in PARTS if not log.has(name, label := f"guess off by {part:+.0%}")}
    run, facts, _ = plan(build, scene.t_span, known, {}) if left else (None, {}, {})
    start = sv.derive(*build, known or None).start(scene.t_span[0], known) if run is not None else None
    rates = np.abs(run.jets[build[0].q.nq :]) if start else np.zeros((1, 1))
    moves = rates[:, 0].max() > 1e-3 * rates.max()  # a bounded motion has almost left its rest
    free = start.free if moves else [n for n in start.names if n in {*known, *start.free}] if start else ()
    for label, part in left.items() if free else ():
        sizes = [np.ptp(run[n]) or np.abs(run[n]).max() or 1.0 for n in free]
        signs = [1.0 if part > 0 else -((-1.0) ** i) for i in range(len(free))]
        guess = {n: float(start[n] + abs(part) * s * d) for n, s, d in zip(free, signs, sizes, strict=True)}
        if moves:
            log.add(name, label, **_in_motion(build, scene, guess))
        else:
            other, facts_there, more = plan(build, scene.t_span, guess, {})
            log.add(name, label, **compared(build[0], (run, facts), (other, facts_there), offsets=True), **more)


def _in_motion(build, scene, guess):
    """The plan from a guess of a program that begins in motion: what its start keeps, and what is said of its begin."""
    run, facts, more = plan(build, scene.t_span, guess, {})
    if run is None:
        return {"fine": False, **more}
    remarks = [text for text in sv.verify(run).remarks if "first transient" in text]
    (above, force), free = transient(run), run.start.free
    kept = all(abs(run.start[n] - guess[n]) <= 1e-9 * (1.0 + abs(guess[n])) for n in free if n in guess)
    fine = kept and bool(remarks) == (above > 1.01)
    return {"fine": fine, "above": above, "signal": force, "remarks": remarks, "kept": kept, "free": free, **more}


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
        print(f"{name:31}{label:20}{'same' if fine else 'OTHER':6}{told(facts, 'seconds')}"[:300], flush=True)

    def table(self, names):
        print(f"\n{'scene':32}{'cases':>6}{'same':>6}{'worst of these, of the tolerance':>34}")
        for name in names:
            some = [line for line in self.lines if line["scene"] == name]
            worst = max((line.get("off", 0.0) for line in some if line["fine"]), default=0.0)
            print(f"{name:32}{len(some):6}{sum(line['fine'] for line in some):6}{worst:34.2g}")
            others = (f"    {line['case']}: {told(line)}" for line in some if not line["fine"])
            print("".join(line[:200] + "\n" for line in others), end="")


def told(facts, *more):
    return {k: facts[k] for k in ("off", "signal", "unlike", "ends", "above", "kept", "said", *more) if facts.get(k)}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=[*SCENES], metavar="NAME")
    parser.add_argument("--log", default=Path(tempfile.gettempdir(), "matrix.jsonl"))
    arguments = parser.parse_args()
    log = Log(arguments.log)
    for name in arguments.scenes:
        in_other_coordinates(name, log)
        from_other_guesses(name, log)
    log.table(arguments.scenes)
