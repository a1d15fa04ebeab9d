"""A limit on work that is the same on every machine: calls and returns of functions, not seconds."""

import sys
from contextlib import contextmanager


class TooMuchWork(BaseException):
    """Raised in what makes more calls than it may; no `except Exception` catches it."""


@contextmanager
def at_most(calls):
    """End what calls and returns more often, with TooMuchWork."""
    left = calls

    def count(*_):
        nonlocal left
        left -= 1
        if left < 0:
            raise TooMuchWork

    before = sys.getprofile()
    sys.setprofile(count)
    try:
        yield
    finally:
        sys.setprofile(before)
