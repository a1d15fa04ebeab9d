"""A reduction whose expressions are derived when they are asked for: often another process has derived the rest."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from servoctl.errors import SpecificationError
from servoctl.model.memo import Memo, key
from servoctl.reduction.appell import Realisation
from servoctl.reduction.reduce import Reduction, reduce
from servoctl.reduction.row import Row
from servoctl.spec.mechanism import Mechanism

_AT_HAND = ("mechanism", "program", "top", "free", "needs", "rank", "knots")


class Derivation:
    """The `Reduction` of a specification, derived at once unless its outline is kept on disk.

    It has the attributes of the reduction; those that hold expressions derive it.

    Parameters
    ----------
    mechanism, program, guess, near, values
        As `servoctl.reduction.reduce.reduce` takes them.

    Attributes
    ----------
    outline : Reduction
        Without expressions: rows by name, order and story, ranks and knots.
    values : (n_p,) array
        Parameters at which ranks are decided.
    """

    def __init__(self, mechanism, program, guess=None, near=None, values=None):
        if values is None and isinstance(mechanism, Mechanism):
            values = mechanism.parameters.values()
        self.values = values
        self._given = mechanism, program, dict(guess) if isinstance(guess, dict) else guess, near, values
        self._memo = Memo(key(*self._given))
        outline = self.recall("outline", lambda: _outline(self.derived))
        self.outline = replace(outline, mechanism=mechanism, program=program)

    @cached_property
    def derived(self):
        """The reduction itself.

        Raises
        ------
        SpecificationError
            If the specification has become another.
        """
        self._require_unchanged()
        return reduce(*self._given)

    def recall(self, name, build):
        """What was derived of the specification under a name, or else what `build()` derives, which is kept.

        Parameters
        ----------
        name : str
        build : callable
            Without arguments.

        Raises
        ------
        SpecificationError
            If it is to be built and the specification has become another.
        """

        def build_unchanged():
            self._require_unchanged()
            return build()

        return self._memo.recall(name, build_unchanged)

    def again(self, guess=None, near=None, values=None):
        """The same specification derived with other choices (see `servoctl.reduction.reduce.reduce`).

        Raises
        ------
        SpecificationError
            If the specification has become another.
        """
        self._require_unchanged()
        mechanism, program, *_ = self._given
        return Derivation(mechanism, program, guess, near, values)

    def _require_unchanged(self):
        if key(*self._given) != self._memo.key:
            raise SpecificationError(
                "The mechanism or the program was changed after its model was derived.",
                "A specification is a value: what is derived of it later must fit what was derived before.",
                do="Make another mechanism or program, and derive its model.",
            )

    @property
    def timed(self):
        """Whether paths switch at instants."""
        return self.outline.switches

    def __getattr__(self, name):
        if name.startswith("_") or name in ("outline", "values"):
            raise AttributeError(name)
        return getattr(self.outline if name in _AT_HAND else self.derived, name)

    def __repr__(self):
        return repr(self.outline)

    def decided_at(self, values):
        """Whether these are the parameters at which ranks were decided."""
        return np.array_equal(values, self.values)


def _outline(reduction):
    """A reduction without its expressions."""
    realisation, rows = reduction.realisation, (*reduction.rows, *reduction.given.values())
    bare = {id(r): Row(None, r.order, r.name, r.kind, r.affine, r.story, r.uses) for r in rows}
    return Reduction(
        mechanism=None,
        program=None,
        rows=tuple(bare[id(row)] for row in reduction.rows),
        realisation=Realisation(None, None, realisation.dependent, realisation.independent, None),
        rank=reduction.rank,
        points=None,
        guards=(),
        knots=reduction.knots,
        switches=bool(reduction.switches),
        context=None,
        given={name: bare[id(row)] for name, row in reduction.given.items()},
    )
