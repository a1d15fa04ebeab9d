"""Whether an expression vanishes identically: for all values of its symbols and on every branch.

Values at points cannot tell. fmax(0, t - 4) is zero before 4 s, exp(-100 (t - 50)²) far from 50 s, and
1 + tanh(40 (x - 3)) rounds to zero below x = 2. So functions with branches, flat ends or a bounded domain give way to
a substitute without them, the same for equal arguments: what vanishes with the substitute vanishes whatever these
functions are. Sines, cosines, roots and powers, whose identities mechanics needs, are evaluated as they are, roots on
either branch.
"""

import casadi as ca
import numpy as np

from servoctl.jets.tape import REAL, VALUE, Tape, apply, evaluate
from servoctl.tolerances import ENTRY

SCALES = (0.3, 1.0, 0.3, 0.3, 3.0, 3.0, 30.0, 30.0, 1e6, 1e6)  # of the symbols at each point
RANGE = (0.5, 1.5)  # of the symbols relative to the scale, away from zero and from each other
POSITIVE = 2  # points, the first ones, where all symbols are positive; each pair of others has opposite random signs
IN_DOMAIN = 2  # points that must be finite before an expression is called zero
IDENTITY_POINTS_SEED = 1788
LARGEST = 1e100  # sizes above it are no values: their products would leave the range of doubles
TRUE = ("sin", "cos", "tan")  # functions evaluated as they are


def _substitute(name, *args):
    """A function without zeros, flat ends or identities, another one for each name."""
    letters = np.frombuffer(name.encode(), dtype=np.uint8).astype(float)
    frequency = 0.6 + np.sqrt(letters @ np.arange(1, 1 + len(letters))) % 1.0
    phase = sum((frequency * a / (1 + i * np.sqrt(2.0)) for i, a in enumerate(args)), np.sqrt(3.0))
    return 2.0 + np.cos(phase)


def _power(exponent, a):
    """A power, for odd multiples of 1/2 on either branch of the root: x + √(x²) does not vanish."""
    branch = np.sign(_substitute("sqrt", a) - 2.0) if 2 * exponent % 2 == 1 else 1.0
    return branch * a**exponent


OPERATIONS = VALUE | {
    "sqrt": lambda _, a: _power(0.5, a),
    "power": _power,
    "quad": lambda name, *args: (apply if name in TRUE else _substitute)(name, *args),
    "constant": lambda name, *args: _substitute(str(name), *args),
    "fabs": lambda _, a: _substitute("fabs", a),
    "fmin": lambda _, a, b: _substitute("fmin", a, b),
    "fmax": lambda _, a, b: _substitute("fmax", a, b),
    "gate": lambda _, a, b: _substitute("gate", a) * b,
}


def spread(expressions):
    """Values of SX scalars at random points of all their symbols, with functions substituted; rounding is zero.

    An array (len(expressions), points), NaN where a root or a quotient has no value, or sizes exceed `LARGEST`.
    """
    tape, rng = Tape(None, expressions), np.random.default_rng(IDENTITY_POINTS_SEED)
    shape = len(tape.symbols), len(SCALES)
    signs = np.repeat(rng.choice([-1.0, 1.0], (shape[0], shape[1] // 2)), 2, axis=1)
    signs[:, 1::2] *= -1.0
    signs[:, :POSITIVE] = 1.0
    inputs = (signs * rng.uniform(*RANGE, shape) * SCALES).astype(REAL)
    values, sizes = evaluate(tape, inputs, OPERATIONS)
    values[~((sizes < LARGEST) & (np.abs(values) < LARGEST))] = np.nan
    return np.where(np.abs(values) <= ENTRY * sizes, 0.0, values).astype(float)


def identical_zeros(expressions):
    """Which of some SX scalars vanish identically: so do their slopes, which show what is too small to be seen.

    A small number before a function that is replaced, as e^-90 before e^30x, is lost beside 1, but is a factor of the
    slope.
    """
    zeros = vanish(spread(expressions)) if expressions else np.zeros(0, dtype=bool)
    for i in np.flatnonzero(zeros):
        slopes = ca.gradient(expressions[i], ca.vertcat(*ca.symvar(expressions[i]))).nonzeros()
        zeros[i] = not slopes or vanish(spread(slopes)).all()
    return zeros


def vanish(values):
    """Whether expressions vanish identically at points, from values at points (..., points) as those of `spread`."""
    finite = np.isfinite(values)
    return (finite.sum(axis=-1) >= IN_DOMAIN) & ~np.any(finite & (values != 0), axis=-1)
