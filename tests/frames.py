"""Coordinates with quasi-velocities that several tests use, and agreement of expressions at random points."""

import casadi as ca
import numpy as np
import pytest
from conftest import at_random, numbers

import servoctl as sv


def same(a, b, q, parameters=None, rel=1e-12, **overrides):
    """Assert that two columns agree at three random points."""
    for seed in range(3):
        values = at_random(q, parameters, seed) | overrides
        a_values, b_values = numbers([a], values), numbers([b], values)
        assert np.all(np.isfinite(a_values))
        assert a_values == pytest.approx(b_values, rel=rel, abs=rel * np.abs(b_values).max())


def boat():
    plain = sv.coordinates("x y psi")
    _, _, psi = plain
    V = [[ca.cos(psi), -ca.sin(psi), 0], [ca.sin(psi), ca.cos(psi), 0], [0, 0, 1]]
    return plain.with_quasi_velocities("u v r", V)


def euler_angles():
    """z-y-x angles with body rates."""
    plain = sv.coordinates("yaw pitch roll")
    yaw, pitch, roll = plain
    turn = [
        [[ca.cos(yaw), -ca.sin(yaw), 0], [ca.sin(yaw), ca.cos(yaw), 0], [0, 0, 1]],
        [[ca.cos(pitch), 0, ca.sin(pitch)], [0, 1, 0], [-ca.sin(pitch), 0, ca.cos(pitch)]],
        [[1, 0, 0], [0, ca.cos(roll), -ca.sin(roll)], [0, ca.sin(roll), ca.cos(roll)]],
    ]
    Z, Y, X = (ca.vertcat(*(ca.horzcat(*row) for row in matrix)) for matrix in turn)
    rates = [
        [0, ca.sin(roll) / ca.cos(pitch), ca.cos(roll) / ca.cos(pitch)],
        [0, ca.cos(roll), -ca.sin(roll)],
        [1, ca.sin(roll) * ca.tan(pitch), ca.cos(roll) * ca.tan(pitch)],
    ]
    return plain, Z @ Y @ X, rates


def quaternion():
    plain = sv.coordinates("e0 e1 e2 e3")
    e0, e1, e2, e3 = plain
    V = [[-e1, -e2, -e3], [e0, -e3, e2], [e3, e0, -e1], [-e2, e1, e0]]
    V = [[v / 2 for v in row] for row in V]
    rotation = ca.vertcat(
        ca.horzcat(1 - 2 * (e2**2 + e3**2), 2 * (e1 * e2 - e0 * e3), 2 * (e1 * e3 + e0 * e2)),
        ca.horzcat(2 * (e1 * e2 + e0 * e3), 1 - 2 * (e1**2 + e3**2), 2 * (e2 * e3 - e0 * e1)),
        ca.horzcat(2 * (e1 * e3 - e0 * e2), 2 * (e2 * e3 + e0 * e1), 1 - 2 * (e1**2 + e2**2)),
    )
    norm = sum(e**2 for e in plain) - 1
    return plain.with_quasi_velocities("p q r", V, invariants={"unit": norm}), rotation


UNIT = {"e0": 0.5, "e1": -0.7, "e2": 0.1, "e3": 0.5}
