"""Verdicts: what is right passes, what is wrong fails or is refused, what cannot be followed is inconclusive."""

import importlib
import pickle
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.codegen.function import Compiled
from servoctl.gallery import gallery
from servoctl.methods.choice import as_method
from servoctl.verification import between as intervals

checks = importlib.import_module("servoctl.verification.verify")
CHANGE = 1.001


def verdict(run):
    """The verdict, or "refused"."""
    try:
        return sv.verify(run).verdict
    except sv.errors.ServoError:
        return "refused"


def edited(run, **parts):
    return replace(run, **{"stored": {}, "stored_residual": {}} | parts)


def scaled(values, which=slice(None)):
    values = values.copy()
    values[which] *= CHANGE
    return values


# what is right --------------------------------------------------------------------------------------------------------


def rod():
    """A pendulum under an ideal program, released at rest at the height where its energy is zero."""
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=9.81 * y)
    model = sv.derive(mechanism, sv.Program({"rod": x**2 + y**2 - 1}, by="ideal"))
    return model, model.start(x=1.0, y=0.0, dx=0.0, dy=0.0), (0.0, 2.0)


def uniform(by):
    """An arm whose joints turn with constant speeds: no acceleration at all."""
    q = sv.coordinates("a b")
    a, b = q
    middle, tip = (ca.cos(a) / 2, ca.sin(a) / 2), (ca.cos(a) + ca.cos(b), ca.sin(a) + ca.sin(b))
    gibbs = sv.particle(q, 1.0, middle) + sv.particle(q, 1.0, tip)
    motors = {"actuators": {"u": a, "v": b}} if by == "actuators" else {}
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=9.81 * (middle[1] + tip[1]), **motors)
    model = sv.derive(mechanism, sv.Program({"a": a - 0.3 * q.t, "b": b - 0.7 * q.t}, by=by))
    return model, model.start(), (0.0, 5.0)


def acceleration(free):
    """The magnitude of the acceleration is given, and one coordinate has no force."""
    q = sv.coordinates("x y")
    x, y = q
    d2 = q.d(2)
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, y)), potential=free * x**2, actuators={"F": x})
    model = sv.derive(mechanism, sv.Program({"a": d2[0] ** 2 + d2[1] ** 2 - 100}))
    return model, model.start(guess={"d2x": 10.0}), (0.0, 0.5)


def ropes(stiffness):
    """Two trolleys carry a load by two ropes that stretch."""
    q = sv.coordinates("a b x z")
    a, b, x, z = q
    lengths = (ca.sqrt((x - s) ** 2 + z**2) for s in (a, b))
    gibbs = sum(sv.particle(q, 20.0, (s,)) for s in (a, b)) + sv.particle(q, 100.0, (x, z))
    potential = sum(stiffness * (length - 5) ** 2 / 2 for length in lengths) + 981.0 * z
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=potential, actuators={"A": a, "B": b})
    program = sv.Program({"x": x - 0.1 * ca.sin(q.t), "z": z + 4 + 0.05 * ca.cos(q.t)})
    guess = {"a": -3.0, "b": 3.0, "z": -4.0}
    model = sv.derive(mechanism, program, guess=guess)
    return model, model.start(guess=guess), (0.0, 5.0)


def chain(k=2.0, path=lambda t: ca.sin(t), by="actuators", program=None):
    """Two masses joined by a spring; the motor moves the first, the program the second."""
    q = sv.coordinates("x y")
    x, y = q
    p = sv.parameters(k=k, pace=1.0)
    motor = {"actuators": {"F": x}} if by == "actuators" else {}
    gibbs = sv.particle(q, 1.0, (x,)) + sv.particle(q, 1.0, (y,))
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=p.k * (x - y) ** 2 / 2, parameters=p, **motor)
    rows = {"y": y - path(p.pace * q.t)} if program is None else program(q)
    model = sv.derive(mechanism, sv.Program(rows, by=by))
    return model, model.start(guess={"x": 0.0}), (0.0, 2.0)


def nearly(q):
    """Two programs that differ by a thousandth."""
    x, y = q
    row = x - ca.sin(q.t)
    return {"a": row, "b": 0.7 * row + 1e-3 * (y - 0.3 * ca.cos(q.t))}


