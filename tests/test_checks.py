"""Checks of what a designer gives: values in one form, refusals with the facts and with what is nearest."""

import numpy as np
import pytest

import servoctl as sv
from servoctl import checks


def error_of(check, *given, **options):
    with pytest.raises(sv.SpecificationError) as caught:
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
