"""Random mechanisms and programs, as text: both the package and the reference read the same formulas.

A case is drawn through `pick(low, high)`, a source of whole numbers: a seeded generator (`seeded`) or hypothesis
(`cases`), which shrinks it. Coefficients are decimals of order one, as a designer writes them.

Formulas name t, q0, q1, ... (coordinates), w0, w1, ... (quasi-velocities), w0_1, w0_2, ... (their derivatives), and
D(f), the total derivative.

The same case in other coordinates (`moved`) has other origins, zeros of angles, units, signs and names.
"""

import json
import re
from dataclasses import asdict, dataclass, field, replace

import numpy as np

ZEROS = (0.0, 1.0, -1.0, 10.0, -10.0, 100.0, -100.0, 0.3, np.pi / 2, np.pi, 6.0)
SCALES = (1.0, -1.0, 1e3, 1e-3)


@dataclass(frozen=True)
class Case:
    """A mechanism and a program, formulas as text.

    `rows` is what the package is given, `plain` an equivalent program whose leading matrix has full rank at general
    points: an ideal reaction acts along its rows.
    """

    n: int
    masses: tuple = ()
    positions: tuple = ()
    form: str = "gibbs"  # or "kinetic", "balance"
    potential: str = "0"
    forces: tuple = ()
    V: tuple = ()  # (n, n) by rows; empty: unity
    h: tuple = ()
    material: tuple = ()
    actuators: tuple = ()  # a text is a displacement, a tuple of n texts a direction
    rows: tuple = ()
    plain: tuple = ()
    by: str = "ideal"
    guess: tuple = ()  # of the coordinates at the start
    speeds: tuple = ()
    kinds: tuple = field(default=(), compare=False)  # words for the table of counts
    moves: tuple = ()  # (zero, scale, place): a coordinate as drawn is scale * q_place + zero; empty: as drawn

    @property
    def scales(self):
        """Changes of the coordinates and of the quasi-velocities as drawn with those of the case, (2, n)."""
        scales = np.ones((2, self.n))
        for _, scale, place in self.moves:
            scales[: 1 if self.V else 2, place] = scale
        return scales

    @property
    def sizes(self):
        """What is of order one in coordinates as drawn, of coordinates and quasi-velocities, (2, n)."""
        return 1 / np.abs(self.scales)

    def as_drawn(self, jets):
        """Jets q, w, w', ... (n k, ...) of the case in the coordinates in which it was drawn."""
        blocks = np.array(jets).reshape(-1, self.n, *np.shape(jets)[1:])
        zeros, scales = np.zeros_like(blocks[0]), self.scales.reshape(2, self.n, *[1] * (blocks.ndim - 2))
        order = [place for _, _, place in self.moves] or range(self.n)
        for zero, _, place in self.moves:
            zeros[place] = zero
        blocks = np.concatenate([blocks[:1] * scales[0] + zeros, blocks[1:] * scales[1]])
        return blocks[:, order].reshape(np.shape(jets))

    def forces_as_drawn(self, forces):
        """Actuation as it is, the whole reaction (n, ...) of an ideal program by the velocities as drawn."""
        if self.by != "ideal":
            return forces
        order = [place for _, _, place in self.moves] or range(self.n)
        return (forces.T / self.scales[1]).T[order]

    def as_text(self):
        return json.dumps(asdict(self), indent=1)


def from_text(text):
    """The case that `as_text` wrote."""
    tuples = lambda value: tuple(map(tuples, value)) if isinstance(value, list) else value  # noqa: E731
    return Case(**{key: tuples(value) for key, value in json.loads(text).items()})


def seeded(seed, other=False):
    """The case of a seed, or it in other coordinates."""
    rng = np.random.default_rng(seed)
    pick = lambda low, high: int(rng.integers(low, high + 1))  # noqa: E731
    case = draw(pick)
    return moved(case, _moves(pick, case.n)) if other else case


def _moves(pick, n):
    """Zeros, scales and places of n coordinates."""
    left = list(range(n))
    return tuple((ZEROS[pick(0, 10)], SCALES[pick(0, 3)], left.pop(pick(0, len(left) - 1))) for _ in range(n))