def leaning(lean, by="actuators", order=0):
    """A point on a weightless rod: the mass matrix is singular where the rod is upright, the program leaves no doubt."""
    q = sv.coordinates("y lean")
    y, b = q
    gibbs = sv.particle(q, 80.0, (y + ca.sin(b), ca.cos(b)))
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=785.0 * ca.cos(b), actuators={"side": y})
    program = sv.Program({"y": q.dt(y - 0.1 * ca.sin(2 * q.t), order)}, by=by)
    model = sv.derive(mechanism, program)
    free = {"y": 0.0, "dy": 0.2, "d2y": 0.0} if order else {}
    return model, model.start(lean=lean, dlean=0.02, **free), (0.0, 0.2)


def dependent(share, by):
    """Rows that differ by a share of their size; ideal reactions and redundant inputs are then sums of large terms."""
    q = sv.coordinates("x y z")
    x, y, z = q
    wave = ca.sin(x) if by == "ideal" else 0.0
    path = x - 0.3 * ca.sin(q.t) - 0.2 * wave * z, y - 0.2 * ca.cos(z) - 0.1 * q.t, z - 0.3 * ca.sin(x) + 0.4 * ca.sin(q.t)
    gibbs = ca.sumsqr(ca.vertcat(*q.d(2))) / 2 + sv.particle(q, 0.7, (0.4 * x + ca.sin(y) - 0.3 * z,))
    motors = {} if by == "ideal" else {"actuators": {"u": x, "v": y, "w": y + 0.3 * ca.sin(z)}}
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=0.8 * x * y + 0.5 * z**2, **motors)
    rows = {"a": path[0], "b": 0.7 * path[0] + share * path[1]}
    rows |= {"c": -0.2 * path[1] + share * path[2]} if by == "ideal" else {}
    model = sv.derive(mechanism, sv.Program(rows, by=by))
    free = {} if by == "ideal" else {"z": 0.2, "dz": 0.3}
    return model, model.start(guess=free), (0.0, 1.0)


RIGHT = {
    "rod": (rod, None),
    "rod, Taylor": (rod, "Taylor"),
    "uniform": (lambda: uniform("actuators"), None),
    "uniform, integrated": (lambda: uniform("actuators"), "DOP853"),
    "uniform, ideal": (lambda: uniform("ideal"), None),
    "acceleration": (lambda: acceleration(0.0), None),
    "acceleration beside a spring": (lambda: acceleration(1.0), "Taylor"),
    "ropes": (lambda: ropes(4e6), None),
    "stiffer ropes": (lambda: ropes(4e8), None),
    "stiff spring": (lambda: chain(1e10), None),
    "upright rod": (lambda: leaning(0.0), None),
    "almost upright rod, ideal": (lambda: leaning(1e-8, "ideal"), None),
    "nearly dependent": (lambda: chain(by="ideal", program=nearly), None),
    "nearly dependent, twice": (lambda: dependent(1e-5, "ideal"), None),
    "nearly dependent, redundant": (lambda: dependent(1e-9, "actuators"), None),
}


@pytest.mark.parametrize("name", RIGHT)
def test_what_is_right_passes(name):
    build, method = RIGHT[name]
    model, start, span = build()
    proof = sv.verify(sv.simulate(model, start, span, method))
    assert proof.verdict == "passed" and proof.passed, proof


@pytest.mark.parametrize("share, by", [(1e-5, "ideal"), (1e-9, "actuators")])
def test_rounding_of_nearly_dependent_rows_excuses_no_other_force(share, by):
    model, start, span = dependent(share, by)
    run = sv.simulate(model, start, span)
    names, forces = run.signals("reaction" if model.reduction.ideal else "actuation")
    for name, force in zip(names, forces, strict=True):
        stored = {name: force + 5e-6 * np.abs(forces).max()}
        assert "signals" in sv.verify(replace(run, stored=stored)).failures


