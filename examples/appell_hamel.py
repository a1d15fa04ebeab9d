"""Appell-Hamel mechanism under the linear form of its program, ideal realisation (Emami et al., section 4)."""

import casadi as ca

import servoctl as sv

p = sv.parameters(m=1.0, M=2.0, I_x=0.2, I_y=0.25, a=0.5, b=0.2, rho=0.3, g=9.81)  # kg, kg m^2, m, m/s^2
q = sv.coordinates("x y z phi theta")  # m, m, m (down), rad, rad
x, y, z, phi, theta = q
dx, dy, dz, dphi, dtheta = q.d(1)
ddx, ddy, ddz, ddphi, ddtheta = q.d(2)

S = (p.m * (ddx**2 + ddy**2 + ddz**2) + (p.I_y + p.a**2 * p.M) * ddphi**2 + p.I_x * ddtheta**2) / 2  # (4.7)
mechanism = sv.Mechanism(q, gibbs=S, potential=-p.m * p.g * z, parameters=p)
program = sv.Program(
    {
        "x_c": dx - p.a * dphi * ca.cos(theta) + p.rho * dtheta * ca.sin(theta),  # (4.1), (4.2)
        "y_c": dy - p.a * dphi * ca.sin(theta) - p.rho * dtheta * ca.cos(theta),
        "string": z + p.b * phi,  # (4.5)
    },
    by="ideal",
)


def main(fast=False):
    """State after 2 s, and how well the full mechanism agrees; `fast` checks fewer segments of the run."""
    model = sv.derive(mechanism, program)  # (3.18)
    print(model)
    run = sv.simulate(model, model.start(dphi=1.0, dtheta=2.0), (0.0, 2.0))
    print(run)
    proof = sv.verify(run, segments=3 if fast else 20)
    print(proof)
    names = ("x", "y", "z", "phi", "theta", "dphi", "dtheta")
    energy = run["energy"]
    return {
        "free": model.free,
        **{name: float(run[name][-1]) for name in names},
        "energy drift": float(abs(energy - energy[0]).max()),
        "verified": proof.passed,
    }


if __name__ == "__main__":
    for name, number in main().items():
        print(f"{name}: {number}")
