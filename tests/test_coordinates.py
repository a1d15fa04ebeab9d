"""Coordinates, quasi-velocities, parameters and programs: names, symbols, sizes, refusals."""

import casadi as ca
import numpy as np
import pytest
from conftest import at_random, numbers
from frames import boat
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, SpecificationError
from servoctl.gallery import gallery


def names_of(symbols):
    return [s.name() for s in symbols]


# coordinates ---------------------------------------------------------------------------------------------------------


def test_coordinates_have_symbols_names_and_jets_of_any_order():
    q = sv.coordinates("x l theta")
    assert names_of(q) == ["x", "l", "theta"] == list(q.names)
    assert names_of(q.d(0)) == ["x", "l", "theta"]
    assert names_of(q.d()) == names_of(q.d(1)) == ["dx", "dl", "dtheta"]
    assert names_of(q.d(2)) == ["d2x", "d2l", "d2theta"]
    assert names_of(q.d(17)) == ["d17x", "d17l", "d17theta"] == list(q.jet_names(17))
    assert all(a.element_hash() == b.element_hash() for a, b in zip(q.d(5), q.d(5), strict=True))
    assert q.t.name() == "t"
    assert len([*q.d(3)]) == 3 and q.d(3).shape == (3, 1)
    assert (len(q), q.nq, q.n) == (3, 3, 3)
    assert repr(q) == "Coordinates(x l theta)"


def test_symbols_of_two_coordinates_values_are_different():
    one, other = sv.coordinates("x"), sv.coordinates("x")
    assert one.where(next(iter(one))) == ("q", 0, 0)
    assert one.where(next(iter(other))) is None
    assert one.where(other.t) is None


def test_order_of_an_expression_is_its_highest_jet():
    q = sv.coordinates("x y")
    x, y = q
    assert q.order(x * q.t) == 0
    assert q.order(q.t) == -1
    assert q.order(ca.SX(3.0)) == -1
    assert q.order(ca.vertcat(x, q.d(3)[1] * y)) == 3


@pytest.mark.parametrize(
    ("names", "fact"),
    [
        ("x dx", "'dx'"),
        ("x y d2x", "'d2x'"),
        ("dx x", "'dx'"),
        ("x x", "twice"),
        ("x t", "'t'"),
        ("x 2y", "'2y'"),
        ("x-y", "'x-y'"),
        ("", "''"),
        ("  ", "separated by blanks"),
        (None, "None"),
        (["x", "y"], "separated by blanks"),
        (3, "3"),
        (b"x y", "b'x y'"),
    ],
)
def test_names_that_clash_or_are_none_are_refused(names, fact):
    with pytest.raises(SpecificationError) as caught:
        sv.coordinates(names)
    assert fact in str(caught.value)


def test_names_that_only_begin_like_derivatives_are_kept():
    q = sv.coordinates("x d d2 distance ddx dt2")
    assert q.names == ("x", "d", "d2", "distance", "ddx", "dt2")


@pytest.mark.parametrize("order", [-1, 1.5, None, "1", 2.0])
@pytest.mark.parametrize("plain", [True, False])
def test_orders_that_are_no_whole_numbers_are_refused(order, plain):
    q = sv.coordinates("x y")
    if not plain:
        q = q.with_quasi_velocities("u v", [[1, 0], [0, 1]])
    for ask in (q.d, q.w, lambda k: q.dt(ca.vertcat(*q), k)):
        with refused(SpecificationError, "order"):
            ask(order)


# quasi-velocities ----------------------------------------------------------------------------------------------------


def test_quasi_velocities_have_names_of_their_own():
    q = boat()
    assert q.velocity_names == ("u", "v", "r")
    assert names_of(q.w()) == ["u", "v", "r"]
    assert names_of(q.w(1)) == ["du", "dv", "dr"] == list(q.jet_names(2))
    assert names_of(q.w(2)) == ["d2u", "d2v", "d2r"]
    assert repr(q) == "Coordinates(x y psi), quasi-velocities u v r)".replace("psi)", "psi", 1)
    values = at_random(q)
    u, v, psi = values["u"], values["v"], values["psi"]
    dx, dy, dpsi = numbers(q.d(1), values)
    assert dx == pytest.approx(u * np.cos(psi) - v * np.sin(psi))
    assert dy == pytest.approx(u * np.sin(psi) + v * np.cos(psi))
    assert dpsi == pytest.approx(values["r"])


def test_quasi_velocities_keep_the_symbols_of_the_coordinates():
    plain = sv.coordinates("x y")
    q = plain.with_quasi_velocities("u v", ca.SX.eye(2), h=[0, plain.t])
    assert all(a.element_hash() == b.element_hash() for a, b in zip(plain, q, strict=True))
    assert q.t.element_hash() == plain.t.element_hash()
    assert plain.plain and not q.plain
    assert names_of(plain.d(1)) == ["dx", "dy"]
    assert numbers(q.d(2), {"du": 2.0, "dv": 3.0}) == pytest.approx([2.0, 4.0])


