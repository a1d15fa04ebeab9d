"""Accelerations and reactions of held robots against pinocchio's constraintDynamics."""

import casadi as ca
import numpy as np
import pytest
import robots

import servoctl as sv

LEGS = ("front_left", "front_right", "hind_left", "hind_right")
STANDING = {"base_z": 0.3} | {f"{leg}_{joint}": angle for leg in LEGS for joint, angle in (("flexion", 0.7), ("knee", -1.4))}
TALOS = {"base_z": 1.0} | {
    f"leg_{side}_{joint}_joint": angle for side in ("left", "right") for joint, angle in ((3, -0.5), (4, 1.0), (5, -0.5))
}
HELD = {  # file, kind of base, posture, frames
    "an arm at a wall": ("six_axis_arm", "fixed", {"lift": 0.2, "elbow": 1.4, "bend": 0.9}, {"tool": "position"}),
    "a quadruped on point feet": ("quadruped", "free", STANDING, {f"{leg}_foot": "position" for leg in LEGS}),
    "talos on both soles": ("talos", "free", TALOS, {"left_sole_link": "pose", "right_sole_link": "pose"}),
}


def contacts_of(other, frames, configuration):
    """pinocchio's contacts of frames (name: kind) where they are in a configuration."""
    pin, model = other.pin, other.model
    pin.framesForwardKinematics(model, other.data, configuration)
    contacts = pin.StdVec_RigidConstraintModel()
    for name, kind in frames.items():
        frame = model.frames[model.getFrameId(name)]
        place = other.data.oMf[model.getFrameId(name)]
        size = pin.ContactType.CONTACT_3D if kind == "position" else pin.ContactType.CONTACT_6D
        contacts.append(
            pin.RigidConstraintModel(size, model, frame.parentJoint, frame.placement, 0, place, pin.ReferenceFrame.LOCAL)
        )
    return contacts


def accelerated(other, contacts, configuration, v, torques):
    """pinocchio's accelerations, and the forces on the frames in their axes."""
    pin, results = other.pin, other.pin.StdVec_RigidConstraintData()
    for contact in contacts:
        results.append(contact.createData())
    pin.initConstraintDynamics(other.model, other.data, contacts, results)
    exact = pin.ProximalSettings(1e-15, 1e-15, 0.0, 1)
    a = pin.constraintDynamics(other.model, other.data, configuration, v, torques, contacts, results, exact)
    return a, results


@pytest.mark.parametrize("scene", HELD.values(), ids=HELD)
def test_accelerations_of_held_robots_equal_pinocchio(scene):
    """Random velocities that the contacts allow, random torques and pushes, with the damping of the joints."""
    file, base, posture, frames = scene
    path = robots.file_of(file)
    robot, random = sv.urdf(path, base=base), np.random.default_rng(1807)
    plant = sv.plant(robot.mechanism(sv.held(robot, frames, posture), friction=0.0))
    other, q = robots.Pinocchio(robot, path, base), robot.q
    values = np.array([posture.get(name, 1.0 if name == "base_qw" else 0.0) for name in q.names])
    configuration, rows = other.configuration(values), other.rows
    contacts = contacts_of(other, frames, configuration)
    parts = [robot.frame(name).jacobian[: 3 if kind == "position" else 6, :] for name, kind in frames.items()]
    jacobian = np.array(ca.Function("J", [ca.vertcat(*q)], [ca.densify(ca.vertcat(*parts))])(values))
    allowed = np.eye(q.n) - np.linalg.pinv(jacobian) @ jacobian
    anywhere, plant = plant, plant.near(0.0, np.concatenate([values, np.zeros(q.n)]))  # pivots of a symmetric stance
    for _ in range(5):
        v, u, d = allowed @ random.normal(size=q.n), 20.0 * random.normal(size=len(plant.inputs)), random.normal(size=q.n)
        x = np.concatenate([values, v])
        driven = [q.names.index(name.removeprefix("torque_")) - (q.nq - q.n) for name in plant.inputs]
        torques = d.copy()
        torques[driven] += u - np.array([robot.damping.get(q.names[k + q.nq - q.n], 0.0) for k in driven]) * v[driven]
        theirs, results = accelerated(other, contacts, configuration, v[rows], torques[rows])
        ours = plant.function("accelerations")(0.0, x, plant.p(u, d))
        assert np.abs(ours[rows] - theirs).max() < 1e-9 * np.abs(theirs).max()
        rates = anywhere.rates(0.0, x, u, d)  # with pivots that were decided elsewhere, and are rounding here
        assert np.abs(rates[q.nq :][rows] - theirs).max() < 1e-9 * np.abs(theirs).max()
        if set(frames.values()) == {"position"}:
            reactions = plant.function("multipliers")(0.0, x, plant.p(u, d)).reshape(-1, 3)
            for name, result, reaction in zip(frames, results, reactions, strict=True):
                force = robot.at(posture, name)[1] @ result.contact_force.linear
                assert np.abs(reaction - force).max() < 1e-9 * max(1.0, np.abs(force).max())
