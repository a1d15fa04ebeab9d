"""Sums of products with like terms collected, for rates that a loop evaluates again and again.

An elimination leaves sums in whose products terms cancel, quotients with common factors, and a cos²s + b sin²s. Here
each value is a polynomial in atoms: inputs, reciprocals of atoms, values of functions, and sums that several read. A
sum in a product is multiplied out where hardly any terms are added; then common factors are taken out, as in W. G.
Horner's scheme. The results are those of the given order but for rounding.
"""

import functools
import itertools
import math
from collections import Counter

import casadi as ca

from servoctl.codegen.chains import Constant, operand_values

PAIRED = 8  # sums among a sum's factors: of more of them no two are multiplied out together, which takes longest
ADDED = (0, 1, 2)  # terms by which a sum may grow where another is multiplied out: the fastest result is taken
NOTHING = ((), 0.0)  # the term of a sum without terms
_DECIDING = {
    ca.OP_LT,
    ca.OP_LE,
    ca.OP_EQ,
    ca.OP_NE,
    ca.OP_NOT,
    ca.OP_AND,
    ca.OP_OR,
    ca.OP_SIGN,
    ca.OP_FMIN,
    ca.OP_FMAX,
    ca.OP_FLOOR,
    ca.OP_CEIL,
    ca.OP_FMOD,
    ca.OP_REMAINDER,
}
_SIGNS = {ca.OP_ADD: (1.0, 1.0), ca.OP_SUB: (1.0, -1.0), ca.OP_NEG: (-1.0,)}
_POWERS = {
    ca.OP_MUL: (1.0, (1, 1)),
    ca.OP_SQ: (1.0, (2,)),
    ca.OP_TWICE: (2.0, (1,)),
    ca.OP_DIV: (1.0, (1, -1)),
    ca.OP_INV: (1.0, (-1,)),
}


def ways(statements):
    """Ways to compute a function: the statements that are given, and such with like terms collected.

    Statements (target, operation, operands) are in single assignment; operands are numbered values, constants, or C
    text of inputs. All ways have the same outputs, to rounding.
    """
    return [statements, *(collected(statements, added) for added in ADDED)]


def collected(statements, added=0):
    """The statements with like terms collected, where a sum may grow by `added` terms; see `ways`."""
    return _Collected(statements, added).written()


def _deciding(statements):
    """The values on which comparisons and other operations with jumps or kinks depend."""
    result = set()
    for target, operation, operands in reversed(statements):
        if target in result or operation in _DECIDING or not isinstance(operation, int):
            result.update(operand_values(operands))
    return result


def _joined(monomial, other):
    """The product of two monomials, which are pairs (atom, power) in order."""
    powers = dict(monomial)
    for atom, power in other:
        powers[atom] = powers.get(atom, 0) + power
    return tuple(sorted((atom, power) for atom, power in powers.items() if power))


def _power(monomial, power):
    return tuple((atom, power * n) for atom, n in monomial)


def _content(terms):
    """The monomial that all terms have in common."""
    powers = [dict(monomial) for monomial in terms]
    atoms = dict.fromkeys(itertools.chain(*powers))
    ranges = {a: (min(p.get(a, 0) for p in powers), max(p.get(a, 0) for p in powers)) for a in atoms}
    return tuple(sorted((a, low if low > 0 else high) for a, (low, high) in ranges.items() if low > 0 or high < 0))


