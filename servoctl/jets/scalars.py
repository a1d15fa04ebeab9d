"""SX scalars that are evaluated at many points of jet space: each is read once."""

from math import factorial

import numpy as np

from servoctl.jets.tape import Tape

REAL = np.longdouble


class Scalars:
    """Some SX scalars with the places of their symbols in jet space.

    Parameters
    ----------
    q : Coordinates
    parameters : tuple of SX
    expressions : sequence of SX scalars
    others : collection of int, optional
        Element hashes of further symbols, whose values here are zero.

    Attributes
    ----------
    tape : Tape
    places : list
        What each symbol is; see `Coordinates.where`.
    """

    def __init__(self, q, parameters, expressions, others=()):
        self.expressions, self.tape = expressions, Tape(None, expressions)
        self._last = None, None  # inputs, and the values of all nodes
        self.places = [q.where(s) for s in self.tape.symbols]
        names = [p.element_hash() for p in parameters]
        first = {"t": 1 + len(names), "q": 2 + len(names)}
        self._rows, self._factors = [], np.ones((len(self.places), 1))
        for i, (symbol, place) in enumerate(zip(self.tape.symbols, self.places, strict=True)):
            if place is None:
                key = symbol.element_hash()
                self._rows.append(0 if key in others else 1 + names.index(key))
            else:
                kind, level, k = place
                start = first["q"] + q.nq + (level - 1) * q.n if kind == "w" else first[kind]
                self._rows.append(start + k)
                self._factors[i] = factorial(level)

    def inputs(self, t, z, values):
        """Values of the symbols (n, N) at times t (N,) and jets z (nz, N); jets above those of z are zero."""
        sources = np.empty((2 + len(values) + len(z), len(t)), dtype=REAL)
        sources[0], sources[1 : 1 + len(values)] = 0.0, values[:, None]
        sources[1 + len(values)], sources[2 + len(values) :] = t, z
        return sources[[row if row < len(sources) else 0 for row in self._rows]] * self._factors

    def values(self, t, z, values):
        """Values of the scalars (len, N)."""
        return self._nodes(t, z, values)[self.tape.plan.place[self.tape.outputs]]

    def evaluate(self, t, z, values):
        """Values and sizes of the scalars (2, len, N); see `evaluation.evaluate`."""
        nodes = self._nodes(t, z, values)
        with np.errstate(all="ignore"):
            sizes = self.tape.plan.sizes(nodes)
        return np.array([nodes, sizes])[:, self.tape.plan.place[self.tape.outputs]]

    def _nodes(self, t, z, values):
        """Values of all nodes of the tape; those of the last points are remembered."""
        inputs = self.inputs(t, z, values)
        last, nodes = self._last
        if not np.array_equal(inputs, last):
            with np.errstate(all="ignore"):
                nodes = self.tape.plan.values(inputs)
            self._last = inputs, nodes
        return nodes


class Book:
    """The scalars that were read so far."""

    def __init__(self):
        self._read = {}  # element hash: its scalars, and which of them it is

    def find(self, q, parameters, expressions):
        """Where expressions are found; new ones are read together.

        Parameters
        ----------
        q : Coordinates
        parameters : tuple of SX
        expressions : sequence of SX scalars

        Returns
        -------
        list of (Scalars, list of int, list of int)
            Scalars that hold some of them, their places in these, and in `expressions`.
        """
        hashes = [e.element_hash() for e in expressions]
        new = {h: e for h, e in zip(hashes, expressions, strict=True) if h not in self._read}
        if new:
            scalars = Scalars(q, parameters, list(new.values()))
            self._read |= {h: (scalars, i) for i, h in enumerate(new)}
        by_scalars = {}
        for at, (scalars, i) in enumerate(map(self._read.get, hashes)):
            sources, targets = by_scalars.setdefault(scalars, ([], []))
            sources.append(i)
            targets.append(at)
        return [(scalars, *places) for scalars, places in by_scalars.items()]
