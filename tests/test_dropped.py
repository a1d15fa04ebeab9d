"""Entries that eliminations leave out are evaluated along each motion: a live one leads to other equations."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused
from test_zeros import BLENDS, eccentric

import servoctl as sv
from servoctl.errors import IntegrationStopped
from servoctl.gallery import gallery
from servoctl.jets import algebra
from servoctl.methods import dropped
from servoctl.model.model import Model
from servoctl.reduction import ranks

FIELDS = ("tanh in time", "bump in time", "cam with dwell", "fabs in place", "tanh in place", "root in place")
SPAN = (0.0, 3.0)


@pytest.fixture
def forgetful(monkeypatch):
    """What is zero at the points of a derivation is left out, whether or not it vanishes identically."""
    return lambda: monkeypatch.setattr(ranks, "vanish", lambda values: True)


def machine(name, dwell=1.0):
    """Two masses with an inertial coupling that is a blend of time or place."""
    p, q = sv.parameters(dwell=dwell), sv.coordinates("x y")
    (x, y), (dx, dy) = q, q.d(1)
    coupling = 0.3 * ca.tanh(BLENDS[name](q.t, p.dwell * x))
    kinetic = (dx**2 + dy**2) / 2 + coupling * dx * dy
    return sv.Mechanism(q, kinetic=kinetic, potential=x**2 / 20, parameters=p, actuators={"F": x, "G": y})


def motion(name, method):
    plant = sv.plant(machine(name))
    return sv.simulate(plant, [1.0, 0.0, 1.5, 0.4], SPAN, method, inputs={"F": lambda t: 0.3 * ca.sin(t), "G": 0.2})


def ideal(name):
    q = sv.coordinates("x y")
    x, y = q
    mechanism = sv.Mechanism(q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=x**2 / 20 + y)
    model = sv.derive(mechanism, sv.Program({"P": y - BLENDS[name](q.t, x)}, by="ideal"))
    return sv.simulate(model, model.start(x=1.0, dx=1.5), SPAN)


@pytest.mark.parametrize("name", FIELDS)
def test_motions_have_the_entries_that_come_alive(name, forgetful):
    right = [ideal(name)["x"], motion(name, "DOP853")["y"]]
    forgetful()
    for one, other in zip(right, [ideal(name)["x"], motion(name, "DOP853")["y"]], strict=True):
        assert other == pytest.approx(one, abs=1e-8)


@pytest.mark.parametrize("method", ["RadauIIA", "RK4"])
def test_every_method_derives_again(method, forgetful):
    right = motion("tanh in place", method)
    forgetful()
    assert motion("tanh in place", method)["y"] == pytest.approx(right["y"], abs=1e-8)


def test_without_the_net_the_motion_is_another_one(forgetful, monkeypatch):
    right = motion("tanh in place", "DOP853")["y"]
    forgetful()
    monkeypatch.setattr(dropped, "alive", lambda entries, points: np.zeros(len(points.t)))
    assert np.abs(motion("tanh in place", "DOP853")["y"] - right).max() > 1e-3


def test_numbers_decide_again_what_is_dropped(forgetful):
    forgetful()
    mechanism, program = eccentric()
    model = sv.derive(mechanism, program).with_parameters(e=0.2)
    run = sv.simulate(model, model.start(), (0.0, 1.0))
    own = sv.derive(*eccentric(0.2))
    assert run["F"] == pytest.approx(sv.simulate(own, own.start(), (0.0, 1.0))["F"], abs=1e-9)


def test_what_no_derivation_includes_ends_the_motion(forgetful, monkeypatch):
    forgetful()
    monkeypatch.setattr(Model, "near", lambda model, t, jets, sizes=(): model)
    with refused(IntegrationStopped) as caught:
        motion("tanh in place", "DOP853")
    run = caught.value.run
    assert not run.success and run.t[-1] < caught.value.details["t"] < SPAN[1]


@pytest.mark.parametrize("name", gallery)
def test_nothing_of_the_gallery_is_dropped(name, gallery_model):
    """So that its motions pay nothing."""
    assert gallery_model(name).dropped is None


@pytest.mark.parametrize("by_algebra", [True, False])
@pytest.mark.parametrize(("name", "by", "rows"), [("overhead-crane", "ideal", 2), ("crane-3d", "actuators", 1)])
def test_identities_that_are_dropped_do_not_disturb(name, by, rows, by_algebra, monkeypatch):
    if not by_algebra:
        monkeypatch.setattr(algebra, "cancels", lambda expression: False)
    mechanism, program = gallery[name].build()
    model = sv.derive(mechanism, sv.Program(dict(list(program.residuals.items())[:rows]), by=by))
    assert (model.dropped is None) == by_algebra
    judged = []
    monkeypatch.setattr(dropped, "alive", lambda *given: judged.append(given))
    run = sv.simulate(model, model.start(guess={"theta": 0.1, "l": 4.0}), (0.0, 2.0))
    assert run.model is model and run.success and not judged


@pytest.mark.parametrize("method", ["DOP853", "RadauIIA", "RK4"])
def test_a_plant_without_constraints_crosses_switches(method):
    assert motion("cam with dwell", method).success
