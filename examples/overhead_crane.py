"""Overhead crane: the load follows a path; trolley and hoist forces realise it."""

import casadi as ca

import servoctl as sv


def crane(duration=6.0):
    p = sv.parameters(m_trolley=10.0, m_hoist=5.0, m_load=100.0, g=9.81)  # kg, m/s^2
    q = sv.coordinates("x l theta")  # m, m, rad
    x, l, theta = q
    load = ca.vertcat(x + l * ca.sin(theta), l * ca.cos(theta))  # m; second entry down
    S = sv.particle(q, p.m_trolley, x) + sv.particle(q, p.m_hoist, l) + sv.particle(q, p.m_load, load)
    path = sv.paths.rest_to_rest(start=(0.0, 4.0), end=(5.0, 2.0), duration=duration, smoothness=4)
    r = q.references(X=path[0], Z=path[1])
    return (
        sv.Mechanism(
            q,
            gibbs=S,
            potential=-p.m_load * p.g * load[1],
            actuators={"trolley": x, "hoist": l},  # by the displacement that a force works on
            parameters=p,
        ),
        sv.Program({"X": load[0] - r.X, "Z": load[1] - r.Z}, by="actuators"),
    )


def main(fast=False):
    """Extrema of both forces [N] and of the rope's angle [rad]; `fast` checks fewer segments of the plan."""
    mechanism, program = crane()
    model = sv.derive(mechanism, program)
    print(model)  # X, Z are differentiated twice; 1 hidden constraint; flat: nothing is integrated
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))  # the path holds its end after 6 s
    print(plan)
    proof = sv.verify(plan, segments=3 if fast else 20)
    print(proof)
    numbers = {"free": model.free, "index": model.structure().index, "verified": proof.passed}
    for name in ("trolley", "hoist", "theta"):
        (_, least), (_, greatest) = plan.extrema(name)
        numbers |= {f"{name} min": least, f"{name} max": greatest}
    return numbers


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