@pytest.mark.parametrize("eps", [0.1, 1e-3])
def test_a_pivot_may_vanish_at_an_instant_of_the_checks(eps):
    """The row's leading entry x − 20 vanishes at 2.375 s, where the other one, eps, keeps the rank."""
    q = sv.coordinates("x y z")
    (x, *_), (_, dy, dz) = q, q.d(1)
    mechanism = sv.Mechanism(q, gibbs=ca.sumsqr(ca.vertcat(*q.d(2))) / 2)
    model = sv.derive(mechanism, sv.Program({"p": (x - 20.0) * dy + eps * dz - ca.cos(q.t)}, by="ideal"))
    start = model.start(x=1.0, y=0.0, z=0.0, dx=8.0, dz=0.3)
    run = sv.simulate(model, start, (0.0, 3.0), "DOP853", t_eval=[0.0, 2.3, 2.37, 2.38, 3.0])
    assert sv.verify(run).passed


@pytest.mark.parametrize("samples", [2, 3, 11, 2001])
@pytest.mark.parametrize("name", ["appell-hamel", "overhead-crane", "vtol", "spiral"])
def test_the_verdict_does_not_depend_on_the_samples(name, samples, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    start, t_eval = model.start(**scene.start, guess=scene.guess), np.linspace(*scene.t_span, samples)
    run = sv.simulate(model, start, scene.t_span, t_eval=t_eval)
    proof = sv.verify(run)
    assert proof.passed and {"segments", "energy"} <= set(proof.numbers), proof


@pytest.mark.parametrize("samples", [201, 4001])
def test_pivots_that_vanish_between_samples_are_replaced(samples):
    """A load under an aircraft that turns over: pivots change many times."""
    q = sv.coordinates("x z theta phi")
    x, z, theta, phi = q
    load = (x + ca.sin(phi), z - ca.cos(phi))
    gibbs = sv.particle(q, 1.0, (x, z)) + sv.particle(q, 0.3, load) + 0.02 * q.d(2)[2] ** 2 / 2
    thrust = {"thrust": [-ca.sin(theta), ca.cos(theta), 0, 0], "moment": theta}
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=9.81 * (z + 0.3 * load[1]), actuators=thrust)
    w = ca.pi / 2
    program = sv.Program({"X": load[0] - 1.5 * ca.sin(w * q.t), "Z": load[1] - ca.sin(2 * w * q.t)})
    model = sv.derive(mechanism, program, guess={"z": 1.0})
    run = sv.simulate(model, model.start(guess={"z": 1.0}), (0.0, 4.0), t_eval=np.linspace(0.0, 4.0, samples))
    assert len(run.variants) > 3
    assert sv.verify(run).passed


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize(("order", "by"), [(2, "ideal"), (3, "actuators"), (4, "ideal")])
def test_a_row_above_the_order_of_the_motion_has_a_residual(order, by):
    q = sv.coordinates("x y z")
    x, y, z = q
    motors = {"actuators": {"u": x, "v": y}} if by == "actuators" else {}
    gibbs = sum(sv.particle(q, 1.0, (s,)) for s in q)
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=x * y + y * z + z**2, **motors)
    path = x - ca.sin(q.t)
    model = sv.derive(mechanism, sv.Program({"p": path, "s": q.dt(path, order) + y - 0.1 * q.t}, by=by))
    run = sv.simulate(model, model.start(z=0.1), (0.0, 2.0))
    assert "s " in repr(run) and np.abs(run.residual["s"]).max() < 1e-9
    assert run["y"] == pytest.approx(0.1 * run.t, abs=1e-9)
    assert sv.verify(run).passed
    moved = edited(run, jets=scaled(run.jets, 1))
    assert {"residual s", "residual hidden: s"} & set(sv.verify(moved).failures)


# what is wrong --------------------------------------------------------------------------------------------------------


def test_a_run_of_another_program_or_other_numbers_fails():
    (model, start, span), (other, *_) = chain(), chain(path=lambda t: 0.5 * ca.sin(2 * t))
    run = sv.simulate(model, start, span)
    for wrong in (other, model.with_parameters(k=2.1), model.with_parameters(pace=1.1)):
        assert verdict(edited(run, model=wrong)) == "failed"
        assert verdict(edited(run, model=wrong, variants=())) == "failed"
    for same in (model.with_parameters(k=2.0), chain()[0]):
        assert sv.verify(replace(run, model=same)).passed
    assert sv.verify(pickle.loads(pickle.dumps(run))).passed


