"""The error classes: four parts in the message, facts in the details, nearest names."""

import pickle

import pytest

from servoctl import errors

CHILDREN = [
    errors.SpecificationError,
    errors.NotRealisable,
    errors.InconsistentStart,
    errors.SingularProgram,
    errors.UnstableInternalDynamics,
    errors.LimitExceeded,
    errors.IntegrationStopped,
    errors.NameUnknown,
]


@pytest.mark.parametrize("child", CHILDREN)
def test_children_are_documented_servo_errors(child):
    assert issubclass(child, errors.ServoError) and issubclass(child, ValueError)
    assert child.__doc__.startswith("Raised when")


def test_message_joins_the_parts_that_are_there_as_sentences():
    error = errors.ServoError("duration = -1 s", "A duration is positive", do="Give a positive number!", duration=-1)
    assert str(error) == "duration = -1 s. A duration is positive. Give a positive number!"
    assert error.details == {"duration": -1}
    assert error.run is None


def test_message_is_one_line():
    assert str(errors.ServoError("a value\n    broken over lines")) == "a value broken over lines."


def test_error_survives_pickling():
    error = errors.SingularProgram("the wheel stops", "rank lost", t=0.69831)
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is errors.SingularProgram
    assert (str(again), again.details, again.run) == (str(error), {"t": 0.69831}, None)


@pytest.mark.parametrize(
    ("name", "nearest"), [("thetta", "theta"), ("THETA", "theta"), ("M", "m"), ("q99", None), (7, None)]
)
def test_unknown_shows_the_nearest_name_and_all_names(name, nearest):
    error = errors.unknown(name, iter(["x", "theta", "m"]), "coordinate")
    assert isinstance(error, errors.NameUnknown)
    assert repr(name) in str(error) and "x, theta, m" in str(error) and "coordinate" in str(error)
    assert error.details == {"name": name, "valid": ("x", "theta", "m"), "match": nearest}
    assert nearest is None or f"Nearest: {nearest!r}" in str(error)


def test_unknown_prefers_the_first_of_names_that_differ_by_case():
    assert errors.unknown("Mm", ["m", "M", "mM", "MM"], "parameter").details["match"] == "mM"


def test_unknown_where_no_name_exists():
    assert "There is no actuator at all" in str(errors.unknown("trolley", [], "actuator"))
