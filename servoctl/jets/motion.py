"""The Taylor coefficients of every symbol along a motion, from those of its coordinates and quasi-velocities."""

from math import factorial

from servoctl.jets.series import is_zero


class Motion:
    """A motion by its normalised Taylor coefficients.

    Subclasses say what these are of q_i, `coordinate(i, j)`, and of γ_i^(l), `velocity(i, l, j)`.

    Parameters
    ----------
    q : Coordinates
    """

    def __init__(self, q):
        self.q = q

    def coefficient(self, symbol, j):
        """Coefficient j of a symbol: t_[0] = t and t_[1] = 1, q_[j], (γ^(l))_[j]; all else is constant."""
        kind, level, i = self.q.where(symbol) or ("constant", 0, 0)
        if kind == "q":
            return self.coordinate(i, j)
        if kind == "w":
            return self.velocity(i, level, j)
        return symbol if j == 0 else float(kind == "t" and j == 1)


def shifted(c, level, j):
    """(γ^(l))_[j] = γ_[l+j] (l + j)!/j!, from c = γ_[l+j]."""
    return 0.0 if is_zero(c) else c * float(factorial(level + j) // factorial(j))
