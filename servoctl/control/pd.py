"""Proportional and derivative feedback of the actuated displacements about a plan."""

import numpy as np

from servoctl.checks import numbers_by_name
from servoctl.control.feedback import affine
from servoctl.control.reference import Reference
from servoctl.control.sampling import sampled_radii
from servoctl.errors import ServoError

UNSTABLE = 1e-9  # beyond 1: spectral radii that count as unstable


def pd(plan, plant, rate=100.0, kp=None, kd=None):
    """The plan's actuation, and feedback of each actuator's own displacement and speed about the plan.

    u_a = u_plan - kp_a e_a - kd_a de_a/dt with e_a = E_aᵀ(γ - γ_plan): the error of the displacement that the actuator
    works on.

    Parameters
    ----------
    plan : Run
    plant : Plant
        What the controller believes of the machine.
    rate : float
        Samples per second [Hz].
    kp, kd : dict of str to float
        Gains by actuator: input per displacement and per speed.

    Returns
    -------
    Law
        Its info holds the largest spectral radius of the sampled error dynamics along the plan.

    Raises
    ------
    NameUnknown
        For a gain of no actuator.
    ServoError
        If the rate is too low for the gains: the last sample's error dynamics are unstable, and were not at a higher
        rate.
    """
    reference = Reference(plan, plant, rate)
    kp, kd = _gains(kp, plant, "kp"), _gains(kd, plant, "kd")
    K = _feedback(reference, kp, kd)
    A, B = reference.linearised()
    radii = sampled_radii(A, B, K, reference.period, _delays(plant))
    _refuse_slow_rate(reference, A[-1:], B[-1:], K[-1:], radii[-1])
    info = {"largest spectral radius along the plan": float(radii.max())}
    return affine(f"pd, kp {_named(kp, plant)}, kd {_named(kd, plant)}", reference, K, info=info)


def _feedback(reference, kp, kd):
    """K (N, m, n_x) of kp e + kd de/dt: δq becomes δγ by the pseudo-inverse of V in q' = V γ', and e = Eᵀ δγ."""
    plant = reference.plant
    nq, n, m = len(plant.mechanism.q.names), len(plant.disturbable), len(plant.inputs)
    both = plant.function("directions").grid(reference.t, reference.x, plant.p(reference.middle_input))
    E, V = both[: n * m].reshape(m, n, -1).transpose(2, 0, 1), both[n * m :].reshape(n, nq, -1).transpose(2, 1, 0)
    K = np.zeros((len(reference.t), m, plant.n_x))
    K[:, :, :nq] = kp[:, None] * (E @ np.linalg.pinv(V))
    K[:, :, nq : nq + n] = kd[:, None] * E
    return K


def _gains(gains, plant, what):
    """The gains in the order of the actuators, (m,), 0 for those without."""
    gains = numbers_by_name(gains, plant.inputs, "actuator", f"gain {what}")
    return np.array([gains.get(name, 0.0) for name in plant.inputs])


def _named(gains, plant):
    return " ".join(f"{name}={k:g}" for name, k in zip(plant.inputs, gains, strict=True) if k) or "none"


def _delays(plant):
    return np.array([plant.delay.get(name, 0.0) for name in plant.inputs])


def _refuse_slow_rate(reference, A, B, K, radius):
    """Refuse gains that are unstable as sampled and delayed, at the plan's end, where they were not otherwise."""
    delays = _delays(reference.plant)
    if radius <= 1 + UNSTABLE:
        return
    if sampled_radii(A, B, K, reference.period, 0 * delays)[0] <= 1 + UNSTABLE:
        raise ServoError(
            f"With the transport delay of {delays.max():g} s errors grow by the factor {radius:.4g} per sample at the "
            "plan's end.",
            "A delay of d samples lowers the bound of poles: p·Ts < 0.4262 for ρ = 2 and d = 1.",
            do="Choose lower gains, for poles well below one over the delay.",
            radius=float(radius),
        )
    growth = max(0.0, float(np.linalg.eigvals(A[0] - B[0] @ K[0]).real.max()))
    if np.log(radius) > 2 * growth * reference.period + UNSTABLE:  # what is unstable without sampling, is so with it
        raise ServoError(
            f"Sampled at {reference.rate:g} Hz, errors grow by the factor {radius:.4g} per sample at the plan's end.",
            "Under a zero-order hold ρ equal poles -p are stable for p·Ts < 1, 0.6752, 0.5111, 0.4116: ρ = 2 to 5.",
            do="Choose a higher rate, or gains for poles well below the rate.",
            radius=float(radius),
        )
