"""A crane with a fixed rope: no exact inverse moves its load from rest to rest; relaxed plans do."""

import sys

import casadi as ca
import numpy as np

import servoctl as sv

WEIGHTS = [1e-6, 1e-8, 1e-10, 1e-12]  # m²/N²


def crane():
    p = sv.parameters(m_cart=10.0, m_load=100.0, rope=4.0, g=9.81)  # kg, m, m/s^2
    q = sv.coordinates("x theta")  # m, rad
    x, theta = q
    load = ca.vertcat(x + p.rope * ca.sin(theta), -p.rope * ca.cos(theta))  # m; second entry up
    mechanism = sv.Mechanism(
        q,
        gibbs=sv.particle(q, p.m_cart, x) + sv.particle(q, p.m_load, load),
        potential=p.m_load * p.g * load[1],
        actuators={"cart": x},
        parameters=p,
    )
    r = q.references(X=sv.paths.rest_to_rest(start=0.0, end=5.0, duration=6.0, smoothness=4))
    return mechanism, sv.Program({"X": load[0] - r.X})


def save_figure(front, plans, path):
    """The front of error against weight, and the force of three plans."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.5, 3.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    left.loglog(front["weight"], 1e3 * front["largest X"], "o-", color="black")
    left.set(xlabel="weight β [m²/N²]", ylabel="largest error of the load [mm]")
    left.grid(color="0.9")
    for name, plan in plans.items():
        right.plot(plan.t, plan["cart"], label=name)
    right.set(xlabel="t [s]", ylabel="force on the cart [N]")
    right.grid(color="0.9")
    right.legend(frameon=False)
    figure.savefig(path, dpi=90)


def main(fast=False, save=None):
    """Errors of the load [mm] by weight, the largest force [N] and angle [rad]; `fast` leaves out the limited plan."""
    mechanism, program = crane()
    plant = sv.plant(mechanism)
    front = sv.relaxed(plant, program, (0.0, 6.0), weight=WEIGHTS)
    print(front)
    plan = sv.relaxed(plant, program, (0.0, 6.0), weight=1e-8)
    print(plan)
    proof = sv.verify(plan)
    print(proof)
    errors = zip(front["weight"], 1e3 * front["largest X"], strict=True)
    numbers = {f"error [mm], weight {weight:g}": float(error) for weight, error in errors}
    numbers |= {"force [N]": float(front["largest cart"][-1]), "iterations": int(front["iterations"].max())}
    numbers |= {"angle [rad]": float(np.abs(plan["theta"]).max()), "verified": proof.passed}
    if not fast:
        limited = sv.relaxed(plant, program, (0.0, 6.0), weight=1e-8, limits={"cart": 100.0})
        print(limited)
        numbers["error within 100 N [mm]"] = float(1e3 * np.abs(limited.residual["X"]).max())
        if save:
            save_figure(front, {"without limits": plan, "within 100 N": limited}, save)
    return numbers


if __name__ == "__main__":
    for name, number in main(save=sys.argv[1] if len(sys.argv) > 1 else None).items():
        print(f"{name}: {number}")
