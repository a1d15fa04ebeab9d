"""Values that hold expressions, on their way to another process.

CasADi's expressions do not pickle, but functions do: all expressions of a value become one function of t, q, the jets
and the parameters, which the reader calls on symbols of its own. They come back operation by operation.
"""

import io
import pickle
from dataclasses import fields, is_dataclass

import casadi as ca


def packed(value, q, parameters, shared=None):
    """A value as what pickles.

    Parameters
    ----------
    value : object
        It may hold SX expressions at any depth. A dataclass travels as the fields that its constructor takes, without
        those that do not count for its equality: what was computed from the others is computed again.
    q : Coordinates
    parameters : Parameters
        The expressions depend on their symbols alone.
    shared : dict of str to object, optional
        What the reader has already, by name, beside q: it is referred to, and not packed.

    Returns
    -------
    function : casadi.Function
        Of the expressions.
    content : bytes
        The rest.
    """
    stream = io.BytesIO()
    pickler = _Pickler(stream, {"q": q, **(shared or {})})
    pickler.dump(value)
    return q.as_function(pickler.expressions, parameters.symbols), stream.getvalue()


def unpacked(content, q, parameters, shared=None):
    """The value that was `packed`, in the symbols of q and the parameters.

    Parameters
    ----------
    content : (casadi.Function, bytes)
    q, parameters, shared
        As `packed` takes them; they may be those of another process.
    """
    function, rest = content
    unpickler = pickle.Unpickler(io.BytesIO(rest))
    known = dict(enumerate(q.from_function(function, parameters.symbols))) | {"q": q, **(shared or {})}
    unpickler.persistent_load = known.__getitem__
    return unpickler.load()


class _Pickler(pickle.Pickler):
    """Puts expressions aside, and refers by name to what the reader has."""

    def __init__(self, stream, shared):
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self.expressions, self.names = [], {id(value): name for name, value in shared.items()}

    def persistent_id(self, value):
        if not isinstance(value, ca.SX):
            return self.names.get(id(value))
        self.expressions.append(value)
        return len(self.expressions) - 1

    def reducer_override(self, value):
        if not is_dataclass(value) or isinstance(value, type):
            return NotImplemented
        return _made, (type(value), {f.name: getattr(value, f.name) for f in fields(value) if f.init and f.compare})


def _made(kind, values):
    return kind(**values)
