"""A balance from elsewhere, such as a robot library's inverse dynamics: gravity in it, and its mass matrix."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.errors import SpecificationError


def hanging(inertia):
    """A load under a cart, its balance given: with gravity in it ("balance"), or with a potential ("split", "kinetic")."""
    q, p = sv.coordinates("x theta"), sv.parameters(m=1.0, M=2.0, l=1.5, g=9.81)
    (x, theta), (m, M, length, g) = q, p.symbols
    X, Z = x + length * ca.sin(theta), -length * ca.cos(theta)
    machine = {"actuators": {"F": x, "tau": theta}, "parameters": p}
    kinetic = (M * q.d(1)[0] ** 2 + m * (q.dt(X) ** 2 + q.dt(Z) ** 2)) / 2
    whole = sv.Mechanism(q, kinetic=kinetic, potential=m * g * Z, **machine)
    if inertia == "balance":
        return sv.Mechanism(q, balance=whole.balance, **machine)
    inertial = sv.Mechanism(q, kinetic=kinetic, **machine).balance
    return whole if inertia == "kinetic" else sv.Mechanism(q, balance=inertial, potential=m * g * Z, **machine)


@pytest.mark.parametrize("inertia", ["balance", "split"])
def test_a_balance_with_gravity_keeps_forces_and_power(inertia):
    runs = []
    for mechanism in (hanging("kinetic"), hanging(inertia)):
        (x, theta), t = mechanism.q, mechanism.q.t
        program = sv.Program({"x": x - ca.sin(t), "theta": theta - 0.3 * ca.cos(2 * t)})
        model = sv.derive(mechanism, program)
        runs.append(sv.simulate(model, model.start(), (0.0, 2.0)))
        rate, work, _, unlawful, _ = runs[-1].signals("power")[1]
        assert np.abs(unlawful).max() < 1e-12 and rate == pytest.approx(work, abs=1e-12)
        assert sv.verify(runs[-1]).passed
    expected, run = runs
    assert run["F"] == pytest.approx(expected["F"], abs=1e-12) and run["tau"] == pytest.approx(expected["tau"], abs=1e-12)
    plant = sv.plant(mechanism)
    closed = sv.close(plant, sv.lqr(run, plant), [0.1, 0.2, 1.0, 0.0], (0.0, 2.0))
    assert sv.verify(closed).passed and not sv.verify(closed).notes


def test_a_balance_whose_mass_matrix_is_not_symmetric_is_refused():
    q = sv.coordinates("a b")
    dda, ddb = q.d(2)
    for factor in (0.5, 1.5, -1e-3):
        with refused(SpecificationError, components=["d2a", "d2b"]):
            sv.Mechanism(q, balance=ca.vertcat(dda, ddb + factor * dda - 1))
    right = hanging("balance")
    combined = ca.vertcat(right.balance[0] + right.balance[1], right.balance[1])
    with refused(SpecificationError, components=["d2x", "d2theta"]):
        sv.Mechanism(right.q, balance=combined, parameters=right.parameters)


def test_products_of_decimals_in_either_order_are_symmetric():
    """0.8·0.1·0.3 and 0.8·0.3·0.1 differ by a rounding error."""
    q = sv.coordinates("a b")
    a, b = q
    weight, along = 0.8, ca.vertcat(0.1, 0.3)
    assert weight * 0.1 * 0.3 != weight * 0.3 * 0.1
    balance = ca.vertcat(*q.d(2)) + weight * along * q.dt(0.1 * a + 0.3 * b, 2)
    assert sv.Mechanism(q, balance=balance).mass.shape == (2, 2)


def test_a_given_balance_has_the_relaxed_plan_of_its_machine():
    """What the balance holds at rest, such as gravity, once came to it again as forces, which then was refused."""
    q = sv.coordinates("x th")
    x, th = q
    load = ca.vertcat(x + 5 * ca.sin(th), -5 * ca.cos(th))
    S = sv.particle(q, 2.5, x) + sv.particle(q, 60.0, load)
    crane = sv.Mechanism(q, S, potential=60 * 9.81 * load[1], actuators={"f": x})
    given = sv.Mechanism(q, balance=crane.balance, actuators={"f": x})
    path = q.references(load=sv.paths.rest_to_rest(0.0, 3.0, duration=6.0, smoothness=4)).load
    program = sv.Program({"load": load[0] - path})
    plan, other = (sv.relaxed(sv.plant(each), program, (0.0, 6.0)) for each in (crane, given))
    assert np.abs(plan["f"] - other["f"]).max() < 1e-9 * np.abs(plan["f"]).max()
