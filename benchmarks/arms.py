"""Arms of n links whose end point is not accelerated, by an ideal reaction: q'' and that reaction from one call.

Pinocchio solves the same with a contact of the end point. We get the bodies with their joints as constraints, or the
joint angles, whichever is faster; their rates agree in all joints.
"""

from functools import cache, partial

import numpy as np
from harness import Missing, Row, fastest, installed
from native import COMPILER

import servoctl as sv
from servoctl.codegen.function import CALLS
from servoctl.gallery import planar_arm, spatial_arm

P = {"m": 1.0, "l": 0.5, "g": 9.81}  # as the arms have them
NO_COMPILER = Missing("gcc is not installed")
WITHIN = 1e-9  # of the largest joint acceleration or force


@cache
def arm(n, spatial, coordinates):
    """The compiled accelerations of an arm."""
    model = sv.derive(*(spatial_arm if spatial else planar_arm)(n, coordinates))
    return model.function("accelerations"), model.parameters


def state(n):
    """Joint angles and rates."""
    return np.random.default_rng(n).uniform(-1.0, 1.0, (2, n))


# ours ----------------------------------------------------------------------------------------------------------------


def bodies_state(n, spatial, q, v):
    """The state of the bodies in a motion of the joints: coordinates, then their rates."""
    if spatial:
        twist, rows = np.zeros(6), []
        for i, (angle, rate) in enumerate(zip(q, v, strict=True)):
            turn = turned(angle, i % 2)
            speed = twist[3:] + (np.cross(twist[:3], [P["l"], 0, 0]) if i else 0)
            twist = np.concatenate([turn @ twist[:3], turn @ speed])
            twist[1 if i % 2 else 2] += rate
            rows.append([rate, *twist])
        places = np.zeros((n, 7))
        places[:, 0] = q
        return np.concatenate([places.ravel(), np.ravel(rows)])
    phi, dphi = np.cumsum(q), np.cumsum(v)
    along = P["l"] * np.array([np.cos(phi), np.sin(phi)])
    across = P["l"] * np.array([-np.sin(phi), np.cos(phi)]) * dphi
    half_way = [np.cumsum(part, axis=1) - part / 2 for part in (along, across)]
    return np.concatenate(
        [np.vstack([part, angle]).T.ravel() for part, angle in zip(half_way, (phi, dphi), strict=True)]
    )


def turned(angle, about_y):
    s, c = np.sin(angle), np.cos(angle)
    return np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]] if about_y else [[c, s, 0], [-s, c, 0], [0, 0, 1]])


def answer(n, spatial, y):
    """Joint accelerations, and the force on the end point along the axes of the last link or of the base."""
    size = 3 if spatial else 2
    if len(y) == n + size:  # in joint angles
        return y.copy()
    width = 7 if spatial else 3
    own, force = y[: n * width].reshape(n, width), y[n * width :][:size]
    return np.concatenate([own[:, 0] if spatial else np.diff(own[:, 2], prepend=0.0), force])


def ours(n, spatial, in_place, coordinates):
    """One call, with the state where the compiled function reads it, or through `Compiled.__call__`, called often."""
    f, p = arm(n, spatial, coordinates)
    q, v = state(n)
    x = np.concatenate([q, v]) if coordinates == "joints" else bodies_state(n, spatial, q, v)
    t, row_x, row_p, y, run = f.buffer()

    def call():
        run()
        return y

    def plain():
        return f(0.0, x, p)

    t[0], row_x[:], row_p[:] = 0.0, x, p
    for _ in range(0 if in_place else CALLS):
        f(0.0, x, p)
    return call if in_place else plain


# peers ---------------------------------------------------------------------------------------------------------------


def pinocchio_dynamics(n, spatial):
    import pinocchio as pin

    model, joint, place = pin.Model(), 0, pin.SE3.Identity()
    inertia = pin.Inertia(P["m"], np.array([P["l"] / 2, 0, 0]), P["m"] * P["l"] ** 2 / 12 * np.diag([0.0, 1.0, 1.0]))
    for i in range(n):
        kind = pin.JointModelRY() if spatial and i % 2 else pin.JointModelRZ()
        joint = model.addJoint(joint, kind, place, f"joint {i}")
        model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
        place = pin.SE3(np.eye(3), np.array([P["l"], 0, 0]))
    model.gravity.linear = P["g"] * np.array([0, 0, -1.0] if spatial else [0, -1.0, 0])
    frame = pin.ReferenceFrame.LOCAL if spatial else pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
    contact = pin.RigidConstraintModel(pin.ContactType.CONTACT_3D, model, joint, place, frame)
    contacts, results = pin.StdVec_RigidConstraintModel(), pin.StdVec_RigidConstraintData()
    contacts.append(contact)
    results.append(contact.createData())
    data, (q, v), tau = model.createData(), state(n), np.zeros(n)
    pin.initConstraintDynamics(model, data, contacts, results)
    # A planar arm cannot move its end across the plane: without this the contact of three directions is singular.
    settings = pin.ProximalSettings(1e-14, 1e-14, 0.0 if spatial else 1e-12, 1)

    def call():
        return pin.constraintDynamics(model, data, q, v, tau, contacts, results, settings), results

    return call


# rows ----------------------------------------------------------------------------------------------------------------


def one_call(n, spatial, bar, in_place):
    peer = "pinocchio.constraintDynamics"
    theirs = pinocchio_dynamics(n, spatial) if installed("pinocchio") else Missing("pin is not installed")

    def numbers(result):
        if not isinstance(result, tuple):
            return answer(n, spatial, result)
        rates, results = result
        return np.concatenate([rates, results[0].contact_force.linear[: 3 if spatial else 2]])

    reference = ours(n, spatial, False, "bodies") if isinstance(theirs, Missing) else theirs
    exact = numbers(reference())

    def error(result):
        return np.abs(numbers(result) - exact).max() / np.abs(exact).max()

    candidates = [("bodies",), ("joints",)] if n <= 8 else [("bodies",)]
    mine = fastest(partial(ours, n, spatial, in_place), candidates, error, WITHIN) if COMPILER else NO_COMPILER
    how = "the state in place" if in_place else "`Compiled.__call__`"
    title = f"{'Spatial' if spatial else 'Planar'} arm of {n} links, its end guided: q'' and the reaction; {how}"
    return Row(title, mine, {peer: theirs}, error, WITHIN, {peer: bar})


ROWS = {
    f"arm-{'spatial' if spatial else 'planar'}-{n}{'' if in_place else '-call'}": partial(
        one_call, n, spatial, bar, in_place
    )
    for n, spatial, bar in ((4, False, 6), (8, False, 5), (32, False, 2.3), (8, True, 2.5), (32, True, 1.8))
    for in_place in (True, False)
}