EDITS = {
    "a row of samples": lambda run, row, k: edited(run, jets=scaled(run.jets, row)),
    "one number": lambda run, row, k: edited(run, jets=scaled(run.jets, (row, k))),
    "times": lambda run, row, k: edited(run, t=CHANGE * run.t),
    "one time": lambda run, row, k: edited(run, t=np.where(np.arange(len(run.t)) == k, run.t + 0.4 * run.t[1], run.t)),
    "the order of times": lambda run, row, k: edited(run, t=run.t[::-1]),
}


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("name", ["overhead-crane", "appell-hamel", "spiral", "vtol-centre"])
def test_changed_samples_fail(name, edit, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, t_eval=np.linspace(*scene.t_span, 201))
    for row in range(len(run.jets)) if "times" not in edit and "time" not in edit else [0]:
        k = int(np.argmax(np.abs(run.jets[row])))
        if "time" in edit:
            k = int(np.argmax(np.abs(run.jets[model.nq : model.nq + model.n]).max(axis=0)))
        if run.jets[row].any():
            assert verdict(EDITS[edit](run, row, k)) == "failed", (row, k)


def test_samples_beside_the_program_are_decided_by_few_steps(monkeypatch):
    """No length of step mends a sample: a wrong run takes little more than a right one."""
    (model, start, span), points, grid = chain(), [], Compiled.grid
    run = sv.simulate(model, start, span)

    def counted(f, t, x, p):
        points.append(np.shape(x)[-1] * (f.name == "path"))
        return grid(f, t, x, p)

    monkeypatch.setattr(Compiled, "grid", counted)
    assert sv.verify(run).passed
    least = sum(points)
    for wrong in (model.with_parameters(k=2.1), model.with_parameters(pace=1.1), chain(path=lambda t: 0.5 * ca.sin(2 * t))[0]):
        points.clear()
        proof = sv.verify(edited(run, model=wrong))
        assert {"segments", "energy"} <= set(proof.failures) and not proof.doubts
        assert 0 < sum(points) < 10 * least
    for k in (1, 500, 1000):
        proof = sv.verify(edited(run, jets=scaled(run.jets, (0, k)), variants=()))
        assert any(name.startswith("residual") for name in proof.failures) and not proof.doubts


@pytest.mark.parametrize("which", [(slice(None), slice(1, None)), (0, 5), (-1, -1), (slice(None), slice(None))])
def test_samples_that_are_no_numbers_fail(which, plan):
    jets = plan.jets.copy()
    jets[which] = np.nan
    proof = sv.verify(edited(plan, jets=jets))
    assert proof.failures == ("samples",) and proof.numbers["samples"] >= 1


@pytest.mark.filterwarnings("ignore:Internal dynamics unstable")
@pytest.mark.parametrize("jet", ["lean", "d2y", "d2lean"])
@pytest.mark.parametrize("lean", [0.0, 1e-8])
def test_wrong_motions_of_a_singular_mechanism_fail(lean, jet):
    model, start, span = leaning(lean)
    run = sv.simulate(model, start, span)
    wrong = scaled(run.jets, model.jet_names.index(jet))
    assert "balance" in sv.verify(edited(run, jets=wrong)).failures


@pytest.mark.parametrize("name", ["trolley", "hoist", "energy"])
@pytest.mark.parametrize("which", [slice(None), 100])
def test_changed_forces_fail(name, which, plan):
    values = scaled(plan[name], which)
    proof = sv.verify(edited(plan, stored={name: values}))
    assert "signals" in proof.failures and ("balance" in proof.failures) == (name != "energy")


def test_changed_rates_of_signals_fail_and_what_the_model_does_not_know_is_a_doubt(wheel):
    run = sv.simulate(*wheel, (0.0, 0.2), sv.methods.Taylor(jets=3), t_eval=np.linspace(0.0, 0.2, 11))
    rate = run["dreaction_x"]
    assert "dreaction_x" in run.stored and sv.verify(run).passed
    assert sv.verify(edited(run, stored={"dreaction_x": scaled(rate, 3)})).failures == ("signals",)
    proof = sv.verify(edited(run, stored={"mine": rate}))
    assert proof.verdict == "inconclusive" and "'mine'" in proof.doubts[0]


def test_forces_of_a_mechanism_without_a_coupling_fail():
    (model, start, span), (loose, *_) = chain(2.0), chain(1.9)
    run = sv.simulate(model, start, span)
    forces = replace(run, model=loose, variants=(), stored={})["F"]
    assert "balance" in sv.verify(edited(run, stored={"F": forces})).failures