class _Collected:
    """The polynomials {monomial: coefficient} of all values.

    `atoms` are numbers of inputs, of functions by (operation, operands), and of sums by their terms; `meaning` has
    these keys by number, `sums` the polynomials of sums. What decides between branches keeps its operations, so that
    paths change at the same instants.
    """

    def __init__(self, statements, added):
        self.added, self.atoms, self.meaning, self.sums = added, {}, [], {}
        self.values, self.outputs, self.angles = {}, [], {}
        self.reads = Counter(v for _, _, operands in statements for v in operand_values(operands))
        self.deciding = _deciding(statements)
        for statement in statements:
            self.take(*statement)

    def take(self, target, operation, operands):
        """Note the polynomial of a value."""
        given = [self.polynomial(v) for v in operands]
        if isinstance(target, str):
            self.outputs.append((target, given[0]))
        elif target in self.deciding or operation not in _SIGNS.keys() | _POWERS.keys():
            self.values[target] = self.of_function(operation, tuple(map(self.term, given)))
        elif operation in _SIGNS:
            terms = Counter()
            for sign, polynomial in zip(_SIGNS[operation], given, strict=True):
                for monomial, c in polynomial.items():
                    terms[monomial] += sign * c
            shared = self.reads[target] > 1
            value = self.collect(terms)
            self.values[target] = dict([self.term(value)]) if shared else value
        else:
            scale, powers = _POWERS[operation]
            factors = [(m, c, n) for n, (m, c) in zip(powers, map(self.term, given), strict=True)]
            c = scale * math.prod(c**n if c or n > 0 else math.inf for _, c, n in factors)
            self.values[target] = {functools.reduce(_joined, (_power(m, n) for m, _, n in factors)): c}

    def of_function(self, operation, terms):
        """The polynomial of a function of terms (monomial, coefficient).

        What vanishes unless a condition holds has the number of what then holds, and each condition once.
        """
        scale = 1.0
        if operation == ca.OP_IF_ELSE_ZERO:
            condition, (monomial, scale) = terms
            if condition in self.conditions(monomial):
                return {monomial: scale}
            terms = condition, (monomial, 1.0)
        atom = self.atom((operation, terms))
        if operation in (ca.OP_SIN, ca.OP_COS):
            self.angles.setdefault(terms, {})[operation] = atom
        return {((atom, 1),): scale}

    def conditions(self, monomial):
        """The conditions without which an atom vanishes."""
        key = self.key_of(monomial)
        if not isinstance(key, tuple) or key[0] != ca.OP_IF_ELSE_ZERO:
            return []
        condition, (inner, _) = key[1]
        return [condition, *self.conditions(inner)]

    def key_of(self, monomial):
        """The meaning of a monomial that is one atom, to the first power; else None."""
        return self.meaning[monomial[0][0]] if len(monomial) == 1 and monomial[0][1] == 1 else None

    def atom(self, key):
        if key not in self.atoms:
            self.atoms[key] = len(self.meaning)
            self.meaning.append(key)
        return self.atoms[key]

    def polynomial(self, operand):
        """The polynomial of an operand."""
        if isinstance(operand, int):
            return self.values[operand]
        if isinstance(operand, Constant):
            return {(): operand.value} if operand.value else {}
        return {((self.atom(operand), 1),): 1.0}

    def term(self, polynomial):
        """(monomial, coefficient) of a polynomial, in which a sum is an atom."""
        if len(polynomial) < 2:
            return next(iter(polynomial.items()), NOTHING)
        common = _content(polynomial)
        apart = {_joined(m, _power(common, -1)): c for m, c in polynomial.items()}
        sizes = {abs(c) for c in apart.values()}
        first = math.copysign(sizes.pop() if len(sizes) == 1 else 1.0, next(iter(apart.values())))
        apart = {m: c / first for m, c in apart.items()}
        sum_ = self.atom(frozenset(apart.items()))
        self.sums.setdefault(sum_, apart)
        return _joined(common, ((sum_, 1),)), first

    def collect(self, terms):
        """A sum with like terms collected, in which sums are multiplied out where terms cancel."""
        terms = self.of_one_angle({m: c for m, c in terms.items() if c})
        while True:
            sums = sorted({a for m in terms for a, n in m if n == 1 and a in self.sums})
            groups = [(a,) for a in sums] + [*itertools.combinations(sums, 2)] * (len(sums) <= PAIRED)
            others = (self.multiplied(terms, group) for group in groups)
            best = min((other for other in others if other is not None), key=len, default=terms)
            if best is terms:
                return terms
            terms = best

    def multiplied(self, terms, sums):
        """Terms in which some sums are multiplied out; None if these are too many.

        A difference of inputs has all its digits, while products are rounded: of these, no more terms are made.
        """
        added = 0 if len(terms) < 2 or any(map(self.of_inputs, sums)) else self.added
        most, result = len(terms) + added, terms
        for atom in sums:
            given, result = result, Counter()
            for m, c in given.items():
                there = (atom, 1) in m
                rest = _joined(m, ((atom, -1),)) if there else m
                for n, d in self.sums[atom].items() if there else [((), 1.0)]:
                    result[_joined(rest, n)] += c * d
        result = self.of_one_angle({m: c for m, c in result.items() if c})
        return result if len(result) <= most else None

    def of_inputs(self, atom):
        """Whether two terms of a sum are inputs, or an input and a constant."""
        single = (m for m in self.sums[atom] if len(m) < 2)
        return sum(all(n == 1 and isinstance(self.meaning[a], str) for a, n in m) for m in single) > 1

    def of_one_angle(self, terms):
        """Terms with 1 - cos²s for sin²s, or the other way round, where these are fewer."""
        squares = {atom for m in terms for atom, n in m if n > 1}
        for pair in self.angles.values():
            for square, other in itertools.permutations(pair.values(), 2):
                if square not in squares:
                    continue
                result = Counter()
                for m, c in terms.items():
                    rest = _joined(m, ((square, -2),)) if dict(m).get(square, 0) > 1 else None
                    result[m if rest is None else rest] += c
                    if rest is not None:
                        result[_joined(rest, ((other, 2),))] -= c
                result = {m: c for m, c in result.items() if c}
                if len(result) < len(terms):
                    return self.of_one_angle(result)
        return terms

    def written(self):
        """The statements of all outputs."""
        writer = _Writer(self.meaning, self.sums)
        for target, polynomial in self.outputs:
            writer.statements.append((target, ca.OP_ASSIGN, (writer.polynomial(polynomial),)))
        return writer.statements


