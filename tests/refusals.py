"""Errors and warnings asserted by their type and facts, never by their sentences."""

from contextlib import contextmanager

import pytest

from servoctl.errors import ServoError


@contextmanager
def refused(kind, *facts, **details):
    """An error of exactly this kind, with these facts in its text and these entries in its `.details`.

    Facts are names and numbers of the input; a dict among them is read as details, so that a row of a table may be one.
    """
    with pytest.raises(kind) as caught:
        yield caught
    error, text = caught.value, str(caught.value)
    assert type(error) is kind, text
    missing = [fact for fact in facts if not isinstance(fact, dict) and str(fact) not in text]
    assert not missing, text
    for fact in facts:
        details |= fact if isinstance(fact, dict) else {}
    for name, value in details.items():
        assert error.details[name] == value, f"details: {error.details}"
    if isinstance(error, ServoError):
        assert "  " not in text and "\n" not in text and text[-1] in ".!?", text


@contextmanager
def warned(*facts):
    """A RuntimeWarning with all of these facts in its text."""
    with pytest.warns(RuntimeWarning) as caught:
        yield caught
    texts = [str(warning.message) for warning in caught]
    assert any(all(fact in text for fact in facts) for text in texts), texts
