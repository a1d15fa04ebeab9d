"""Reactions of material constraints in closed loops, by name, against closed forms."""

import pickle

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv

G = 9.81


def stand(**choices):
    """A body of 20 kg on a foot of 4 kg that is fixed to the ground."""
    q = sv.coordinates("x z s h")
    x, z, s, h = q
    gibbs = sv.particle(q, 4.0, ca.vertcat(x, z)) + sv.particle(q, 20.0, ca.vertcat(x + s, z + h))
    return sv.plant(
        sv.Mechanism(
            q, gibbs=gibbs, potential=G * (4.0 * z + 20.0 * (z + h)), actuators={"side": s, "lift": h},
            constraints={"sole_x": x, "sole_z": z},
        ),
        **choices,
    )  # fmt: skip


def pushed(t, y):
    return {"side": 30.0 * np.sin(3.0 * t) - 5.0 * y["s"], "lift": 20.0 * G + 40.0 * (0.6 - y["h"]) - 20.0 * y["dh"]}


START = dict.fromkeys("x z s h dx dz ds dh".split(), 0.0) | {"h": 0.5}
LOOPS = {
    "plain": ({}, {}),
    "limits": ({"limits": {"side": 12.0}}, {}),
    "lag": ({"lag": {"lift": 0.03}}, {}),
    "transport delay": ({"delay": {"side": 0.01}}, {"timing": sv.Timing(100.0, substeps=5)}),
    "push from the side": ({}, {"disturbance": {"s": lambda t: 8.0 * np.cos(t), "x": 3.0}}),
}


@pytest.mark.parametrize("what", LOOPS)
def test_the_ground_carries_what_the_actuators_push(what):
    choices, conditions = LOOPS[what]
    plant = stand(**choices)
    loop = sv.close(plant, pushed, START, (0.0, 1.0), **{"timing": sv.Timing(100.0)} | conditions)
    applied = {name: loop[name].copy() for name in ("side", "lift")}
    if "delay" in choices:  # of one sample
        applied["side"] = np.append(0.0, applied["side"][:-1])
    d = loop.disturbance
    assert np.abs(loop["multiplier_sole_x"] - (applied["side"] + d["s"] - d["x"])).max() < 1e-9
    assert np.abs(loop["multiplier_sole_z"] - (applied["lift"] + 4.0 * G)).max() < 1e-9


def rod(length=0.8, mass=1.5):
    """A pendulum in coordinates of its bob, which a thruster pushes along x."""
    q = sv.coordinates("x y")
    x, y = q
    rows = {"rod": (x**2 + y**2 - length**2) / (2 * length)}
    return sv.plant(
        sv.Mechanism(
            q, gibbs=sv.particle(q, mass, (x, y)), potential=mass * G * y, constraints=rows, actuators={"thrust": x}
        )
    )


def test_tension_of_a_rod():
    """λ = -T: m v²/l = T + m g y/l + u x/l."""
    length, mass = 0.8, 1.5
    start = {"x": 0.6 * length, "y": -0.8 * length, "dx": 0.8, "dy": 0.6}
    timing = sv.Timing(200.0, substeps=4)
    loop = sv.close(rod(), lambda t, y: [2.0 * np.sin(9 * t) - y["dx"]], start, (0.0, 2.0), timing=timing)
    x, y, v = loop["x"], loop["y"], np.hypot(loop["dx"], loop["dy"])
    tension = mass * v**2 / length - mass * G * y / length + loop["thrust"] * x / length
    assert np.abs(loop["multiplier_rod"] + tension).max() < 1e-8 * np.abs(tension).max()
    assert "multiplier_rod" in loop.names


@pytest.mark.parametrize("frame", ["axes of the ground", "axes of the blade"])
def test_side_force_of_a_skate(frame):
    """A constraint of velocities: m v θ' = λ + the push across the blade."""
    q = sv.coordinates("x y theta")
    c, s = ca.cos(q.d(0)[2]), ca.sin(q.d(0)[2])
    if frame == "axes of the blade":
        V = ca.vertcat(ca.horzcat(c, -s, 0), ca.horzcat(s, c, 0), ca.horzcat(0, 0, 1))
        q = q.with_quasi_velocities("along across turn", V)
    (x, y, theta), (dx, dy, _) = q, q.d(1)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 2.0, (x, y)) + 0.3 * q.d(2)[2] ** 2 / 2, actuators={"push": x, "torque": theta},
        constraints={"blade": -s * dx + c * dy},
    )  # fmt: skip
    plant = sv.plant(mechanism)
    start = dict.fromkeys(plant.state_names, 0.0) | dict(zip(plant.state_names[3:], (1.0, 0.0, 0.7), strict=True))
    loop = sv.close(plant, lambda t, y: [1.0, 0.2 * np.cos(t)], start, (0.0, 2.0), timing=sv.Timing(100.0, substeps=4))
    angle, speeds = loop["theta"], loop.states[3:]
    turning = np.cos(angle) * speeds[0] + np.sin(angle) * speeds[1] if q.plain else speeds[0]
    expected = 2.0 * turning * speeds[2] + loop["push"] * np.sin(angle)
    assert np.abs(loop["multiplier_blade"] - expected).max() < 1e-7


def test_reactions_are_saved_and_travel(tmp_path):
    loop = sv.close(stand(), pushed, START, (0.0, 0.3), timing=sv.Timing(100.0))
    again = sv.load(loop.save(tmp_path / "loop"))
    copy = pickle.loads(pickle.dumps(loop))
    for run in (again, copy, loop.to_run()):
        assert np.array_equal(run["multiplier_sole_z"], loop["multiplier_sole_z"])


def test_only_constraints_have_reactions():
    loop = sv.close(stand(), pushed, START, (0.0, 0.1), timing=sv.Timing(100.0))
    with refused(sv.errors.NameUnknown, match="multiplier_sole_z"):
        loop["multiplier_sole_zz"]
    with refused(sv.errors.NameUnknown):
        loop["multiplier_side"]