class _Writer:
    """The statements written so far; `places` are the operands of atoms."""

    def __init__(self, meaning, sums):
        self.meaning, self.sums, self.statements, self.known, self.places = meaning, sums, [], {}, {}

    def write(self, operation, *operands):
        key = operation, frozenset(Counter(operands).items()) if operation in (ca.OP_MUL, ca.OP_ADD) else operands
        if key not in self.known:
            self.known[key] = len(self.known)
            self.statements.append((self.known[key], operation, operands))
        return self.known[key]

    def atom(self, atom):
        """The operand of an atom."""
        if atom not in self.places:
            key = self.meaning[atom]
            if atom in self.sums:
                self.places[atom] = self.polynomial(self.sums[atom])
            elif isinstance(key, str):
                self.places[atom] = key
            else:
                operation, terms = key
                self.places[atom] = self.write(operation, *(self.polynomial({m: c} if c else {}) for m, c in terms))
        return self.places[atom]

    def is_parameter(self, atom):
        key = self.meaning[atom]
        return isinstance(key, str) and key.startswith("p")

    def polynomial(self, terms):
        """The operand of a polynomial: its common factor, and the factor of most of its terms, are taken out."""
        if len(terms) < 2:
            return self.term(*next(iter(terms.items()), NOTHING))
        common, sizes = _content(terms), {abs(c) for c in terms.values()}
        scale = sizes.pop() if len(sizes) == 1 else 1.0
        if common or scale != 1:
            inner = {_joined(m, _power(common, -1)): c / scale for m, c in terms.items()}
            return self.term(common, scale, self.polynomial(inner))
        shared = Counter((a, n > 0) for m in terms for a, n in m)
        (atom, positive), count = max(shared.items(), key=lambda item: item[1], default=((None, None), 0))
        if count < 2:
            return self.sum(terms)
        inside = {m: c for m, c in terms.items() if any(a == atom and (n > 0) == positive for a, n in m)}
        rest = {m: c for m, c in terms.items() if m not in inside}
        both = [self.polynomial(part) for part in (rest, inside) if part]
        return self.write(ca.OP_ADD, *both) if len(both) > 1 else both[0]

    def sum(self, terms):
        """The operand of a sum, term by term."""
        positive = sorted(terms.items(), key=lambda item: item[1] < 0)
        (m, c), *others = positive
        value = self.term(m, c)
        for m, c in others:
            value = self.write(ca.OP_ADD if c > 0 else ca.OP_SUB, value, self.term(m, abs(c)))
        return value

    def term(self, monomial, c, *factors):
        """The operand of c times a monomial and further factors."""
        factors = [*factors]
        for atom, power in sorted(monomial, key=lambda pair: not self.is_parameter(pair[0])):
            place = self.atom(atom)
            place = self.write(ca.OP_INV, place) if power < 0 else place
            factors += [place] * abs(power)
        if not factors:
            return Constant(c)
        value, *others = factors
        for other in others:
            value = self.write(ca.OP_MUL, value, other)
        if abs(c) != 1:
            return self.write(ca.OP_MUL, Constant(c), value)
        return value if c > 0 else self.write(ca.OP_NEG, value)
