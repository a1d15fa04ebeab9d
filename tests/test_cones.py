"""Reactions of material constraints in the bounds of limited laws: cones of friction under a foot."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv

MU, FOOT, BODY, G = 0.3, 4.0, 20.0, 9.81
CONE = {
    f"slip {side}": ({"multiplier_sole_x": sign, "multiplier_sole_z": -MU}, None, 0.0)
    for side, sign in (("right", 1.0), ("left", -1.0))
}


def standing(duration=1.0, **options):
    """A body that actuators push away from its foot, on a program that moves it to the side and up."""
    p, q = sv.parameters(foot=FOOT, body=BODY, g=G), sv.coordinates("x z s h")
    x, z, s, h = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.foot, ca.vertcat(x, z)) + sv.particle(q, p.body, ca.vertcat(x + s, z + h)),
        potential=p.g * (p.foot * z + p.body * (z + h)), parameters=p, actuators={"side": s, "lift": h},
        constraints={"sole_x": x, "sole_z": z},
    )  # fmt: skip
    path = sv.paths.rest_to_rest(start=(0.0, 0.5), end=(0.6, 0.7), duration=duration, smoothness=4)
    r = q.references(S=path[0], H=path[1])
    program = sv.Program({"S": s - r.S, "H": h - r.H}, by="actuators")
    model = sv.derive(mechanism, program)
    return sv.simulate(model, model.start(0.0, guess={"h": 0.5}), (0.0, duration), **options), sv.plant(mechanism)


@pytest.fixture(scope="module")
def stand():
    plan, plant = standing()
    law = sv.lqr(plan, plant)
    return plan, plant, law, sv.limited(law, plant, bounds=CONE)


def room(run):
    """μ λ_z - |λ_x|, in closed form: the foot is at rest under the body's push and its own weight."""
    return MU * (FOOT * G + run["lift"]) - np.abs(run["side"])


def test_multipliers_of_a_plant_are_those_of_the_plan(stand):
    plan, plant, _, _ = stand
    multipliers = plant.equations.multipliers
    f = plant.equations.function("reactions", list(multipliers.values()))
    u = np.array([plan["side"], plan["lift"]])
    x = np.array([plan[name] for name in plant.state_names])
    ours = np.array(f(plan.t[None], x, plant.p(u)))
    for row, name in zip(ours, multipliers, strict=True):
        assert np.abs(row - plan[name]).max() < 1e-9
    assert np.abs(ours[0] - plan["side"]).max() < 1e-9
    assert np.abs(ours[1] - plan["lift"] - FOOT * G).max() < 1e-9


def test_a_foot_does_not_slip_where_its_cone_bounds_the_law(stand):
    plan, plant, law, bounded = stand
    start, span = plan.state(0.0), (0.0, 2.5)
    free, held = sv.close(plant, law, start, span), sv.close(plant, bounded, start, span)
    assert room(free).min() < -10.0
    assert room(held).min() > -1e-6
    for name in CONE:
        assert np.any(held.signal[f"bound {name}"] == 1.0)
    assert abs(held.error["s"][-1]) < 1e-2
    assert abs(held.error["h"][-1]) < 1e-2
    many = sv.close_many(held, {"body": [20.0, 21.0], "foot": [4.0, 4.0]})
    assert many["final s"][0] == pytest.approx(held["s"][-1], abs=1e-9)


def test_bounds_of_reactions_are_refused_by_name(stand):
    plan, plant, law, _ = stand
    with refused(sv.errors.NameUnknown, match="multiplier_sole_x"):
        sv.limited(law, plant, bounds={"slip": ({"multiplier_sole_xx": 1.0}, None, 0.0)})
    with refused(sv.errors.SpecificationError, "slip", name="slip"):
        sv.limited(law, plant, bounds={"slip": ({"multiplier_sole_x": 1.0}, 1.0, 0.0)})
    with refused(sv.errors.SpecificationError):
        sv.limited(law, plant, bounds={"slip": ({"multiplier_sole_x": np.nan}, None, 0.0)})
    with refused(sv.errors.SpecificationError):
        sv.limited(law, plant, bounds={"slip": ([1.0], None, 0.0)})
    with refused(sv.errors.SpecificationError, "immediately"):
        sv.limited(law, sv.plant(plant.mechanism, lag={"side": 0.1, "lift": 0.1}), bounds=CONE)


@pytest.mark.parametrize("t_eval", [None, np.unique([*np.linspace(0.0, 0.9, 91), 0.3, 0.1 + 0.2, 0.9 - 2e-16])])
def test_plans_whose_samples_nearly_coincide_give_their_own_feedforward(t_eval):
    plan, plant = standing(0.9, t_eval=t_eval)  # a path that ends at 0.8999999999999999
    law = sv.lqr(plan, plant)
    assert law.schedule[:2, -1] == pytest.approx([0.0, BODY * G], abs=1e-6)
    if t_eval is None:
        assert len(plan.t) == 1001
        assert np.diff(plan.t).min() > 8e-4
