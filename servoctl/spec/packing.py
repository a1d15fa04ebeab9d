"""Pickling of values that hold CasADi expressions.

Expressions do not pickle, but functions do: all expressions of a value become one function of t, q, the jets and the
parameters, which is called on the symbols of the other process. They come back operation by operation.
"""

import copyreg
import io
import pickle
from dataclasses import fields, is_dataclass

import casadi as ca

from servoctl.errors import SpecificationError


class Packed:
    """Base of values whose expressions hold a mechanism's symbols: they pickle as parts of a model."""

    def __reduce__(self):
        raise SpecificationError(
            f"A {type(self).__name__} was pickled or copied by itself.",
            "Its expressions hold the symbols of a mechanism, so that it pickles with them.",
            do="Pickle the model, the value of sv.derive(mechanism, program); it holds both.",
            type=type(self).__name__,
        )


def packed(value, q, parameters, shared=None):
    """A value with expressions as a function, whose outputs they are, and bytes with everything else; both pickle.

    The value may hold SX expressions at any depth, in the symbols of q and of the parameters. A dataclass is packed as
    those fields of its constructor that count for its equality; cached fields are computed again. Objects in `shared`,
    by name, are referred to, as q is, and not packed.
    """
    stream = io.BytesIO()
    pickler = _Pickler(stream, {"q": q, **(shared or {})})
    pickler.dump(value)
    return q.as_function(pickler.expressions, parameters.symbols), stream.getvalue()


def unpacked(content, q, parameters, shared=None):
    """The value that was `packed`, in the symbols of q and the parameters.

    `content` is the pair that `packed` returned; q, the parameters and `shared` may be those of another process.
    """
    function, rest = content
    unpickler = _Unpickler(io.BytesIO(rest))
    unpickler.known = dict(enumerate(q.from_function(function, parameters.symbols))) | {"q": q, **(shared or {})}
    return unpickler.load()


class _Pickler(pickle.Pickler):
    """Collects expressions, and refers to shared objects by name."""

    def __init__(self, stream, shared):
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self.expressions, self.names = [], {id(value): name for name, value in shared.items()}

    def persistent_id(self, value):
        if not isinstance(value, ca.SX):
            return self.names.get(id(value))
        self.expressions.append(value)
        return len(self.expressions) - 1

    def reducer_override(self, value):
        if isinstance(value, Packed) and not is_dataclass(value):
            return copyreg.__newobj__, (type(value),), vars(value)
        if not is_dataclass(value) or isinstance(value, type):
            return NotImplemented
        return _made, (type(value), {f.name: getattr(value, f.name) for f in fields(value) if f.init and f.compare})


class _Unpickler(pickle.Unpickler):
    """Finds in `known` what a `_Pickler` referred to."""

    def persistent_load(self, name):
        return self.known[name]


def _made(kind, values):
    return kind(**values)
