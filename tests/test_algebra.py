"""Expressions that are zero by algebra: proved with exact coefficients, and nothing else is called proved."""

import casadi as ca
import numpy as np
import pytest

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.jets import algebra
from servoctl.jets.algebra import cancels

a, b, c, t = (ca.SX.sym(name) for name in "abct")
S, C = ca.sin(a), ca.cos(a)

ZERO = {
    "nothing": ca.SX(0),
    "a symbol": (a + b) - b - a,
    "squares": (a + b) ** 2 - a * a - 2 * a * b - b**2,
    "circle": S**2 + C**2 - 1,
    "its square": (S**2 + C**2) ** 2 * b - b,
    "sines of equal sums": ca.sin(a + b) * c - c * ca.sin(b + a),
    "quotient": a / b * b - a,
    "reciprocal of a sum": a / (b + c) - a * (1 / (c + b)),
    "root": ca.sqrt(a * a + b) ** 2 - a**2 - b,
    "powers": a**3 - a * a**2 + ca.power(b, c) - ca.power(b, c),
    "branches": ca.fmax(0, t - 4) * a - a * ca.fmax(0, t - 4),
    "crane": C * (0.5 * (b * (2 * (0.5 * c * (2 * S))))) - S * (0.5 * (b * (2 * (0.5 * c * (2 * C))))),
}
OPEN = {
    "small": 1e-200 * a,
    "a coefficient of rounding": a * 0.3 - a * 0.1 - a * 0.2,
    "other factor": S * b - C * b,
    "circle and a bit": S**2 + C**2 - 1 + 1e-18 * b,
    "circles of two angles": S**2 + ca.cos(b) ** 2 - 1,
    "blend that begins later": ca.fmax(0, t - 4) * a,
    "flat": a * (1 + ca.tanh(40 * (b - 3))),
    "root of a square": ca.sqrt(a * a) - a,
    "infinite": (a - b) * np.inf + b * np.inf,
    "division by zero": a / (b - b),
    "an identity it does not know": ca.sin(2 * a) - 2 * S * C,
}


@pytest.mark.parametrize("name", ZERO)
def test_what_cancels_is_proved(name):
    assert cancels(ZERO[name])


@pytest.mark.parametrize("name", OPEN)
def test_what_does_not_cancel_is_not(name):
    assert not cancels(OPEN[name])


@pytest.mark.parametrize("seed", range(20))
def test_random_products_and_their_expansions(seed):
    rng = np.random.default_rng(seed)
    factors = [sum(float(k) * s for k, s in zip(rng.integers(1, 9, 4), (a, S, C, 1 / b), strict=True)) for _ in "123"]
    left = (factors[0] * factors[1]) * factors[2] + factors[0] * t
    right = factors[0] * (factors[2] * factors[1] + t)
    assert cancels(left - right)
    assert not cancels(left - right * (1 + 2.0**-52))


def test_long_expansions_are_not_decided(monkeypatch):
    squares = sum((a + k * b) ** 2 for k in range(2, 40)) - sum((k * b + a) * (a + b * k) for k in range(2, 40))
    power = (a + b + c + S) ** 4 - (S + c + b + a) ** 3 * (a + b + c + S)
    assert cancels(power) and not cancels(squares)
    monkeypatch.setattr(algebra, "MOST_OPERATIONS", 1000)
    assert cancels(squares)
    monkeypatch.setattr(algebra, "MOST_PRODUCTS", 200)
    assert not cancels(power)


def test_a_thousand_squares_are_substituted():
    """Of which each had taken a call within that of the one before."""
    many = ca.sum1(ca.SX.sym("n", 11)) ** 2
    assert cancels((S * many) * (S * many) - many * many + (C * many) * (C * many))
    assert not cancels((S * many) * (S * many) - many * many + C * many)


@pytest.mark.parametrize("name", [name for name in gallery if name != "spatial-arm"])
def test_plants_of_the_gallery_watch_nothing(name):
    """So that their loops pay nothing."""
    mechanism, _ = gallery[name].build()
    assert sv.plant(mechanism).equations.dropped is None
