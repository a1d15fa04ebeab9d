"""Tapes run on numbers at many points: nodes of one kind that wait for nothing any more are run together."""

import numpy as np

from servoctl.jets.elementary import apply


class Plan:
    """The nodes of a tape sorted so that those that are run together are neighbours.

    Parameters
    ----------
    nodes : list of Node

    Attributes
    ----------
    place : (n_nodes,) array of int
        Of each node of the tape, in this order.
    constants, inputs : (places, values) and (places, indices)
    groups : list of (kind, data, slice, (operands, size) array)
        With the places of the operands. A square is a product here.
    slopes : dict of int to list of (size,) arrays
        Of groups of kind "quad", by their first place: the places of dy/da for each operand.
    """

    def __init__(self, nodes):
        sorts, sort, depth = {}, [], []
        for kind, args, data in nodes:
            if args:
                a, b = depth[args[0]], depth[args[-1]]
                depth.append(1 + (a if a > b else b))
                key = ("mul", None) if kind == "sq" else (kind, data[0] if kind == "quad" else data)
            else:
                depth.append(0)
                key = kind, None
            sort.append(sorts.setdefault(key, len(sorts)))
        order = np.lexsort((sort, depth))
        self.place = np.empty(len(nodes), dtype=int)
        self.place[order] = np.arange(len(nodes))
        changes = np.diff(np.array([depth, sort])[:, order]).any(axis=0)
        bounds = [0, *(1 + np.flatnonzero(changes)).tolist(), len(nodes)] if nodes else [0]
        ends = [[args[k] if args else 0 for _, args, _ in nodes] for k in (0, -1)]
        operands = self._places(ends)[:, order]
        sorts, order = list(sorts), order.tolist()
        self.constants, self.inputs, self.groups, self.slopes = ([], []), ([], []), [], {}
        for first, last in zip(bounds[:-1], bounds[1:], strict=True):
            kind, data = sorts[sort[order[first]]]
            _, args, _ = nodes[order[first]]
            if not args:
                leaves = self.constants if kind == "const" else self.inputs
                leaves[0].extend(range(first, last))
                leaves[1].extend(nodes[i].data for i in order[first:last])
                continue
            count = 2 if kind == "mul" else len(args)
            self.groups.append((kind, data, slice(first, last), operands[:count, first:last].copy()))
            if kind == "quad":
                slopes = zip(*(nodes[i].data[1] for i in order[first:last]), strict=True)
                self.slopes[first] = [self._places(column) for column in slopes]

    def _places(self, nodes):
        return self.place[np.asarray(nodes, dtype=int)]

    def values(self, inputs):
        """The value of every node at N points, (n_nodes, N), from those of the inputs, (n_inputs, N)."""
        v = np.empty((len(self.place), *inputs.shape[1:]), dtype=inputs.dtype)
        places, constants = self.constants
        v[places] = np.array(constants)[:, None]
        places, indices = self.inputs
        v[places] = inputs[indices]
        for kind, data, here, operands in self.groups:
            values = v.take(operands, axis=0)
            if kind in _ARITHMETIC:
                _ARITHMETIC[kind](*values, out=v[here])
            else:
                v[here] = _VALUE[kind](data, *values)
        return v

    def sizes(self, v):
        """The size of the terms that made every node, (n_nodes, N), from the values."""
        magnitude = np.abs(v)
        size = magnitude.copy()
        for kind, data, here, operands in self.groups:
            parts = size.take(operands, axis=0)
            if kind in ("add", "sub"):
                np.add(*parts, out=size[here])
            elif kind == "mul":
                a, b = magnitude.take(operands, axis=0)
                np.add(a * parts[1], parts[0] * b, out=size[here])
            elif kind == "quad":
                for slope, part in zip(self.slopes[here.start], parts, strict=True):
                    size[here] += np.nan_to_num(magnitude.take(slope, axis=0)) * part
            elif kind != "constant":
                size[here] = _SIZE[kind](data, magnitude[here], *v.take(operands, axis=0), *parts)
        return size


def _power_size(exponent, y, a, size):
    return y * (1.0 + abs(exponent) * size / np.maximum(np.abs(a), np.finfo(float).tiny))


_ARITHMETIC = {"add": np.add, "sub": np.subtract, "mul": np.multiply, "div": np.divide, "neg": np.negative}
_VALUE = {
    "copy": lambda _, a: a,
    "scale": lambda factor, a: a * factor,
    "sqrt": lambda _, a: np.sqrt(a),
    "fabs": lambda _, a: np.abs(a),
    "power": lambda exponent, a: a**exponent,
    "gate": lambda _, a, b: np.where(a != 0, b, 0.0),
    "fmin": lambda _, a, b: np.where(a <= b, a, b),
    "fmax": lambda _, a, b: np.where(a <= b, b, a),
    "constant": apply,
    "quad": apply,
}
_SIZE = {  # from the magnitude of y, and values and sizes of the operands
    "div": lambda _, y, a, b, size_a, size_b: (size_a + y * size_b) / np.abs(b),
    "neg": lambda _, y, a, size: size,
    "copy": lambda _, y, a, size: size,
    "fabs": lambda _, y, a, size: size,
    "scale": lambda factor, y, a, size: abs(factor) * size,
    "sqrt": lambda _, y, a, size: _power_size(0.5, y, a, size),
    "power": _power_size,
    "gate": lambda _, y, a, b, size_a, size_b: np.where(a != 0, size_b, 0.0),
    "fmin": lambda _, y, a, b, size_a, size_b: np.where(a <= b, size_a, size_b),
    "fmax": lambda _, y, a, b, size_a, size_b: np.where(a <= b, size_b, size_a),
}


def evaluate(tape, inputs):
    """Values of a tape's outputs and the size of the terms that made them.

    The size of a sum is the sum of the sizes, of a product |a| size(b) + size(a) |b|, of y = f(a)
    |y| + |f'(a)| size(a): rounding is of the order of the machine's epsilon times the size, so an output far
    below its size is zero. Runs in the precision of `inputs`.

    Parameters
    ----------
    tape : Tape
    inputs : (n_inputs, N) array
        Values of the inputs at N points.

    Returns
    -------
    values, sizes : (n_outputs, N) arrays
    """
    outputs = tape.plan.place[tape.outputs]
    with np.errstate(all="ignore"):
        v = tape.plan.values(np.asarray(inputs))
        return v[outputs], tape.plan.sizes(v)[outputs]
