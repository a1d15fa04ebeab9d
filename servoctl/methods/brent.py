"""Brent's methods for one unknown, step for step as scipy's, whose import takes longer than most motions.

Source: R. P. Brent, Algorithms for Minimization Without Derivatives, 1973, chapters 4 and 5.
"""

from math import copysign, sqrt

LAST_PLACES = 8.9e-16  # of a root: least relative tolerance that rounding allows
MOST_TRIED = 500  # evaluations
GOLDEN, SQRT_EPS = 0.5 * (3.0 - sqrt(5.0)), sqrt(2.2e-16)


def root(f, a, b, xtol):
    """The root of f between a and b, where its values have opposite signs, to xtol + LAST_PLACES |root|."""
    before, f_before, x, fx = a, f(a), b, f(b)
    other, f_other, last = before, f_before, x - before
    step = last
    if f_before == 0 or fx == 0:
        return before if f_before == 0 else x
    for _ in range(MOST_TRIED):
        if f_before != 0 and fx != 0 and (f_before > 0) != (fx > 0):
            other, f_other, last = before, f_before, x - before
            step = last
        if abs(f_other) < abs(fx):
            before, x, other = x, other, x
            f_before, fx, f_other = fx, f_other, fx
        least, half = (xtol + LAST_PLACES * abs(x)) / 2, (other - x) / 2
        if fx == 0 or abs(half) < least:
            break
        trial = _interpolated((before, f_before), (x, fx), (other, f_other)) if abs(fx) < abs(f_before) else None
        if trial is not None and abs(last) > least and 2 * abs(trial) < min(abs(last), 3 * abs(half) - least):
            last, step = step, trial
        else:
            last = step = half
        before, f_before = x, fx
        x += step if abs(step) > least else copysign(least, half)
        fx = f(x)
    return x


def _interpolated(before, here, other):
    """The step to the root of a line or an inverse parabola through points (x, f)."""
    (a, fa), (x, fx), (b, fb) = before, here, other
    if a == b:
        return -fx * (x - a) / (fx - fa)
    da, db = (fa - fx) / (a - x), (fb - fx) / (b - x)
    divisor = db * da * (fb - fa)
    return -fx * (fb * db - fa * da) / divisor if divisor else None


def least(f, a, b, xtol):
    """Where f is least between a and b, and its value there."""
    a, b = min(a, b), max(a, b)
    x = second = third = a + GOLDEN * (b - a)
    fx = f_second = f_third = f(x)
    last = step = 0.0
    for _ in range(MOST_TRIED):
        middle, near = (a + b) / 2, SQRT_EPS * abs(x) + xtol / 3
        if not abs(x - middle) > 2 * near - (b - a) / 2:
            break
        trial = _vertex((x, fx), (second, f_second), (third, f_third)) if abs(last) > near else None
        if trial is not None and abs(trial) < abs(last) / 2 and a < x + trial < b:
            last, step = step, trial
            if x + step - a < 2 * near or b - x - step < 2 * near:
                step = copysign(near, middle - x)
        else:
            last = a - x if x >= middle else b - x
            step = GOLDEN * last
        new = x + copysign(max(abs(step), near), step)
        f_new = f(new)
        if f_new <= fx:
            a, b = (x, b) if new >= x else (a, x)
            (third, f_third), (second, f_second), (x, fx) = (second, f_second), (x, fx), (new, f_new)
        else:
            a, b = (new, b) if new < x else (a, new)
            if f_new <= f_second or second == x:
                (third, f_third), (second, f_second) = (second, f_second), (new, f_new)
            elif f_new <= f_third or third in (x, second):
                third, f_third = new, f_new
    return x, fx


def _vertex(here, second, third):
    """The step to the vertex of the parabola through points (x, f); None if they lie on a line."""
    (x, fx), (v, fv), (w, fw) = here, second, third
    r, q = (x - v) * (fx - fw), (x - w) * (fx - fv)
    p, q = (x - w) * q - (x - v) * r, 2 * (q - r)
    return -p / q if q else None
