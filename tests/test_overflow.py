"""Exponentials beyond the range of doubles in expressions that are bounded, or grow as their exponents."""

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import servoctl as sv
from servoctl.jets.branches import has_switches
from servoctl.jets.overflow import settled
from servoctl.tolerances import LAST_EXPONENT

S, R = ca.SX.sym("s"), ca.SX.sym("r")
E = ca.exp
FORMS = {  # expression, value and slope at a large exponent, value and slope at one of the opposite sign
    "logistic": (1 / (1 + E(S)), 0, 0, 1, 0),
    "ratio": (E(S) / (1 + E(S)), 1, 0, 0, 0),
    "falling": (E(-3 * S) / (2 + E(-3 * S)), 0, 0, 1, 0),
    "softplus": (ca.log(1 + E(2 * S)), 1600, 2, 0, 0),
    "log1p": (ca.log1p(E(-S)), 0, 0, 800, -1),
    "tangent by hand": ((E(S) - E(-S)) / (E(S) + E(-S)), 1, 0, -1, 0),
    "sinh by cosh": (ca.sinh(S / 2) / ca.cosh(S / 2), 1, 0, -1, 0),
    "sinh of twice": (ca.sinh(2 * S) / ca.cosh(S) ** 2, 2, 0, -2, 0),
    "bell": (E(S) / (1 + E(S)) ** 2, 0, 0, 0, 0),
    "expm1": (ca.expm1(S) / (2 + ca.expm1(S)), 1, 0, -1, 0),
    "two": (1 / (1 + E(S)) + 1 / (1 + E(R)), 0.5, 0, 1.5, 0),
    "square of softplus": (ca.log(1 + E(S)) ** 2 / S**2, 1, 0, 0, 0),
    "built twice": (E(0.5 * S) / (1 + E(S / 2)), 1, 0, 0, 0),
}


def at(expression, s):
    return np.array(ca.Function("f", [S, R], [expression, ca.jacobian(expression, S)])(s, 0.0)).ravel()


@pytest.mark.parametrize("name", FORMS)
def test_bounded_forms_and_their_slopes_are_finite_everywhere(name):
    form, *limits = FORMS[name]
    (whole,) = settled([form])
    for s, limit in ((800.0, limits[:2]), (-800.0, limits[2:]), (2e5, None), (-2e5, None)):
        values = at(whole, s)
        assert np.all(np.isfinite(values)) and np.all(np.isfinite(at(ca.jacobian(whole, S), s)))
        assert limit is None or values == pytest.approx(np.array(limit, dtype=float), abs=1e-12)
    for s in (-40.0, -1.3, 0.2, 7.0, 60.0):  # the same bits where nothing overflows
        assert at(whole, s) == pytest.approx(at(form, s), rel=1e-14)


@pytest.mark.parametrize(
    "form",
    [E(S), E(-(S**2)), S * E(-S), E(S) / (E(S) + E(R)), ca.sin(E(S)) / (1 + E(S)), ca.log(1 / (1 + E(S))), 1e-9 * (E(S) - 1),
     E(E(S)) / (1 + E(S)), E(S) * E(-R) / (1 + E(S)), ca.log(S + E(S) ** 2)],
)  # fmt: skip
def test_what_grows_or_mixes_exponentials_stays_as_it_is(form):
    (same,) = settled([form])
    assert ca.is_equal(same, form, 20) or np.array_equal(at(same, 200.0), at(form, 200.0), equal_nan=True)


def test_last_exponent_is_no_switch():
    whole = settled([1 / (1 + E(40 * (S - 3)))])
    assert abs(LAST_EXPONENT - np.log(1e60)) < 1e-12
    assert not has_switches(ca.vertcat(*whole)) and has_switches(ca.fmin(S, 138.0))
    slope = ca.jacobian(whole[0], S)
    assert not has_switches(slope)


def wall(form, k, where):
    """A mass that is pushed back beyond y = 1 by a wall of steepness k: as a force, a potential, or a residual."""
    q = sv.coordinates("x y")
    x, y = q
    blend = form(k * (y - 1))
    forces = {"y": 2 - 3 * blend} if where == "force" else {"y": 2}
    energy = y**2 + (3 / k * ca.log1p(E(k * (y - 1))) if where == "potential" else 0)
    residual = x - 0.2 * (blend * (y - 1) if where == "residual" else 0) - ca.sin(q.t)
    mechanism = sv.Mechanism(
        q, gibbs=sum(a**2 for a in q.d(2)) / 2, potential=energy, forces=forces, actuators={"F": x, "G": y}
    )
    return mechanism, sv.Program({"X": residual}, by="ideal")


@pytest.mark.parametrize(
    ("form", "k", "where", "method"),
    [
        (lambda s: 1 / (1 + E(-s)), 2000.0, "force", "RadauIIA"),
        (lambda s: E(s) / (1 + E(s)), 1e5, "force", "RadauIIA"),
        (lambda s: 1 / (1 + E(-s)), 5e4, "potential", "LSODA"),
        (lambda s: E(s) / (1 + E(s)), 500.0, "force", "Radau"),
    ],
)
def test_stiff_methods_pass_steep_walls(form, k, where, method):
    model = sv.derive(*wall(form, k, where))
    run = sv.simulate(model, model.start(y=-0.2, dy=0.0), (0.0, 4.0), method, t_eval=[0.0, 4.0])
    reference = solve_ivp(
        lambda t, s: [s[1], 2 - 2 * s[0] - 1.5 * (1 + np.tanh(k * (s[0] - 1) / 2))], (0.0, 4.0), [-0.2, 0.0],
        "LSODA", rtol=1e-10, atol=1e-12, max_step=0.002,
    )  # fmt: skip
    assert run["y"][-1] == pytest.approx(reference.y[0, -1], abs=1e-6)


@pytest.mark.parametrize("method", ["RadauIIA", "DOP853"])
def test_residuals_with_steep_blends_are_kept(method):
    model = sv.derive(*wall(lambda s: E(s) / (1 + E(s)), 2000.0, "residual"))
    run = sv.simulate(model, model.start(y=-0.2, dy=0.0), (0.0, 2.0), method)
    beyond = np.maximum(run["y"] - 1, 0.0)
    assert run["y"].max() > 1.3 and np.abs(run["x"] - 0.2 * beyond - np.sin(run.t)).max() < 1e-3
    assert sv.verify(run).passed


def test_a_loop_meets_a_wall():
    mechanism, _ = wall(lambda s: E(s) / (1 + E(s)), 1000.0, "force")
    plant = sv.plant(mechanism)
    run = sv.close(plant, lambda t, y: {"F": 0.0, "G": 0.5}, [0.0, -1.0, 0.0, 0.0], (0.0, 3.0), timing=sv.Timing(rate=200.0))
    assert run.success and run["y"].max() > 1.0
    A, B = plant.linearised(run.t, run.states, run.inputs)
    assert np.isfinite(A).all() and np.isfinite(B).all()
    further = sv.plant(mechanism, forces={"x": 1 / (1 + E(900 * next(iter(mechanism.q))))})
    assert np.isfinite(further.linearised([0.0], [[5.0], [0.0], [0.0], [0.0]], [[0.0], [0.0]])[0]).all()
