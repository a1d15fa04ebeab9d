"""Exponentials that leave the range of doubles inside expressions that do not.

1/(1 + e^s) is 0 for large s, and its derivative e^s/(1 + e^s)² is ∞/∞. Beyond e^s = 1e60 such an expression has its
limit to all digits: there s stays at `LAST_EXPONENT`, by fmin(s, LAST_EXPONENT), which is no switch of the motion. That
holds where the expression is bounded in e^s, as its degree in e^s shows; log(1 + e^s) goes on as s.
"""

import casadi as ca

from servoctl.jets.branches import apply_code, replayed
from servoctl.tolerances import LAST_EXPONENT

_GROWING = {ca.OP_EXP, ca.OP_EXPM1, ca.OP_SINH, ca.OP_COSH}
_SAME = {ca.OP_NEG, ca.OP_TWICE, ca.OP_FABS, ca.OP_ASSIGN}  # of the same degree
_SUMS = {ca.OP_ADD, ca.OP_SUB, ca.OP_FMIN, ca.OP_FMAX, ca.OP_HYPOT}
_POWERS = {ca.OP_SQ: 2, ca.OP_SQRT: 0.5, ca.OP_INV: -1}
_SETTLED = {ca.OP_TANH, ca.OP_ATAN, ca.OP_ERF}  # with a limit at infinity
_LOGS = {ca.OP_LOG, ca.OP_LOG1P}


class _Degrees:
    """Degrees of the values of expressions in e^s, where s goes to infinity in one direction, 1 or -1.

    An exponent is a factor times s, whatever that is; s goes by the place of its value. Each value has in `of` its
    degrees by s, without zeros, and in `scaled` the place and the factor of which it is the product. `grows` has each s
    in which a value is not bounded, or whose exponentials are mixed with others, `factors` the factors of the exponents
    in each s, `logs` the places of log(c + e^a) with those of a.
    """

    def __init__(self, direction):
        self.direction, self.of, self.values, self.codes, self.scaled = direction, [], [], [], []
        self.grows, self.factors, self.logs = set(), {}, {}

    def leaf(self, expression, symbol):
        """Take in a symbol or a number."""
        return self._keep(None, (), expression, {})

    def value(self, op, operands):
        """Take in an operation on places."""
        result = apply_code(op, *(self.values[i] for i in operands))
        return self._keep(op, operands, result, self._degrees(op, operands))

    def _keep(self, op, operands, value, degrees):
        self.scaled.append(self._scale(op, operands))
        self.codes.append((op, operands))
        self.values.append(value)
        self.of.append({key: d for key, d in degrees.items() if d})
        return value

    def _scale(self, op, operands):
        """The place and the factor of which the next value is the product."""
        numbers = [float(self.values[i]) if self.values[i].is_constant() else None for i in operands]
        if op in (ca.OP_NEG, ca.OP_TWICE):
            place, factor = self.scaled[operands[0]]
            return place, factor * (-1 if op == ca.OP_NEG else 2)
        if op in (ca.OP_MUL, ca.OP_DIV) and numbers[1]:
            place, factor = self.scaled[operands[0]]
            return place, factor * numbers[1] if op == ca.OP_MUL else factor / numbers[1]
        if op == ca.OP_MUL and numbers[0]:
            place, factor = self.scaled[operands[1]]
            return place, factor * numbers[0]
        return len(self.values), 1.0

    def _degrees(self, op, operands):
        parts = [self.of[i] for i in operands]
        if op in _GROWING:
            return self._exponential(op, operands[0])
        if op in _SAME:
            return parts[0]
        if op in _SUMS:
            a, b = parts
            self._require_one({key for part in parts for key, d in part.items() if d > 0})
            return {key: max(a.get(key, 0), b.get(key, 0)) for key in {*a, *b}}
        if op in (ca.OP_MUL, ca.OP_DIV):
            a, b = parts
            self._require_one({*a, *b})
            sign = 1 if op == ca.OP_MUL else -1
            return {key: a.get(key, 0) + sign * b.get(key, 0) for key in {*a, *b}}
        if op in _POWERS:
            return {key: _POWERS[op] * d for key, d in parts[0].items()}
        if op in (ca.OP_CONSTPOW, ca.OP_POW) and self.values[operands[1]].is_constant():
            return {key: float(self.values[operands[1]]) * d for key, d in parts[0].items()}
        return parts[1] if op == ca.OP_IF_ELSE_ZERO else self._function(op, operands[0], parts)

    def _exponential(self, op, exponent):
        """The degree of e^s; what grows in s itself is not bounded."""
        self.grows |= set(self.of[exponent])
        key, factor = self.scaled[exponent]
        self.factors.setdefault(key, set()).add(factor)
        if op in (ca.OP_SINH, ca.OP_COSH):
            self.factors[key].add(-factor)
            return {key: abs(factor)}
        return {key: factor * self.direction if op == ca.OP_EXP else max(factor * self.direction, 0)}

    def _function(self, op, place, parts):
        """Degrees of another function: none where it is bounded, or of what vanishes."""
        exponent = self._logarithm(op, place) if op in _LOGS and any(d > 0 for d in parts[0].values()) else None
        if exponent is not None:
            self.logs[len(self.values)] = exponent
        elif op not in _SETTLED:
            self.grows |= {key for part in parts for key, d in part.items() if d > 0 or op in _LOGS}
        return {}

    def _logarithm(self, op, place):
        """The place of the exponent a in log(c + e^a) or log1p(e^a); None for the logarithm of another value."""
        code, operands = self.codes[place]
        if op == ca.OP_LOG and code == ca.OP_ADD:
            constant = [self.values[i].is_constant() for i in operands]
            code, operands = self.codes[operands[0 if constant[1] else 1]] if any(constant) else (None, ())
        elif op == ca.OP_LOG:
            return None
        return operands[0] if code == ca.OP_EXP else None

    def _require_one(self, keys):
        if len(keys) > 1:
            self.grows |= keys

    def bounded(self, outputs):
        """Each s in which all outputs are bounded, and some exponential grows."""
        places = {value.element_hash(): i for i, value in enumerate(self.values)}
        of = (self.of[places[output.element_hash()]] for output in outputs if output.element_hash() in places)
        unbounded = self.grows | {key for degrees in of for key, d in degrees.items() if d > 0}
        return {key for key, all_ in self.factors.items() if max(f * self.direction for f in all_) > 0} - unbounded


