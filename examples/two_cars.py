"""Two cars and a spring: one program, realised by an ideal reaction and by a real actuator.

The first car follows a path. An ideal reaction acts where the program does, on the first car; the second one swings
at the end of its spring. A motor on the second car has to move the first one through that spring, and must follow the
path's derivatives up to the fourth: F = m1 m2/k y'''' + (m1 + m2) y''.
"""

from math import hypot, sqrt

import servoctl as sv


def two_cars(by):
    p = sv.parameters(m1=1.0, m2=2.0, k=1.0, gap=0.5)  # kg, kg, N/m, m
    q = sv.coordinates("x1 x2")  # m, m
    x1, x2 = q
    S = sv.particle(q, p.m1, x1) + sv.particle(q, p.m2, x2)
    r = q.references(y=sv.paths.rest_to_rest(0.5, 2.5, duration=2.0, smoothness=6))
    mechanism = sv.Mechanism(
        q, gibbs=S, potential=p.k * (x1 - x2 - p.gap) ** 2 / 2, actuators={"force": x2}, parameters=p
    )
    return mechanism, sv.Program({"car 1": x1 - r.y}, by=by)


def main(fast=False):
    """Largest reaction and force [N], their instants [s], what swings on [m]; `fast` checks fewer segments."""
    numbers = {}
    for by, start, signal in (
        ("ideal", {"x2": 0.0, "dx2": 0.0}, "reaction_x1"),  # two free initial values: the second car's
        ("actuators", {}, "force"),  # none: the second car's motion follows from the first one's
    ):
        model = sv.derive(*two_cars(by))
        print(model)
        run = sv.simulate(model, model.start(**start), (0.0, 2.0))
        proof = sv.verify(run, segments=3 if fast else 20)
        print(proof)
        _, (instant, greatest) = run.extrema(signal)
        numbers |= {
            f"{by} max": greatest,
            f"{by} at": instant,
            f"{by} free": model.free,
            f"{by} swing": hypot(*_swing(run)),
            f"{by} verified": proof.passed,
        }
        if by == "ideal":
            numbers["ideal outside"] = proof.numbers["outside"]  # share of the reaction that the motor cannot give
    return numbers


def _swing(run, m2=2.0, k=1.0, gap=0.5):
    """Stretch of the spring and its rate over the second car's frequency, at the end of the run [m]."""
    stretch = run["x1"][-1] - run["x2"][-1] - gap
    return stretch, (run["dx1"][-1] - run["dx2"][-1]) / sqrt(k / m2)


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