def test_the_other_elbow_fails():
    q = sv.coordinates("a b")
    a, b = q
    tip = (ca.cos(a) + ca.cos(a + b), ca.sin(a) + ca.sin(a + b))
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tip), potential=9.81 * tip[1], actuators={"u": a, "v": b})
    program = sv.Program({"X": tip[0] - 1.2 * ca.cos(q.t), "Y": tip[1] - 1.2 * ca.sin(q.t)})
    guess = {"a": -0.9, "b": 1.8}
    model = sv.derive(mechanism, program, guess=guess)
    run = sv.simulate(model, model.start(guess=guess), (0.0, 3.0), t_eval=np.linspace(0.0, 3.0, 101))
    bend = run["b"]
    flipped = np.array([run["a"] + 2 * np.arctan2(np.sin(bend), 1 + np.cos(bend)), -bend])
    y = model.function("path").grid(run.t, flipped, model.p)
    other = np.concatenate([flipped, y[2:6]])
    assert sv.verify(run).passed
    assert sv.verify(edited(run, jets=other, variants=())).passed, "a motion of its own"
    for mixed in ([50], range(50, 101), range(0, 101, 2), [0], [100]):
        jets = run.jets.copy()
        jets[:, list(mixed)] = other[:, list(mixed)]
        assert "segments" in sv.verify(edited(run, jets=jets, variants=())).failures


@pytest.mark.parametrize("samples", [None, 57])
@pytest.mark.parametrize("name", ["overhead-crane", "two-cars"])
def test_flat_programs_that_were_integrated_pass(name, samples, gallery_model):
    """Their hidden rows drift by the errors of the steps, unlike those that are solved at each instant."""
    model, scene = gallery_model(name), gallery[name]
    times = None if samples is None else np.linspace(*scene.t_span, samples)
    start = model.start(**scene.start, guess=scene.guess)
    run = sv.simulate(model, start, scene.t_span, "RK4", t_eval=times)
    assert sv.verify(run).passed
    name = model.actuators[0]
    assert "balance" in sv.verify(edited(run, stored={name: scaled(run[name])})).failures


# kinks and switches ---------------------------------------------------------------------------------------------------


def rubbed(friction=2.0):
    """A mass with dry friction beside a driven one, released at rest: three reversals."""
    q = sv.coordinates("x y")
    (x, y), (_, dy), (ddx, ddy) = q, q.d(1), q.d(2)
    forces = {"y": -9 * y - friction * ca.sign(dy)}
    mechanism = sv.Mechanism(q, gibbs=(ddx**2 + ddy**2) / 2, actuators={"F": x}, forces=forces)
    model = sv.derive(mechanism, sv.Program({"x": x - ca.sin(q.t)}), keep=["y"])
    return model, model.start(y=2.0, dy=0.0), (0.0, 2.8)


def turning():
    """A point of speed 1 whose direction turns on and on, beyond the jumps of atan2."""
    q = sv.coordinates("x y")
    (dx, dy), (ddx, ddy) = q.d(1), q.d(2)
    program = sv.Program({"p": ca.atan2(dy, dx) - q.t}, by="ideal")
    model = sv.derive(sv.Mechanism(q, gibbs=(ddx**2 + ddy**2) / 2), program)
    return model, model.start(dx=1.0, x=0.0, y=0.0), (0.0, 10.0)


@pytest.mark.parametrize(
    ("scene", "method", "samples"),
    [(rubbed, "DOP853", None), (rubbed, "RK4", 11), (turning, "Taylor", 101)],
)
def test_runs_across_switches_pass(scene, method, samples, tmp_path):
    model, start, span = scene()
    times = None if samples is None else np.linspace(*span, samples)
    run = sv.simulate(model, start, span, method, t_eval=times)
    assert sv.verify(run).passed
    again, *_ = scene()
    loaded = sv.load(run.save(tmp_path / "run"), again)
    assert loaded == run and len(loaded.variants) > 1 and sv.verify(loaded).passed


