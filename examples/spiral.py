"""A spiral of order 5: the third time derivative of a particle's curvature is kept constant.

The program has order 5 in the coordinates, so that the motion has more free initial values than a mechanism has
states: start values of acceleration and jerk are chosen, too. The reaction does no work; the speed stays 1 m/s, and
the heading is c t^4/4!.
"""

import casadi as ca

import servoctl as sv

p = sv.parameters(m=1.0, c=1.5)  # kg, 1/(m s^3): a heading of 1 rad after 2 s
q = sv.coordinates("x y")  # m, m
x, y = q
dx, dy = q.d(1)
ddx, ddy = q.d(2)

curvature = (dx * ddy - dy * ddx) / (dx**2 + dy**2) ** 1.5  # 1/m
mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, ca.vertcat(x, y)), parameters=p)
program = sv.Program({"curvature": q.dt(curvature, 3) - p.c}, by="ideal")


def main(fast=False):
    """Heading [rad] and position [m] after 2 s, and the speed's error; `fast` checks fewer segments of the run."""
    model = sv.derive(mechanism, program)
    print(model)
    straight_on = {"x": 0.0, "y": 0.0, "dx": 1.0, "dy": 0.0, "d2y": 0.0, "d3y": 0.0, "d4y": 0.0}
    run = sv.simulate(model, model.start(**straight_on), (0.0, 2.0))
    print(run)
    proof = sv.verify(run, segments=3 if fast else 20)
    print(proof)
    dx, dy = run["dx"], run["dy"]
    return {
        "free": model.free,
        "heading": float(ca.atan2(dy[-1], dx[-1])),
        "x": float(run["x"][-1]),
        "y": float(run["y"][-1]),
        "speed error": float(abs(dx**2 + dy**2 - 1.0).max()),
        "verified": proof.passed,
    }


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
