"""Forces along references that arrive one sample after the other."""

import numpy as np
import pytest
import referred
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError

HZ = 1000.0
EXACT = {"rtol": 1e-9, "atol": 1e-9}  # of solve_ivp


def jets_at(model, step):
    return {name: path.jets(step.t, step.orders[name])[:, 0, 0] for name, path in model.paths.items()}


def test_a_flat_program_needs_the_jets_alone():
    model = referred.crane()
    start, times = model.start(guess={"l": 4.0}), np.arange(0.0, 201.0) / HZ
    run = sv.simulate(model, start, (0.0, 0.2), t_eval=times)
    step = model.feedforward(start, HZ)
    forces = [step(jets_at(model, step)) for _ in times]
    for name in model.actuators:
        off = np.abs([u[name] for u in forces] - run[name]).max()
        assert off <= 1e-12 * np.abs(run[name]).max()


def test_at_its_solution_a_flat_program_is_evaluated_once(monkeypatch):
    model, calls = referred.crane(), []
    step, path = model.feedforward(model.start(guess={"l": 4.0}), HZ), model.function("path")
    original = type(path).__call__
    monkeypatch.setattr(type(path), "__call__", lambda self, *given: calls.append(self) or original(self, *given))
    step(jets_at(model, step))
    assert [call is path for call in calls].count(True) == 1


def test_another_program_keeps_its_state():
    model = referred.cart()
    start, times = model.start(theta=0.1, dtheta=0.0), np.arange(0.0, 201.0) / HZ
    run = sv.simulate(model, start, (0.0, 0.2), t_eval=times)
    step = model.feedforward(start, HZ)
    assert "keeps the state x, theta, dx, dtheta" in repr(step)
    forces = [step(jets_at(model, step))["force"] for _ in times]
    assert np.abs(forces - run["force"]).max() <= 1e-10 * np.abs(run["force"]).max()


def test_a_reference_without_a_path_is_enough():
    mechanism, X, Z = referred.crane_parts()
    r = mechanism.q.references(X=None, Z=None)
    model, known = sv.derive(mechanism, sv.Program({"X": X - r.X, "Z": Z + r.Z}, by="actuators")), referred.crane()
    step = model.feedforward(known.start(guess={"l": 4.0}))
    assert step.orders == {"X": 4, "Z": 4}
    first = step(jets_at(known, step))
    assert step.t == 1e-3 and abs(first["hoist"] + 981.0) < 1e-9 and abs(first["trolley"]) < 1e-9


def test_bad_jets_are_refused_and_take_no_sample():
    model = referred.crane()
    step = model.feedforward(model.start(guess={"l": 4.0}))
    good = jets_at(model, step)
    for bad in ({"X": good["X"]}, good | {"Z": good["Z"][:4]}, good | {"X": good["X"] * np.nan}):
        with refused(SpecificationError, "finite numbers: its value and 4 derivatives"):
            step(bad)
    with refused(NameUnknown, "'Y'"):
        step(good | {"Y": good["X"]})
    assert step.t == 0.0
    with refused(SpecificationError, "follows no references"):
        q = sv.coordinates("x")
        mechanism = sv.Mechanism(q, sv.particle(q, 1.0, q[0]), actuators={"force": q[0]})
        sv.derive(mechanism, sv.Program({"x": q[0] - q.t})).feedforward(None)


def test_references_are_inputs_of_a_system_of_python_control():
    control = pytest.importorskip("control")
    model = referred.cart()
    start, times = model.start(theta=0.1, dtheta=0.0), np.linspace(0.0, 1.0, 51)
    system = sv.interop.nlsys(model, references="inputs")
    assert system.input_labels == ["r", "dr", "d2r"]
    run, path = sv.simulate(model, start, (0.0, 1.0), t_eval=times), model.paths["r"]
    for t, jets in zip(times.tolist(), run.jets.T, strict=True):
        x, u = jets[: system.nstates], path.jets(t, 2)[:, 0, 0]
        outputs = dict(zip(system.output_labels, system.output(t, x, u), strict=True))
        assert abs(outputs["force"] - run["force"][run.t == t][0]) <= 1e-12 * np.abs(run["force"]).max()

    def off(count):  # inputs are linear between instants: errors fall with the square of their distance
        t = np.linspace(0.0, 1.0, count)
        response = control.input_output_response(system, t, path.jets(t, 2)[:, 0], start.values, solve_ivp_kwargs=EXACT)
        return np.abs(response.outputs[1][:: (count - 1) // 50] - run["theta"]).max()

    assert off(201) < off(51) / 12 < 1e-3
    with refused(SpecificationError, "references was given for what is no model with references"):
        sv.interop.nlsys(sv.plant(model.reduction.mechanism), references="inputs")
