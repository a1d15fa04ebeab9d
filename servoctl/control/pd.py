"""Proportional and derivative feedback of the actuated displacements about a plan."""

from collections.abc import Mapping

import numpy as np

from servoctl.checks import numbers_by_name
from servoctl.control.feedback import affine
from servoctl.control.law import Law
from servoctl.control.reference import Reference, of_plan
from servoctl.control.sampling import sampled_radii
from servoctl.errors import ServoError
from servoctl.plants.plant import Plant
from servoctl.run import Run

UNSTABLE = 1e-7  # a spectral radius above 1 by more than this is unstable; rounding moves two integrators by 1e-8


def pd(
    plan: Run,
    plant: Plant,
    rate: float = 100.0,
    kp: Mapping[str, float] | None = None,
    kd: Mapping[str, float] | None = None,
) -> Law:
    """The plan's actuation, with feedback of the error of each actuator's displacement and its rate.

    u_a = u_plan - kp_a e_a - kd_a de_a/dt with e_a = E_aᵀ(γ - γ_plan), the displacement on which the actuator works.

    Parameters
    ----------
    plan : Run
    plant : Plant
        The controller's model of the machine.
    rate : float
        Samples per second [Hz].
    kp, kd : dict of str to float
        Gains by actuator: input per displacement and per speed.

    Returns
    -------
    Law
        `info` has the largest spectral radius of the sampled error dynamics along the plan.

    Raises
    ------
    NameUnknown
        For a gain of an unknown actuator.
    ServoError
        If the rate is too low for the gains: the error dynamics at the plan's end are unstable, and would not be at a
        higher rate.
    """
    plant = of_plan(plan, plant)
    reference = Reference(plan, plant, rate)
    kp, kd = _gains(kp, plant, "kp"), _gains(kd, plant, "kd")
    K = _feedback(reference, kp, kd)
    A, B = reference.linearised()
    delays = np.array([plant.delay.get(name, 0.0) for name in plant.inputs])
    radii = sampled_radii(A, B, K, reference.period, delays)
    _refuse_slow_rate(reference, A[-1:], B[-1:], K[-1:], radii[-1], delays)
    info = {"largest spectral radius along the plan": float(radii.max())}
    return affine(f"pd, kp {_named(kp, plant)}, kd {_named(kd, plant)}", reference, K, info=info)


def _feedback(reference, kp, kd):
    """K (N, m, n_x) of kp e + kd de/dt with e = Eᵀ δγ, where δγ = V⁺ δq from q' = V γ'."""
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


def _refuse_slow_rate(reference, A, B, K, radius, delays):
    """Refuse gains that only sampling or delay makes unstable at the plan's end."""
    if radius <= 1 + UNSTABLE:
        return
    if delays.any() and sampled_radii(A, B, K, reference.period, 0 * delays)[0] <= 1 + UNSTABLE:
        raise ServoError(
            f"With the transport delay of {delays.max():g} s errors grow by the factor {radius:.4g} per sample at the "
            "plan's end.",
            "A delay of d samples lowers the bound of poles: p·Ts < 0.4262 for ρ = 2 and d = 1.",
            do="Choose lower gains, for poles well below one over the delay.",
            radius=float(radius),
            delay=float(delays.max()),
            rate=reference.rate,
        )
    # gains that are unstable without sampling, too, are the designer's choice
    growth = max(0.0, float(np.linalg.eigvals(A[0] - B[0] @ K[0]).real.max()))
    if np.log(radius) > 2 * growth * reference.period + UNSTABLE:
        raise ServoError(
            f"Sampled at {reference.rate:g} Hz, errors grow by the factor {radius:.4g} per sample at the plan's end.",
            "Under a zero-order hold ρ equal poles -p are stable for p·Ts < 1, 0.6752, 0.5111, 0.4116: ρ = 2 to 5.",
            do="Choose a higher rate, or gains for poles well below the rate.",
            radius=float(radius),
            rate=reference.rate,
        )
