"""Parameters: symbols in the equations, numbers at run time."""

import casadi as ca
import numpy as np

from servoctl.checks import by_name, finite
from servoctl.errors import SpecificationError, unknown


class Parameters:
    """Named parameters, made by `parameters`; `p.m` is a symbol, `p.defaults["m"]` its number.

    Attributes
    ----------
    defaults : dict of str to float
    """

    def __init__(self, values, written=None):  # the symbols' own names, which `renamed` keeps
        self.defaults = dict(values)
        self._symbols = dict(zip(values, map(ca.SX.sym, written or values), strict=True))

    def __getattr__(self, name):
        symbols = self.__dict__.get("_symbols", {})
        if name in symbols:
            return symbols[name]
        if name.startswith("_"):
            raise AttributeError(name)
        raise unknown(name, list(symbols), "parameter")

    def __reduce__(self):
        return Parameters, (self.defaults, [symbol.name() for symbol in self.symbols])

    def __repr__(self):
        return "Parameters(" + ", ".join(f"{k}={v:g}" for k, v in self.defaults.items()) + ")"

    @property
    def names(self):
        """The names, in the order of their definition."""
        return tuple(self.defaults)

    @property
    def symbols(self):
        """The symbols, in the order of `names`."""
        return tuple(self._symbols.values())

    def name_of(self, symbol):
        """The name of a symbol, which may differ from the one that it prints; None if it is no parameter."""
        return next((name for name, own in self._symbols.items() if own.element_hash() == symbol.element_hash()), None)

    def renamed(self, names):
        """These parameters, with the same symbols, by new names {old: new}; themselves where these are the same."""
        if tuple(names.values()) == self.names:
            return self
        other = Parameters({names[name]: value for name, value in self.defaults.items()})
        other._symbols = {names[name]: symbol for name, symbol in self._symbols.items()}
        return other

    def extended(self, **values):
        """These parameters, with the same symbols, and further ones.

        Parameters
        ----------
        **values : float
            Defaults of the further ones.
        """
        wider = Parameters(self.defaults | values)
        wider._symbols.update(self._symbols)
        return wider

    def values(self, changes=None):
        """The numbers in the order of `names`, some of them changed.

        Parameters
        ----------
        changes : dict of str to float, optional

        Returns
        -------
        (n_p,) array

        Raises
        ------
        NameUnknown
            For a name that is no parameter.
        SpecificationError
            For a value that is no finite number.
        """
        numbers = dict(self.defaults)
        for name, value in by_name(changes, numbers, "parameter", "The parameters").items():
            numbers[name] = finite(name, value, "parameter")
        return np.array(list(numbers.values()), dtype=float)


def parameters(**values: float) -> Parameters:
    """Parameters with their default numbers, e.g. `parameters(m=1.0, g=9.81)`.

    Parameters
    ----------
    **values : float
        Default of each name, SI. Derivations keep the symbols; numbers enter at run time.

    Returns
    -------
    p : Parameters

    Raises
    ------
    SpecificationError
        If a value is no finite number or a name would hide an attribute.
    """
    for name in values:
        if name in ("t", "defaults") or hasattr(Parameters, name):
            raise SpecificationError(
                f"A parameter is named {name!r}.", "This name is reserved.", do="Rename it.", name=name
            )
    return Parameters({name: finite(name, value, "parameter") for name, value in values.items()})
