"""Cars joined by springs: the first follows a path, the last is driven."""

import casadi as ca

import servoctl as sv
from servoctl.errors import SpecificationError


def cars(N=2, masses=None, stiffnesses=None, gaps=None, by="actuators"):
    """N cars in a row, joined by springs; car 1 moves from 0.5 to 2.5 m in 2 s.

    Driven through N - 1 springs, the force depends on the path's derivatives up to order 2N: the path is of class
    C^6, or C^2N for more than three cars.

    Parameters
    ----------
    N : int
        Number of cars, at least 2.
    masses : sequence of N floats, optional
        [kg]; default 1 each, 2 for the last.
    stiffnesses : sequence of N - 1 floats, optional
        Of the spring between cars i and i + 1 [N/m]; default 1 each.
    gaps : sequence of N - 1 floats, optional
        Rest distances x_i - x_(i+1) [m]; default 0.5 each.
    by : {"actuators", "ideal"}
        The actuator "force" [N] on the last car, or an ideal reaction, which acts on the first one. The same program,
        other motions.

    Returns
    -------
    Mechanism, Program

    Raises
    ------
    SpecificationError
        If there are fewer than two cars, or a list has a wrong length.
    """
    if N < 2:
        raise SpecificationError(f"A row of {N} cars.", "A spring joins two cars.", nearest="N = 2.", N=N)
    p = sv.parameters(
        **_numbered("m", "masses", masses, [1.0] * (N - 1) + [2.0]),  # kg
        **_numbered("k", "stiffnesses", stiffnesses, [1.0] * (N - 1)),  # N/m
        **_numbered("gap", "gaps", gaps, [0.5] * (N - 1)),  # m
    )
    q = sv.coordinates(" ".join(f"x{i}" for i in range(1, N + 1)), units="m " * N)
    x, m, k, gap = tuple(q), p.symbols[:N], p.symbols[N : 2 * N - 1], p.symbols[2 * N - 1 :]
    stretch = ca.vertcat(*(x[i] - x[i + 1] - gap[i] for i in range(N - 1)))
    r = q.references(x1=sv.paths.rest_to_rest(0.5, 2.5, duration=2.0, smoothness=max(6, 2 * N)))
    mechanism = sv.Mechanism(
        q,
        gibbs=sum(sv.particle(q, m[i], x[i]) for i in range(N)),
        potential=ca.dot(ca.vertcat(*k), stretch**2) / 2,
        actuators={"force": x[-1]},
        shapes={f"spring {i}": sv.shapes.spring((x[i], 0), (x[i - 1], 0), 0.15) for i in range(1, N)}
        | {f"car {i}": sv.shapes.box((x[i - 1], 0), 0.2, 0.15) for i in range(N, 0, -1)},
        parameters=p,
    )
    return mechanism, sv.Program({"car 1": x[0] - r.x1}, by=by)


def _numbered(letter, what, values, default):
    values = default if values is None else list(values)
    if len(values) != len(default):
        raise SpecificationError(
            f"There are {len(values)} {what}.", f"This row of cars has {len(default)}.", name=what, values=values
        )
    return {f"{letter}{i}": value for i, value in enumerate(values, 1)}
