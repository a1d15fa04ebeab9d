"""Operations grow with the number of links where everything is sparse, whoever describes the bodies."""

from functools import cache

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.codegen.emit import operations
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.gallery import planar_arm, spatial_arm
from servoctl.model import saddle
from servoctl.model.model import derive
from servoctl.reduction import ranks


@pytest.fixture(scope="module")
def model():
    """A function from a number of links to the planar arm of bodies, or in joint angles, derived at the first call."""

    @cache
    def get(n, coordinates="bodies"):
        return derive(*planar_arm(n, coordinates))

    return get


@pytest.mark.parametrize("name", ["accelerations", "ode"])
def test_operations_are_linear_in_the_number_of_links(name, model):
    counts = {n: model(n).function(name).operations for n in (8, 16, 32)}
    assert counts[32] <= 2.15 * counts[16] and counts[16] <= 2.15 * counts[8]
    assert counts[32] <= 120 * 32


@pytest.mark.parametrize("name", ["accelerations", "ode"])
def test_operations_are_linear_in_joint_angles_too(name, model):
    counts = {n: model(n, "joints").function(name).operations for n in (16, 32)}
    assert counts[32] <= 2.1 * counts[16] and counts[32] <= 200 * 32


def test_bodies_take_fewer_operations_than_joint_angles_from_four_links_on(model):
    for n in (4, 8):
        joints = model(n, "joints").function("accelerations").operations
        assert model(n).function("accelerations").operations < joints < 200 * n


def test_the_ranks_of_many_bodies_are_decided_by_nonzero_entries(monkeypatch):
    """Elimination of full matrices is cubic in their size: it is not used for bodies."""
    sizes = []

    def noted(a):
        sizes.append(max(a.shape[1:]))
        return full(a)

    full = ranks._dense_pivots
    monkeypatch.setattr(ranks, "_dense_pivots", noted)
    derive(*planar_arm(24, "bodies"))
    assert max(sizes, default=0) < ranks.LARGE


def test_a_spatial_arm_of_bodies_takes_fewer_operations_than_one_of_joint_angles():
    count = {c: derive(*spatial_arm(8, c)).function("accelerations").operations for c in ("joints", "bodies")}
    assert count["bodies"] < 345 * 8 and count["joints"] < 345 * 8


# the same answers ----------------------------------------------------------------------------------------------------


def _chain(q, v, l=0.5, m=1.0, g=9.81):
    """Joint accelerations and force on the end of a planar arm whose end is not accelerated, by dense matrices.

    Inclinations are the coordinates of M and of the rows of the end; each rod pulls with half its own mass and with
    all of the masses behind it.
    """
    n = len(q)
    phi, rate = np.cumsum(q), np.cumsum(v)
    behind = np.array([[n - 1 - max(i, j) + (0.25 + 1 / 12 if i == j else 0.5) for j in range(n)] for i in range(n)])
    difference = phi[:, None] - phi[None, :]
    M = m * l**2 * behind * np.cos(difference)
    h = m * l**2 * (behind * np.sin(difference)) @ rate**2 + m * g * l * (n - 0.5 - np.arange(n)) * np.cos(phi)
    J = l * np.array([-np.sin(phi), np.cos(phi)])
    drift = -l * np.array([np.cos(phi), np.sin(phi)]) @ rate**2
    full = np.block([[M, -J.T], [J, np.zeros((2, 2))]])
    solution = np.linalg.solve(full, np.concatenate([-h, -drift]))
    return np.diff(solution[:n], prepend=0.0), solution[n:]


def _bodies(q, v, l=0.5):
    phi, rate = np.cumsum(q), np.cumsum(v)
    along, across = l * np.array([np.cos(phi), np.sin(phi)]), l * np.array([-np.sin(phi), np.cos(phi)]) * rate
    middles = [np.cumsum(part, axis=1) - part / 2 for part in (along, across)]
    return np.concatenate([np.vstack([middles[0], phi]).T.ravel(), np.vstack([middles[1], rate]).T.ravel()])


@pytest.mark.parametrize("n", [4, 16, 32])
def test_bodies_agree_with_the_dense_equations(n, model):
    q, v = np.random.default_rng(n).uniform(-1.0, 1.0, (2, n))
    expected, force = _chain(q, v)
    y = model(n).function("accelerations")(0.0, _bodies(q, v), model(n).p)
    rates = np.diff(y[2 : 3 * n : 3], prepend=0.0)
    assert np.abs(rates - expected).max() < 1e-10 * np.abs(expected).max()
    assert np.abs(y[3 * n : 3 * n + 2] - force).max() < 1e-10 * np.abs(force).max()


@pytest.mark.parametrize("n", [2, 5, 9, 32])  # by (3.18) and, above 8 coordinates, by the sparse elimination
def test_joint_angles_agree_with_the_dense_equations(n, model):
    model = model(n, "joints")
    q, v = np.random.default_rng(n).uniform(-1.0, 1.0, (2, n))
    expected, force = _chain(q, v)
    y = model.function("accelerations")(0.0, np.concatenate([q, v]), model.p)
    scale = np.abs(expected).max()
    assert np.abs(y[:n] - expected).max() < 1e-9 * scale
    assert np.abs(y[n:] - force).max() < 1e-9 * np.abs(force).max()
    rates = model.function("ode")(0.0, np.concatenate([q, v]), model.p)[n : 2 * n]
    assert np.abs(rates - expected).max() < 1e-9 * scale


