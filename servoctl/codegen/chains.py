"""Short chains of dependent operations, for loops in which each evaluation waits for the one before.

A stage of a closed loop needs the velocities of the stage before, so that a step takes as long as its longest chain of
operations. Factors of a product and terms of a sum are combined in the order in which they become known, as in
D. A. Huffman's codes (1952); a quotient is a product with a reciprocal, which need not wait for the numerator; and
a cos²s + a sin²s is a. The results are those of the given order but for rounding.
"""

import heapq
import itertools
import math
from collections import Counter, defaultdict
from typing import NamedTuple

import casadi as ca

CYCLES = defaultdict(
    lambda: 40,
    {  # of today's processors, from the last operand to the value
        ca.OP_ADD: 4,
        ca.OP_SUB: 4,
        ca.OP_MUL: 4,
        ca.OP_NEG: 1,
        ca.OP_INV: 14,
    },
)
AHEAD = 60  # cycles: about one stage, by which coordinates are known before velocities, which are their rates
FACTORS = 8  # of one product, at most
WAITING = 0.3  # operations in a cycle of the longest chain: the processor works ahead, but not all the time
RECIPROCAL = 2  # operations that take as long as the unit for divisions is occupied

_FACTORS_OF = {ca.OP_SQ: lambda a: (a, a), ca.OP_TWICE: lambda a: (Constant(2.0), a), ca.OP_MUL: lambda a, b: (a, b)}
_SIGNS = {ca.OP_ADD: (1.0, 1.0), ca.OP_SUB: (1.0, -1.0), ca.OP_NEG: (-1.0,)}
_CIRCULAR = {ca.OP_SIN, ca.OP_COS}


class Constant(NamedTuple):
    """An operand that is a number."""

    value: float


def operand_values(operands):
    """The values among operands."""
    return [v for v in operands if isinstance(v, int)]


def short_chains(statements):
    """Statements of a function x' = f(t, x, p) whose results follow soon after the entries of x that are known last.

    Statements (target, operation, operands) are in single assignment; operands are numbered values, constants, or C
    text of inputs. The outputs are the same, to rounding.
    """
    chains = _Chains(statements)
    for statement in statements:
        chains.take(*statement)
    return _needed(chains.statements)


def _needed(statements):
    """The statements that outputs need."""
    read, result = set(), []
    for target, operation, operands in reversed(statements):
        if isinstance(target, str) or target in read:
            read.update(operand_values(operands))
            result.append((target, operation, operands))
    return result[::-1]


def time_of(statements):
    """The time of statements, in operations: their number, and a share of the cycles that the last rate waits for."""
    known, late = {}, _late(statements)
    for target, operation, operands in statements:
        begun = max((known[v] if isinstance(v, int) else _known_at(v, late) for v in operands), default=0)
        known[target] = begun + (CYCLES[operation] if isinstance(target, int) else 0)
    operations = [operation for target, operation, _ in statements if isinstance(target, int)]
    return len(operations) + (RECIPROCAL - 1) * operations.count(ca.OP_INV) + WAITING * max(known.values(), default=0)


def _late(statements):
    """The entries of x whose rates are computed."""
    rates = (target for target, _, operands in statements if isinstance(target, str) and operand_values(operands))
    return {"x" + target[1:] for target in rates}


def _known_at(operand, late):
    """The time [cycles] at which an input or a constant is known."""
    return 0 if operand in late else -AHEAD