def test_wrong_sides_of_switches_fail():
    model, start, span = rubbed()
    run = sv.simulate(model, start, span)
    (*_, one), (*_, other) = run.variants[:2]
    swapped = tuple((a, b, other if v is one else one) for a, b, v in run.variants)
    assert "switches" in sv.verify(edited(run, variants=swapped)).failures
    later = [(0, run.variants[0][1] + 3, one), (run.variants[0][1] + 3, run.variants[1][1], other), *run.variants[2:]]
    assert "switches" in sv.verify(edited(run, variants=tuple(later))).failures
    weak, *_ = rubbed(1.99)
    wrong = sv.simulate(weak, start, span)
    assert "balance" in sv.verify(replace(wrong, model=model, variants=run.variants[:0])).failures
    for jets in (scaled(run.jets, (slice(None), 500)), scaled(run.jets)):
        assert not sv.verify(edited(run, jets=jets)).passed


def test_states_between_samples_are_those_of_their_side():
    model, start, span = rubbed()
    run = sv.simulate(model, start, span, "RK4", t_eval=np.linspace(*span, 20_001))
    half = np.floor(run.t / (np.pi / 3))
    exact = (-1) ** half * (2 / 9 + (16 / 9 - half * 4 / 9) * np.cos(3 * run.t - half * np.pi))
    assert run["y"] == pytest.approx(exact, abs=1e-9)
    dense = sv.simulate(model, start, span)
    reversal = np.pi / 3 + 2e-4
    assert dense.at(reversal)[1] == pytest.approx(np.interp(reversal, run.t, run["y"]), abs=1e-7)


def test_changed_jets_of_higher_order_fail():
    model, start, span = chain(by="ideal")
    run = sv.simulate(model, start, span, sv.methods.Taylor(jets=5))
    assert sv.verify(run).passed
    for which in (slice(None), 700):
        assert sv.verify(edited(run, jets=scaled(run.jets, (-1, which)))).failures == ("higher jets",)


@pytest.mark.parametrize("what", ["t", "states", "inputs", "commands", "measurements", "controller_states"])
def test_changed_signals_of_a_closed_loop_fail(what, plan):
    plant = sv.plant(plan.model.reduction.mechanism)
    law = sv.lqr(plan, plant, integral=True)
    run = sv.close(plant, law, plan.state(0.0) + 0.01, (0.0, 2.0), timing=sv.Timing(delay=1))
    assert sv.verify(run).passed
    values = getattr(run, what)
    largest = np.unravel_index(int(np.argmax(np.abs(values))), values.shape)
    assert sv.verify(replace(run, **{what: CHANGE * values})).failures == ("loop repeated",)
    for wrong in (CHANGE * values[largest], np.nan):
        one = values.copy()
        one[largest] = wrong
        assert sv.verify(replace(run, **{what: one})).failures == ("loop repeated",)
    with refused(sv.errors.SpecificationError, "sample"):
        sv.verify(replace(run, **{what: values[..., :-1]}))


# what cannot be decided -----------------------------------------------------------------------------------------------


def test_what_cannot_be_followed_is_inconclusive(c_compiler):
    model, start, _ = chain(1e13, by="ideal")
    run = sv.simulate(model, start, (0.0, 0.02), as_method("RadauIIA"), t_eval=[0.0, 0.01, 0.02])
    proof = sv.verify(run)
    assert (proof.verdict, proof.passed, proof.failures) == ("inconclusive", False, ())
    assert "t_eval" in proof.doubts[0] and "Verification: inconclusive" in repr(proof)


def test_one_sample_is_inconclusive(plan):
    one = edited(plan, t=plan.t[:1], jets=plan.jets[:, :1], variants=())
    proof = sv.verify(one)
    assert proof.verdict == "inconclusive" and "segments" not in proof.numbers


MALFORMED = {
    "no run": lambda run: None,
    "jets without a row": lambda run: replace(run, jets=run.jets[:-1]),
    "no jets": lambda run: replace(run, jets=None),
    "texts": lambda run: replace(run, t=np.array(["a"] * len(run.t))),
    "complex": lambda run: replace(run, jets=run.jets * 1j),
    "fewer times": lambda run: replace(run, t=run.t[1:]),
    "stored": lambda run: replace(run, stored=[1.0]),
    "model": lambda run: replace(run, model="model"),
    "knots": lambda run: replace(run, knots=None),
}