def moved(case, moves):
    """A case in coordinates of which those of the case are scale * q_place + zero.

    Its velocities are those of its coordinates, but for quasi-velocities, which only change their names. Generalised
    forces and directions are by velocities, displacements remain what they are.
    """
    rates = [1.0 if case.V else scale for _, scale, _ in moves]

    def name(match):
        letter, i, level = match[1], int(match[2]), match[3] or ""
        zero, scale, place = moves[i]
        new, scale = f"{letter}{place}{level}", scale if letter == "q" else rates[i]
        new = new if scale == 1 else f"({scale!r}*{new})"
        return f"({new} + {zero!r})" if letter == "q" and zero else new

    def there(texts):
        return re.sub(r"\b([qw])(\d+)(_\d+)?\b", name, texts) if isinstance(texts, str) else tuple(map(there, texts))

    def placed(values):
        return tuple(value for _, value in sorted(zip((place for *_, place in moves), values, strict=False)))

    def times(factors, texts):
        return placed([f"{f!r}*({text})" if f != 1 else text for f, text in zip(factors, there(texts), strict=False)])

    slower = [1 / scale for _, scale, _ in moves]
    return replace(
        case,
        positions=there(case.positions),
        potential=there(case.potential),
        forces=times(rates, case.forces),
        V=placed([times([f] * case.n, row) for f, row in zip(slower, case.V, strict=False)]),
        h=times(slower, case.h),
        material=there(case.material),
        actuators=tuple(times(rates, a) if isinstance(a, tuple) else there(a) for a in case.actuators),
        rows=there(case.rows),
        plain=there(case.plain),
        guess=placed([(value - zero) / scale for value, (zero, scale, _) in zip(case.guess, moves, strict=True)]),
        speeds=placed([value / rate for value, rate in zip(case.speeds, rates, strict=True)]),
        moves=moves,
    )


def cases(known=True):
    """A hypothesis strategy of cases (see `draw`); shorter programs and smaller coefficients are simpler."""
    from hypothesis import strategies as st

    @st.composite
    def strategy(data):
        return draw(lambda low, high: data(st.integers(low, high)), known)

    return strategy()


def draw(pick, known=True):
    """A case from a source of whole numbers; not `known`: several rows by actuators have orders up to 2 alone."""
    n = pick(2, 5)
    ideal = pick(0, 1)
    frame = pick(0, 2) == 2
    case = Case(n, by="ideal" if ideal else "actuators", **_inertia(pick, n), **(_frame(pick, n) if frame else {}))
    case = replace(case, potential=_potential(pick, n), forces=_forces(pick, n))
    material = _material(pick, n) if n > 2 and pick(0, 2) == 2 else ()
    free = n - len(material)
    k = pick(1, max(1, min(3, free - 1))) if pick(0, 4) else min(free, 3)
    rows, plain, kinds = _program(pick, n, k, ideal, known)
    case = replace(case, material=material, rows=rows, plain=plain)
    if not ideal:
        actuators, words = _actuators(pick, n, k)
        case, kinds = replace(case, actuators=actuators), kinds + words
    guess, speeds = (tuple(_decimal(pick, 6) for _ in range(n)) for _ in range(2))
    kinds += ("quasi-velocities",) * frame + ("material",) * bool(material) + (case.form, case.by)
    return replace(case, guess=guess, speeds=speeds, kinds=kinds)


def _decimal(pick, most=9):
    """A decimal in tenths, never zero."""
    value = pick(1, most) / 10
    return -value if pick(0, 1) else value


def _variable(pick, n, letter="q"):
    return f"{letter}{pick(0, n - 1)}"


def _term(pick, n):
    """A smooth function of the coordinates, of order one."""
    a, b = _variable(pick, n), _variable(pick, n)
    kind = pick(0, 4)
    shape = (a, f"sin({a} + {b})", f"cos({a} - 0.3)", f"{a}*{b}", f"exp(0.3*{a})")[kind]
    return f"{_decimal(pick, 6)}*{shape}"


def _wave(pick):
    kind = pick(0, 2)
    return f"{_decimal(pick, 6)}*" + ("t", f"sin({pick(5, 20) / 10}*t)", f"cos({pick(5, 20) / 10}*t)")[kind]


def _inertia(pick, n):
    """Scalar particles: one for each coordinate, which makes the inertia regular, and one that couples."""
    positions = []
    for i in range(n):
        terms = [f"q{i}"]
        if i and pick(0, 1):
            terms.append(_term(pick, i))
        if pick(0, 5) == 5:
            terms.append(_wave(pick))
        positions.append(" + ".join(terms))
    positions.append(" + ".join(f"{_decimal(pick, 6)}*{f}" for f in ("q0", f"sin(q{n - 1})", f"q{n // 2}")))
    form = ("gibbs", "kinetic", "balance")[pick(0, 2)]
    return {"masses": tuple(pick(5, 20) / 10 for _ in positions), "positions": tuple(positions), "form": form}


def _frame(pick, n):
    """Quasi-velocities: V is triangular with a diagonal that stays away from zero, h may depend on t."""
    V = [["0"] * n for _ in range(n)]
    for i in range(n):
        V[i][i] = "1" if pick(0, 1) else f"(1 + 0.3*cos({_variable(pick, n)}))"
        if i and pick(0, 1):
            V[i][pick(0, i - 1)] = f"{_decimal(pick, 5)}*sin({_variable(pick, n)})"
    h = tuple((f"{_decimal(pick, 4)}*q{i}", _wave(pick))[pick(0, 1)] if pick(0, 2) == 2 else "0" for i in range(n))
    return {"V": tuple(map(tuple, V)), "h": h}


