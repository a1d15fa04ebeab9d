"""Properties of any expression, drawn by hypothesis."""

import casadi as ca
import mpmath
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import servoctl as sv

UNARY = {"sin": mpmath.sin, "cos": mpmath.cos, "tanh": mpmath.tanh, "atan": mpmath.atan, "exp": mpmath.exp}

expressions = st.recursive(
    st.one_of(st.just("t"), st.integers(-2, 2).filter(bool)),
    lambda smaller: st.one_of(
        st.tuples(st.sampled_from(sorted(UNARY)), smaller),
        st.tuples(st.sampled_from("+*/"), smaller, smaller),
    ),
    max_leaves=6,
)


def built(tree, t, unary):
    """The tree as an expression of t; exponents and denominators are kept small and away from zero."""
    if tree == "t":
        return t
    if isinstance(tree, int):
        return tree * t**0
    name, *parts = tree
    parts = [built(part, t, unary) for part in parts]
    if name in UNARY:
        return unary[name](parts[0] if name != "exp" else unary["sin"](parts[0]))
    left, right = parts
    return {"+": lambda: left + right, "*": lambda: left * right, "/": lambda: left / (2 + unary["cos"](right))}[name]()


@settings(max_examples=60, deadline=None, derandomize=True, database=None)
@given(tree=expressions, order=st.integers(1, 5), instant=st.integers(-8, 8))
def test_total_derivatives_of_any_expression_are_those_of_extended_precision(tree, order, instant):
    q, at = sv.coordinates("x"), instant / 8
    found = ca.Function("f", [q.t], [q.dt(built(tree, q.t, {name: getattr(ca, name) for name in UNARY}), order)])
    with mpmath.workdps(60):
        exact = mpmath.diff(lambda t: built(tree, t, UNARY), mpmath.mpf(at), order)
        size = mpmath.factorial(order) * (1 + abs(exact))
    assert float(found(at)) == pytest.approx(float(exact), abs=1e-12 * float(size))
