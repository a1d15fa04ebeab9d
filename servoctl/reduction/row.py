"""A row ψ = 0, and its gradients in the jets."""

from dataclasses import dataclass, field

import casadi as ca


@dataclass(frozen=True)
class Balance:
    """The balance r among the expressions that rows are made of, or one component of it.

    Attributes
    ----------
    component : str
        Name of a coordinate or quasi-velocity; empty for all of them.
    """

    component: str = ""

    def __str__(self):
        return f"the force on {self.component}" if self.component else "the balance"


@dataclass(frozen=True)
class Row:
    """One scalar equation ψ(t, q, γ', ..., γ^(order)) = 0.

    Attributes
    ----------
    expression : SX scalar
    order : int
        Highest level on which it depends on the manifold; 0 for q alone, -1 for neither q nor a jet.
    name : str
    kind : {"program", "material", "dynamics"}
        Where it came from.
    affine : bool
        Whether it is affine in γ^(order).
    story : str
        What was done to it, if it is a hidden constraint.
    uses : dict of (str or Balance) to int
        Highest derivative of each program residual, and of the balance, in it.
    """

    expression: ca.SX
    order: int
    name: str
    kind: str
    affine: bool = True
    story: str = ""
    uses: dict = field(default_factory=dict)
    _gradients: dict = field(default_factory=dict, repr=False, compare=False)

    def gradient(self, q, level=None):
        """∂ψ/∂γ^(level), (1, n) SX; for level 0 ∂ψ/∂q · V. Default: the row's own order, its leading gradient."""
        level = self.order if level is None else level
        key = self.expression.element_hash(), level
        if key not in self._gradients:
            slopes = ca.jacobian(self.expression, q.jet(level))
            self._gradients[key] = self.expression, slopes if level or q.plain else slopes @ q.V
        return self._gradients[key][1]

    def __repr__(self):
        return f"Row({self.name}: {self.kind}, order {self.order}{', ' + self.story if self.story else ''})"


def merge_uses(*parts):
    """The highest number of differentiations of each residual among (uses, extra differentiations) pairs."""
    total = {}
    for uses, extra in parts:
        for name, count in uses.items():
            total[name] = max(total.get(name, 0), count + extra)
    return total