@pytest.mark.parametrize(
    ("names", "V", "facts"),
    [
        ("u v", [[1, 0, 0], [0, 1, 0]], ["(2, 3)", "(2, 2)"]),
        ("u", [[1, 0], [0, 1]], ["(2, 2)", "(2, 1)"]),
        ("u dx", [[1, 0], [0, 1]], ["'dx'"]),
        ("u x", [[1, 0], [0, 1]], ["'x'"]),
        ("u du", [[1, 0], [0, 1]], ["'du'"]),
        ("u u", [[1, 0], [0, 1]], ["'u'", "twice"]),
        ("u t", [[1, 0], [0, 1]], ["'t'"]),
        ("", [[1, 0], [0, 1]], ["names"]),
    ],
)
def test_quasi_velocities_of_wrong_size_or_name_are_refused(names, V, facts):
    with pytest.raises(SpecificationError) as caught:
        sv.coordinates("x y").with_quasi_velocities(names, V)
    assert [fact for fact in facts if fact not in str(caught.value)] == []


def test_frames_that_depend_on_velocities_are_refused():
    q = sv.coordinates("x y")
    with refused(SpecificationError, "V", "dx"):
        q.with_quasi_velocities("u v", [[1, q.d(1)[0]], [0, 1]])
    with refused(SpecificationError, "h", "dy"):
        q.with_quasi_velocities("u v", [[1, 0], [0, 1]], h=[q.d(1)[1], 0])
    with refused(SpecificationError, "3", "2", what="h"):
        q.with_quasi_velocities("u v", [[1, 0], [0, 1]], h=[0, 0, 0])


def test_a_frame_with_a_foreign_symbol_is_refused_by_the_mechanism():
    q = sv.coordinates("x y")
    foreign = ca.SX.sym("slope")
    q = q.with_quasi_velocities("u v", [[1, foreign], [0, 1]])
    with refused(SpecificationError, name="slope"):
        sv.Mechanism(q, gibbs=sv.particle(q, 1.0, tuple(q)))


# parameters and program ----------------------------------------------------------------------------------------------


def test_parameters_are_symbols_with_numbers():
    p = sv.parameters(m=1.0, g=9.81, n=3)
    assert p.names == ("m", "g", "n")
    assert names_of(p.symbols) == ["m", "g", "n"]
    assert p.m.element_hash() == p.symbols[0].element_hash()
    assert p.defaults == {"m": 1.0, "g": 9.81, "n": 3.0}
    assert p.values() == pytest.approx([1.0, 9.81, 3.0])
    assert p.values({"g": 1.62}) == pytest.approx([1.0, 1.62, 3.0])
    assert p.defaults["g"] == 9.81
    assert sv.parameters().values().shape == (0,)


@pytest.mark.parametrize(
    "value", [np.nan, np.inf, -np.inf, None, "heavy", 1j, [1.0, 2.0], ca.SX.sym("m"), ca.MX.sym("m"), ca.DM([1, 2])]
)
def test_parameters_that_are_no_finite_numbers_are_refused(value):
    with refused(SpecificationError, name="m") as caught:
        sv.parameters(g=9.81, m=value)
    assert caught.value.details["name"] == "m"
    with refused(SpecificationError, name="m"):
        sv.parameters(m=1.0).values({"m": value})


def test_unknown_parameters_show_the_nearest():
    p = sv.parameters(m_load=100.0, m_trolley=10.0)
    with refused(NameUnknown, name="m_laod", match="m_load") as caught:
        _ = p.m_laod
    assert caught.value.details["match"] == "m_load"
    with refused(NameUnknown, name="m_troley", match="m_trolley"):
        p.values({"m_troley": 1.0})


@pytest.mark.parametrize("name", ["t", "names", "values", "symbols", "defaults"])
def test_parameters_do_not_hide_attributes(name):
    with refused(SpecificationError, repr(name)):
        sv.parameters(**{name: 1.0})


def test_programs_name_their_residuals():
    q = sv.coordinates("x y")
    x, y = q
    program = sv.Program({"X": x - q.t, "Y": [y]})
    assert program.names == ("X", "Y") and program.by == "actuators"
    assert repr(program) == "Program(X, Y; by actuators)"


@pytest.mark.parametrize("name", gallery)
def test_everything_prints_itself_in_at_most_eight_lines(name):
    mechanism, program = gallery[name].build()
    for value in (mechanism, program, mechanism.q, mechanism.parameters):
        lines = repr(value).splitlines()
        assert 1 <= len(lines) <= 8
        assert max(map(len, lines)) <= 120
