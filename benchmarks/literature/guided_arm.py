"""An arm of n links with k of its joints guided: the family over n and k on which formulations are compared."""

import casadi as ca

import servoctl as sv
from servoctl.errors import SpecificationError
from servoctl.gallery.links import planar_arm


def guided_arm(n=4, k=2, coordinates="joints"):
    """The arm of `links.planar_arm` whose last k joint points (its end is one) move horizontally, ideally.

    Parameters
    ----------
    n : int
        Number of links, at least 2.
    k : int
        Number of constraints, 1 .. n - 1, linear in velocities: "height 3", "height 4".
    coordinates : {"joints", "bodies"}
        As in `links.planar_arm`: n coordinates, or 3n with 2n material constraints.

    Returns
    -------
    Mechanism, Program

    Raises
    ------
    SpecificationError
        If k constraints leave no motion, or there are fewer than two links.
    NameUnknown
        For other coordinates.
    """
    mechanism, _ = planar_arm(n, coordinates)
    if not 1 <= k < n:
        raise SpecificationError(
            f"k = {k} joints of {n} are guided.",
            "At least one joint is guided and at least one is free.",
            nearest=f"k = {min(max(k, 1), n - 1)}.",
            n=n,
            k=k,
        )
    q, length = list(mechanism.q), mechanism.parameters.l
    inclinations = [sum(q[: i + 1]) for i in range(n)] if coordinates == "joints" else q[2::3]
    heights = [sum(length * ca.sin(phi) for phi in inclinations[: i + 1]) for i in range(n)]
    guided = {f"height {i + 1}": mechanism.q.dt(heights[i]) for i in range(n - k, n)}
    return mechanism, sv.Program(guided, by="ideal")
