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
            try:
                inspect.signature(new).bind(*args, **kwargs)
                fits = not isinstance(args[0] if args else None, ca.SX)
            except TypeError:
                fits = False
            return (new if fits else old)(*args, **kwargs)

        return either

    return decorator
