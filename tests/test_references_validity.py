"""Models with references are affirmed with other parameters by a few evaluations, as others are."""

import casadi as ca
import numpy as np
import pytest
import referred

import servoctl as sv
from servoctl.model.full import affirmed
from servoctl.model.model import Model


def tip(formula):
    """A double pendulum, of which one link follows from the other: the rows contain parameters."""
    q = sv.coordinates("a b")
    a, b = q
    p = sv.parameters(m=2.0, L=0.5, l=0.7, g=9.81)
    end = ca.vertcat(p.L * ca.sin(a) + p.l * ca.sin(a + b), -p.L * ca.cos(a) - p.l * ca.cos(a + b))
    mechanism = sv.Mechanism(q, sv.particle(q, p.m, end), p.m * p.g * end[1], {"shoulder": a, "elbow": b}, p)
    spec = {"start": (0.6, -0.4), "end": (0.3, -0.7), "duration": 2.0}
    if formula:
        to = referred.polynomial(q.t, **spec)
    else:
        path = sv.paths.rest_to_rest(**spec)
        to = [*q.references(x=path[0], y=path[1])]
    return sv.derive(
        mechanism, sv.Program({"X": end[0] - to[0], "Y": end[1] - to[1]}, by="actuators"), guess={"a": 0.2}
    )


def affirmed_by_both(make):
    old, new = make(formula=True), make(formula=False)
    values = new.parameters[:, None] * np.random.default_rng(3).uniform(0.5, 1.5, (len(new.parameters), 40))
    values[0, :3] = 0.0, -1.0, 1e-9
    return affirmed(old, values), affirmed(new, values)


@pytest.mark.parametrize("make", [referred.crane, referred.cart])
def test_what_is_affirmed_is_that_along_a_formula(make):
    old, new = affirmed_by_both(make)
    assert np.array_equal(old, new) and new[3:].all() and not new[1]


def test_links_that_reach_no_point_of_theirs_are_not_affirmed():
    """The points of references lie anywhere in the reach of the links, and stay where links become shorter."""
    old, new = affirmed_by_both(tip)
    assert old[3:].all() and not (new & ~old).any() and 10 < new[3:].sum() < 37


@pytest.mark.parametrize("make", [referred.crane, tip])
def test_other_parameters_need_no_other_derivation(make, monkeypatch):
    model = make(formula=False)
    monkeypatch.setattr(Model, "_of", lambda *_: pytest.fail("derived again"))
    name = list(model.numbers)[0]
    other = model.with_parameters(**{name: 1.1 * model.numbers[name]})
    assert other.reduction is model.reduction and np.array_equal(other.p[1:], other.parameters)


def test_references_that_are_made_later_do_not_matter_to_a_model():
    """Points at which ranks were decided have no jets of these: other parameters are judged at them all the same."""
    model = referred.cart()
    model.reduction.mechanism.q.references(later=None, latest=sv.paths.rest_to_rest(0.0, 1.0, 1.0))
    heavier = model.with_parameters(m=0.2)
    run = sv.simulate(heavier, heavier.start(theta=0.0, dtheta=0.0), (0.0, 0.5))
    assert run.success and sv.verify(run).passed
