"""Checks of what a designer gives: values in one form, refusals with the facts and with what is nearest."""

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl import checks
from servoctl.units import as_units
from servoctl.values import evenly


def error_of(check, *given, **options):
    with pytest.raises(sv.errors.SpecificationError) as caught:
        check(*given, **options)
    return caught.value


@pytest.mark.parametrize("given", [3, 3.0, np.int64(3), np.float64(3.0)])
def test_whole_numbers_become_int(given):
    number = checks.whole("n", given)
    assert number == 3 and type(number) is int


@pytest.mark.parametrize("given", [-1, 2.5, True, "3", None, np.nan, np.inf, [3]])
def test_what_is_no_whole_number_is_refused(given):
    assert error_of(checks.whole, "n", given).details["name"] == "n"


def test_the_least_whole_number_is_a_bound():
    assert checks.whole("n", 1, least=1) == 1
    assert error_of(checks.whole, "n", 0, least=1).details["value"] == 0


@pytest.mark.parametrize(("given", "limits"), [(2, (-2.0, 2.0)), ((1, None), (1.0, np.inf)), ((None, 3), (-np.inf, 3.0))])
def test_intervals(given, limits):
    assert checks.interval("force", given, "limit") == limits


@pytest.mark.parametrize("given", [0, -1, (1, 1), (None, None), (1, 2, 3), "a", np.nan])
def test_what_is_no_interval_is_refused(given):
    assert error_of(checks.interval, "force", given, "limit").details["name"] == "force"


def test_the_interval_nearest_to_exchanged_limits_is_computed():
    assert "Nearest: (1, 5)." in str(error_of(checks.interval, "force", (5, 1), "limit"))
    assert "Nearest: (-3, 3)." in str(error_of(checks.interval, "force", -3, "limit"))
    assert "Nearest" not in str(error_of(checks.interval, "force", "a", "limit"))


def test_spans():
    assert checks.as_span([2, 1]) == (2.0, 1.0)
    assert "Nearest: (1, 2)." in str(error_of(checks.as_span, (2, 1), forward=True))
    for given in (3, (1, 1), (0, np.inf), "ab", None):
        assert error_of(checks.as_span, given).details["t_span"] == given


def test_arrays_hold_numbers_alone():
    for array in ([1.0, True], ["1.0"], np.array([True]), [1.0, None], b"1", 10**400, [10**400, 1.0], [1j], object()):
        assert np.isnan(checks.as_numbers(array)).any()
        error_of(checks.array_of, "x", array, None)
    assert checks.array_of("x", range(3), 3).tolist() == [0.0, 1.0, 2.0]
    error = error_of(checks.array_of, "x", np.ones((2, 3)), 2, None, None)
    assert (error.details["shape"], error.details["expected"]) == ((2, 3), (2, None, None))


def test_lists_have_an_order():
    assert checks.as_list(iter([1, 2])) == [1, 2] and checks.as_list(np.arange(2)) == [0, 1]
    for value in ("ab", b"ab", {"a": 1}, {1}, 3, None, ca.SX.sym("x"), ca.MX.sym("x", 2)):
        assert checks.as_list(value) is None


def test_kinds_texts_and_units():
    assert checks.require_kind(dict, "columns", {}, "dict()") == {}
    assert error_of(checks.require_kind, dict, "columns", [], "dict()").details == {"name": "columns", "type": "list"}
    assert checks.texts("x", "The names") == ("x",) and checks.texts(["x", "y"], "The names") == ("x", "y")
    for value in (["x", 1], {"x"}, None, 3):
        assert error_of(checks.texts, value, "The names").details["value"] == value
    for value in (None, 3, b"x", "\ud800"):
        assert error_of(checks.text, "title", value).details["value"] == value
    assert as_units(None) == {} and as_units({"x": "m"}) == {"x": "m"}
    for units in ({"x": 1}, {1: "m"}, ["m"], "m"):
        error_of(as_units, units)


def test_expressions_hold_no_truth_values():
    for value in (True, np.True_, [1.0, True]):
        assert error_of(checks.column, value, "the mass").details["what"] == "the mass"


@pytest.mark.parametrize("progress", ["yes", 1, [True], lambda: None, lambda t, x: None])
def test_progress_is_a_switch_or_a_function_of_the_time(wheel, progress):
    assert error_of(sv.simulate, *wheel, (0.0, 0.1), "RK4", progress=progress).details["progress"] is progress


def test_bars_work_without_a_terminal(monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    assert len(sv.sweep(lambda a: {"b": a}, [{"a": 1.0}])) == 1


@pytest.mark.parametrize("given", [0.0, -1.0, 3.5, np.nan, np.inf, "1", True, None, [1.0], ca.SX.sym("a")])
def test_a_number_out_of_range_is_refused_with_the_nearest_one(given):
    with refused(sv.errors.SpecificationError, "fps=", name="fps"):
        checks.within("fps", given, most=3.0, above=0.0)


def test_a_range_has_its_ends():
    assert [checks.within("fps", given, 1, 3) for given in (1, np.float32(3.0), np.int8(2))] == [1.0, 3.0, 2.0]
    with refused(sv.errors.SpecificationError, "fps=3", value=4.0):
        checks.within("fps", 4.0, 1, 3)


def test_options_that_do_nothing_are_named():
    checks.without_effect([], "here")
    with refused(sv.errors.SpecificationError, "rate, delay", options=["rate", "delay"]):
        checks.without_effect(["rate", "delay"], "for a Model")


def test_indices_are_spread_from_the_first_to_the_last():
    assert evenly(5, 3).tolist() == [0, 2, 4] and evenly(2, 9).tolist() == [0, 1] and evenly(1, 4).tolist() == [0]
