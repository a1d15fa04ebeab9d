"""The lists of the tiers name what exists."""

import re
from pathlib import Path

import pytest
from conftest import BY_HAND, LEFT, tier_of

TESTS = Path(__file__).parent


def exists(name):
    """Whether a name is that of a file, or of a function of one."""
    file, _, function = name.partition("::")
    path = TESTS / file
    return path.exists() and bool(re.search(rf"^def {function}\(", path.read_text(encoding="utf-8"), re.M) if function else True)


def test_the_lists_name_files_and_functions_that_exist():
    assert [name for name in sorted(LEFT | BY_HAND) if not exists(name)] == []
    assert exists("test_tiers.py::exists") and not exists("test_tiers.py::gone") and not exists("test_gone.py")


@pytest.mark.parametrize("name", ["test_tiers.py::exists", "test_new.py::test_new"])
def test_a_new_test_is_in_the_first_tier_and_its_further_cases_in_the_second(name):
    assert (tier_of(name, True), tier_of(name, False)) == ("first", "second")


def test_what_the_lists_name_is_in_the_other_tiers():
    assert {tier_of(name, True) for name in LEFT} <= {"second", "third"}
    assert {tier_of(name, False) for name in BY_HAND} <= {"third"}