def test_spatial_bodies_agree_with_joint_angles():
    n = 4
    joints, bodies = (derive(*spatial_arm(n, c)) for c in ("joints", "bodies"))
    q, v = np.random.default_rng(1).uniform(-1.0, 1.0, (2, n))
    held = {f"theta{i + 1}": q[i] for i in range(n)} | {f"dtheta{i + 1}": v[i] for i in range(n)}
    expected = joints.function("accelerations")(0.0, np.concatenate([q, v]), joints.p)
    y = bodies.function("accelerations")(0.0, bodies.start(**held).values, bodies.p)
    assert np.abs(y[: 7 * n : 7] - expected[:n]).max() < 1e-10 * np.abs(expected).max()
    assert np.abs(y[7 * n : 7 * n + 3] - expected[n:]).max() < 1e-10 * np.abs(expected).max()


def _by_motors(mechanism, program):
    """The same program, realised by the torques of motors in two joints."""
    q = mechanism.q
    phi = dict(zip(q.names, q, strict=True))
    motors = {f"motor {i}": phi[f"phi{i}"] - phi[f"phi{i - 1}"] for i in (2, 3)}
    parts = {"constraints": mechanism.constraints, "parameters": mechanism.parameters}
    driven = sv.Mechanism(q, balance=mechanism.balance, actuators=motors, **parts)
    return driven, sv.Program(program.residuals, by="actuators")


@pytest.mark.parametrize("poles", [False, True])
@pytest.mark.parametrize(("coordinates", "driven"), [("bodies", False), ("bodies", True), ("joints", False)])
def test_the_sparse_elimination_gives_what_3_18_gives(poles, coordinates, driven):
    arm = planar_arm(4, coordinates)
    equations = derive(*(_by_motors(*arm) if driven else arm)).equations
    assert saddle.applies(equations.r) and equations.sparse == (coordinates == "bodies")
    shared = saddle.matrix(equations).shape[0] - 4 * {"bodies": 3, "joints": 1}[coordinates] - 2
    assert shared == {"bodies": 8, "joints": 18}[coordinates], "material constraints, or sums of the joint angles"
    sparse, multipliers, _ = saddle.solve(equations, poles)
    dense = equations.dense(poles)
    expected = ca.substitute(equations.r.multipliers, ca.vertcat(*equations.q.gamma(2)), dense)
    sparse, dense = ca.vertcat(sparse, multipliers), ca.vertcat(dense, expected)
    extra = [c for row in equations.coefficients for c in row]
    x = ca.vertcat(equations.state, *extra)
    f = ca.Function("f", [equations.q.t, x, equations.parameters], [sparse, dense])
    values = np.random.default_rng(3).uniform(0.3, 1.2, x.numel())
    a, b = (y.full().ravel() for y in f(0.0, values, [1.0, 0.5, 9.81]))
    assert np.abs(a - b).max() < 1e-11 * np.abs(a).max()


def test_an_arm_of_bodies_moves_as_the_one_of_joint_angles():
    q, v = np.array([-0.9, 0.7, 0.5]), np.array([0.2, -0.3, 0.4])
    bodies, joints = (derive(*planar_arm(3, c)) for c in ("bodies", "joints"))
    assert bodies.equations.sparse and not joints.equations.sparse
    start = bodies.start(guess=dict(zip(bodies.state_names, _bodies(q, v), strict=True)))
    other = joints.start(**dict(zip(joints.state_names, [*q, *v], strict=True)))
    method, options = sv.methods.Adaptive(rtol=1e-11, atol=1e-12), {"t_eval": [0.0, 0.2, 0.4], "progress": False}
    run, expected = (sv.simulate(m, x, (0.0, 0.4), method, **options) for m, x in ((bodies, start), (joints, other)))
    for i, total in enumerate(np.cumsum([expected[f"theta{k}"] for k in (1, 2, 3)], axis=0)):
        assert np.abs(run[f"phi{i + 1}"] - total).max() < 1e-8
    for name in "XY":
        end = run[name]
        assert abs(end[2] - 2 * end[1] + end[0]) < 1e-9  # not accelerated
        assert np.abs(run[f"multiplier_{name}"] - expected[f"multiplier_{name}"]).max() < 1e-6


def test_accelerations_are_refused_where_the_balance_is_differentiated(gallery_model):
    with refused(SpecificationError, "order 2", "1 hidden"):
        gallery_model("overhead-crane").function("accelerations")


def test_arms_refuse_what_they_do_not_know():
    for arm, least in ((planar_arm, 2), (spatial_arm, 3)):
        with refused(SpecificationError, f"n = {least}"):
            arm(least - 1)
        with pytest.raises(NameUnknown):
            arm(4, "absolute")


def test_the_operations_of_a_total_derivative_are_quadratic_in_its_order():
    q = sv.coordinates("x y")
    dx, dy = q.d(1)
    d2x, d2y = q.d(2)
    curvature = (dx * d2y - dy * d2x) / (dx**2 + dy**2) ** 1.5

    def count(k):
        jets = ca.vertcat(*q, *(s for j in range(1, k + 3) for s in q.d(j)))
        return operations(ca.Function("D", [jets], [ca.cse(q.dt(curvature, k))]))

    counts = [count(k) for k in (2, 4, 8, 16)]
    assert all(b <= 4 * a for a, b in zip(counts, counts[1:], strict=False))