def _potential(pick, n):
    springs = [f"{pick(1, 20) / 10}*({_variable(pick, n)} - {_decimal(pick)}*{_variable(pick, n)})**2" for _ in range(2)]
    return " + ".join([*springs, f"{_decimal(pick)}*cos({_variable(pick, n)})"])


def _forces(pick, n):
    return tuple(f"-{pick(1, 9) / 10}*w{i}" if pick(0, 2) == 2 else "0" for i in range(n))


def _material(pick, n):
    """One constraint of nature on the last coordinate: a guide, a moving guide, or rolling."""
    kind, last = pick(0, 2), n - 1
    if kind < 2:
        return (f"q{last} - {_decimal(pick)}*sin({_variable(pick, last)})" + (f" - {_wave(pick)}" if kind else ""),)
    return (f"w{last} - {_decimal(pick)}*sin({_variable(pick, n)} + 0.4)*{_variable(pick, last, 'w')}",)


def _jet(i, order):
    """The derivative of γ_i of an order: q for order 0."""
    return f"q{i}" if order == 0 else f"w{i}" if order == 1 else f"w{i}_{order - 1}"


def _program(pick, n, k, ideal, known):
    """k residuals: each led by its own coordinate; some hold combinations that hide rows or are nearly dependent."""
    kinds, rows, plain, orders = [], [], [], []
    for a in range(k):
        lowly = not (known or ideal or k == 1)  # actuators may hide any row
        order = (0, 0, 0, 1, 1, 2, 2, 3, 4)[pick(0, 6 if lowly else 8)]
        twist = pick(0, 9) if a else 0
        if twist == 9:  # the top of the row before, and a row of lower order that it hides
            order = pick(0, orders[-1])
            core = _row(pick, n, a, order)
            factor = _decimal(pick)
            rows.append(f"{factor}*D({plain[-1]}) + {core}")
            kinds.append("hidden program row")
        elif twist == 8:
            order = orders[-1]
            small, factor, core = pick(1, 5), _decimal(pick), _row(pick, n, a, order)
            rows.append(f"{factor}*({plain[-1]}) + 1e-{small}*({core})")
            kinds.append("nearly dependent")
        elif twist == 7 and pick(0, 3) == 3:
            order, core = orders[-1], f"{_decimal(pick)}*({plain[-1]})"
            rows.append(core)
            kinds.append("dependent")
        else:
            core = _row(pick, n, a, order)
            rows.append(core)
        plain.append(core)
        orders.append(order)
        kinds.append(f"order {order}")
    return tuple(rows), tuple(plain), tuple(kinds)


def _row(pick, n, lead, order):
    """A residual of an order, led by the coordinate `lead`."""
    other = pick(0, n - 1)
    terms = [_jet(lead, order)]
    if order == 1 and pick(0, 5) == 5:
        terms = [f"{_jet(lead, 1)}*{_jet(lead, 1)} + 0.5*{_jet(other, 1)}*{_jet(other, 1)} - 1.5"]
    elif other != lead and pick(0, 1):
        factor = _decimal(pick, 6) if order == 0 or pick(0, 1) else f"{_decimal(pick, 6)}*sin({_variable(pick, n)})"
        terms.append(f"{factor}*{_jet(other, order)}")
    elif order == 0 and pick(0, 1):
        terms.append(f"{_decimal(pick, 4)}*sin({_variable(pick, n)})")
    if order:
        low = pick(0, order - 1)
        terms.append(f"{_decimal(pick)}*{_jet(pick(0, n - 1), low)}")
    terms.append(_wave(pick))
    return " + ".join(terms)


def _actuators(pick, n, k):
    """As many actuators as residuals; sometimes one more, seldom one less; seldom two of one direction."""
    count, words = k, ()
    chance = pick(0, 11)
    if chance in (10, 11) and k < n:
        count, words = k + 1, ("redundant actuation",)
    elif chance == 9:
        count, words = k - 1, ("too few actuators",)
    start = pick(0, n - 1) if pick(0, 1) else 0
    made = []
    for a in range(count):
        i, kind = (start + a) % n, pick(0, 3)
        if kind < 2:
            made.append(f"q{i}")
        elif kind == 2:
            made.append(f"q{i} + {_decimal(pick, 6)}*sin({_variable(pick, n)})")
        else:
            column = ["0"] * n
            column[(i + 1) % n] = f"{_decimal(pick, 6)}*cos({_variable(pick, n)})"
            column[i] = "1"
            made.append(tuple(column))
    if count > 1 and pick(0, 19) == 19:
        made[-1], words = made[0], (*words, "dependent actuators")
    return tuple(made), words