@pytest.mark.parametrize("what", MALFORMED)
def test_what_is_no_run_of_the_model_is_refused(what, plan):
    with refused(sv.errors.SpecificationError):
        sv.verify(MALFORMED[what](plan))


@pytest.mark.parametrize("values", [None, "x", [1.0], 1j, object()])
def test_stored_signals_that_are_no_samples_fail_or_are_left_out(values, plan):
    assert verdict(edited(plan, stored={"energy": values})) in ("failed", "passed")


# peaks of power -------------------------------------------------------------------------------------------------------


def jerky(steepness, at, height=0.01):
    """A mass that moves evenly but for a quick jump."""
    q = sv.coordinates("x")
    (x,) = q
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, 1.0, (x, 0.0)), actuators={"F": x})
    return sv.derive(mechanism, sv.Program({"x": x - q.t - height * ca.tanh(steepness * (q.t - at))}))


@pytest.mark.parametrize("samples", [3, 11, 101, 1001])
@pytest.mark.parametrize("steepness, at", [(50.0, 0.77), (200.0, 1.003), (2000.0, 1.003), (1000.0, 1.0), (2e4, 1.234)])
def test_narrow_peaks_of_power_do_not_fail(steepness, at, samples):
    model = jerky(steepness, at)
    run = sv.simulate(model, model.start(), (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, samples))
    found = sv.verify(run)
    assert not found.failures
    assert found.passed or (steepness >= 1000.0 and samples < 1001 and "t_eval" in repr(found))


@pytest.mark.parametrize("samples", [11, 101])
def test_wrong_forces_at_narrow_peaks_fail(samples):
    model = jerky(200.0, 1.003)
    run = sv.simulate(model, model.start(), (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, samples))
    jets = run.jets.copy()
    jets[0, samples // 2 :] += 1e-4
    assert sv.verify(replace(run, jets=jets)).verdict == "failed"


@pytest.mark.parametrize("name", ["overhead-crane", "appell-hamel", "spiral"])
@pytest.mark.parametrize("change", [0.0, 1e-13, 1e-10, 1e-7, 3e-6])
def test_sizes_at_some_instants_give_the_same_verdict(name, change, gallery_model, monkeypatch):
    model, scene = gallery_model(name), gallery[name]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, "Taylor" if name == "spiral" else None)
    jets = run.jets.copy()
    jets[0, 507] += change * np.abs(jets[0]).max()  # between the instants whose sizes are known
    run = edited(run, jets=jets)
    some = sv.verify(run)
    monkeypatch.setattr(checks, "FEW_SIZES", 10**6)
    every = sv.verify(run)
    assert (some.verdict, some.failures) == (every.verdict, every.failures)
    assert every.failures or change < 1e-6
    for key, number in every.numbers.items():
        assert number / 30 <= some.numbers[key] <= 30 * number + 1e-30, key


def test_what_is_clear_is_evaluated_once_or_twice_at_a_sample(gallery_model, monkeypatch):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span)
    sv.verify(run)
    points, grid = {}, Compiled.grid

    def counted(f, t, x, p):
        points[f.name] = points.get(f.name, 0) + np.shape(x)[-1]
        return grid(f, t, x, p)

    monkeypatch.setattr(Compiled, "grid", counted)
    assert sv.verify(run).passed
    for name in ("residuals", "balanced", "all_multipliers", "power", "energy"):
        assert points[name] <= 2 * len(run.t), points


def test_many_variants_of_one_model_are_followed_together(gallery_model, monkeypatch):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span)
    cut = edited(run, variants=tuple((k, k + 13, model) for k in range(0, 1001, 13)))
    seen, integrate = [], intervals._integrate
    monkeypatch.setattr(intervals, "_integrate", lambda flow, *rest: seen.append(flow) or integrate(flow, *rest))
    assert sv.verify(cut).passed and len(seen) <= 4


def test_a_stored_residual_that_is_not_that_of_the_motion_does_not_pass(gallery_model):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span, t_eval=np.linspace(0.0, 8.0, 41))
    stored = {name: np.array(values) for name, values in run.residual.items()}
    assert sv.verify(edited(run, stored_residual=stored)).passed
    stored["X"][0, 10] = 0.5
    assert "residual X" in sv.verify(edited(run, stored_residual=stored)).failures