class _Chains:
    """The statements written so far.

    `known` [cycles] is the time of each value, `place` the operand that replaces a given value; `factors` and `terms`
    (±2^k, operand) are those of values that are products, and of sums that are read once; `circular` the operation and
    the angle of sines and cosines.
    """

    def __init__(self, statements):
        self.statements, self.written, self.known, self.place = [], {}, {}, {}
        self.factors, self.terms, self.circular, self.read_once = {}, {}, {}, set()
        self.reads = Counter(v for _, _, operands in statements for v in operand_values(operands))
        self.late = _late(statements)

    def at(self, v):
        """The time at which an operand is known."""
        return self.known[v] if isinstance(v, int) else _known_at(v, self.late)

    def take(self, target, operation, operands):
        """Write what replaces a given statement."""
        operands = tuple(self.place.get(v, v) for v in operands)
        if isinstance(target, str):
            self.statements.append((target, operation, operands))
            return
        if operation == ca.OP_DIV:
            operation, operands = ca.OP_MUL, (operands[0], self.write(ca.OP_INV, operands[1:]))
        if operation in _FACTORS_OF:
            value = self.product(self.joined_factors(_FACTORS_OF[operation](*operands)))
        elif operation in _SIGNS:
            terms = self.joined_terms(_SIGNS[operation], operands)
            value = self.sum(terms)
            if self.reads[target] == 1:
                self.terms[value] = terms
        else:
            value = self.write(operation, operands)
        self.place[target] = value
        if self.reads[target] == 1:
            self.read_once.add(value)

    def write(self, operation, operands):
        """The value of an operation, which is written once."""
        key = operation, frozenset(Counter(operands).items()) if operation == ca.OP_MUL else tuple(operands)
        if key not in self.written:
            value = self.written[key] = len(self.written)
            self.statements.append((value, operation, tuple(operands)))
            self.known[value] = max(map(self.at, operands)) + CYCLES[operation]
            if operation in _CIRCULAR:
                self.circular[value] = operation, operands[0]
        return self.written[key]

    def joined_factors(self, operands):
        """The factors of a product, with at most one constant, which comes first."""
        given = [self.factors.get(v, (v,)) for v in operands]
        factors = [*itertools.chain(*given)] if sum(map(len, given)) <= FACTORS else operands
        number = math.prod(v.value for v in factors if isinstance(v, Constant))
        others = tuple(v for v in factors if not isinstance(v, Constant))
        return others if number == 1 and others else (Constant(number), *others)

    def product(self, factors):
        """The product of factors; those that are known first are multiplied first."""
        heap = [(self.at(v), i, v) for i, v in enumerate(factors)]
        heapq.heapify(heap)
        while len(heap) > 1:
            (_, i, a), (_, _, b) = heapq.heappop(heap), heapq.heappop(heap)
            value = self.write(ca.OP_MUL, (a, b))
            heapq.heappush(heap, (self.at(value), i, value))
        value = heap[0][-1]
        if isinstance(value, int) and len(factors) > 1:
            self.factors[value] = tuple(factors)
        return value

    def joined_terms(self, signs, operands):
        """The terms (±2^k, operand) of a sum, with those of sums that only this one reads."""
        terms = []
        for sign, v in zip(signs, operands, strict=True):
            number, *rest = self.factors.get(v, (None, v))
            if rest and isinstance(number, Constant) and abs(math.frexp(number.value)[0]) == 0.5:
                sign, v = sign * number.value, self.product(rest)
            terms += [(sign * c, w) for c, w in self.terms.get(v, ((1.0, v),))]
        return self.without_circles(terms)

    def without_circles(self, terms):
        """Terms of a sum, with c a for c a cos²s + c a sin²s."""
        for (i, (c, v)), (j, (d, w)) in itertools.combinations(enumerate(terms), 2):
            a, b = (Counter(self.factors.get(u, (u,))) for u in (v, w))
            apart = [*(a - b).items(), *(b - a).items()]
            if c == d and [n for _, n in apart] == [2, 2] and self.of_one_angle(*(u for u, _ in apart)):
                value = self.product(tuple((a & b).elements()) or (Constant(1.0),))
                return self.without_circles([*terms[:i], *terms[i + 1 : j], *terms[j + 1 :], (c, value)])
        return terms

    def of_one_angle(self, v, w):
        """Whether two operands are the sine and the cosine of one angle."""
        (f, a), (g, b) = (self.circular.get(u, (None, u)) for u in (v, w))
        return {f, g} == _CIRCULAR and a == b

    def sum(self, terms):
        """The sum of terms; those that are known first are added first."""
        heap = [(*self.term(abs(c), v), math.copysign(1.0, c), i) for i, (c, v) in enumerate(terms)]
        heap = [(time, i, sign, v) for time, v, sign, i in heap]
        heapq.heapify(heap)
        while len(heap) > 1:
            (_, i, *first), (_, _, *second) = heapq.heappop(heap), heapq.heappop(heap)
            (c, a), (d, b) = (second, first) if first[0] < second[0] else (first, second)
            value = self.write(ca.OP_ADD if c == d else ca.OP_SUB, (a, b))
            heapq.heappush(heap, (self.at(value), i, c, value))
        *_, sign, value = heap[0]
        return value if sign > 0 else self.write(ca.OP_NEG, (value,))

    def term(self, scale, v):
        """When a term can be added, and its value; a product that only a sum reads is fused with the addition."""
        value = v if scale == 1 else self.product(self.joined_factors((Constant(scale), v)))
        fused = v in self.factors and (v in self.read_once or scale != 1)
        return self.at(value) - (CYCLES[ca.OP_MUL] if fused else 0), value
