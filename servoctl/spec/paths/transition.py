"""The old spelling of paths, an expression of a time as the first argument, beside the new one, until it goes."""

import functools
import inspect
from typing import Any

import casadi as ca


def or_expression(old) -> Any:
    """The decorator of a maker of paths whose name also makes an expression by `old`.

    The old one is meant where a CasADi expression comes first, or where the arguments are not those of the new one: it
    has one positional argument more, or `t`.
    """

    def decorator(new):
        @functools.wraps(new)
        def either(*args, **kwargs):
            timed = args and isinstance(args[0], ca.SX) and _binds(old, args, kwargs)
            return (new if _binds(new, args, kwargs) and not timed else old)(*args, **kwargs)

        return either

    return decorator


def _binds(f, args, kwargs):
    try:
        inspect.signature(f).bind(*args, **kwargs)
    except TypeError:
        return False
    return True