def settled(expressions):
    """SX scalars whose exponents stay at `LAST_EXPONENT` beyond it, where they have their limits there.

    Without any such exponent they are returned as they are.
    """
    if not expressions or not _has_growing(expressions):
        return expressions
    merged = ca.densify(ca.cse(ca.vertcat(*expressions))).elements()
    ways = [_Degrees(direction) for direction in (1, -1)]
    ends = [way.bounded(replayed(merged, [], way.leaf, way.value)) for way in ways]
    return _rewritten(merged, ways, ends) if any(ends) else expressions


def _has_growing(expressions):
    f = ca.Function("growing", [], [ca.vertcat(*expressions)], {"allow_free": True})
    return any(f.instruction_id(k) in _GROWING for k in range(f.n_instructions()))


def _rewritten(expressions, ways, ends):
    """The expressions with exponents that end at their last values: upwards, and downwards, for each s in `ends`."""
    work, (up, down) = [], ends
    scaled, factors = ways[0].scaled, ways[0].factors
    largest = {key: max(map(abs, factors[key])) for key in up | down}

    def steepest(place):
        """Of the exponent at a place: its share of the one that grows fastest, and that one."""
        key, factor = scaled[place]
        return factor / largest[key], work[key] * largest[key]

    def value(op, operands):
        place, arguments = len(work), [work[i] for i in operands]
        key = scaled[operands[0]][0]
        if op in _GROWING and key in largest:
            share, end = steepest(operands[0])
            end = ca.fmin(end, LAST_EXPONENT) if key in up else end
            arguments = [share * (ca.fmax(end, -LAST_EXPONENT) if key in down else end)]
        result = apply_code(op, *arguments)
        for way, bounded, sign in zip(ways, ends, (1, -1), strict=True):
            if place in way.logs and scaled[way.logs[place]][0] in bounded:
                share, end = steepest(way.logs[place])
                result += abs(share) * (ca.fmax(sign * end, LAST_EXPONENT) - LAST_EXPONENT)
        return result

    return replayed(expressions, work, lambda expression, symbol: expression, value)
