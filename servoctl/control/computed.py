"""Computed actuation: exact linearisation of the program on the measured state, with error dynamics by poles."""

import numpy as np

from servoctl.checks import positive
from servoctl.control.law import Law
from servoctl.control.linearising import linearise
from servoctl.control.tracking import Reference, refuse_transport, require_plan
from servoctl.errors import SpecificationError, UnstableInternalDynamics, unknown
from servoctl.internal_dynamics import internal_dynamics
from servoctl.methods.stability import sampled_bound
from servoctl.reduction.knots import require_smooth

GROWN = 2.0  # by how much errors may grow along the plan, as by a passing eigenvalue that is hardly unstable
TIME_CONSTANT = 0.25  # s: a rise in about a second where several poles coincide, as cranes and arms of human size need


def computed(plan, plant, rate=100.0, poles=None, delay=0):
    """The actuation that the plant's own equations ask for at the measured state, with error dynamics by poles.

    Each residual obeys Π(D - λ_i) φ = 0 as long as the machine is the plant: φ is differentiated along the plant until
    the inputs decouple, through dynamic extension where their decoupling matrix has no full rank. Between samples the
    inputs are held, from `delay` samples after the measurement on: by how much the plan's actuation changes until the
    middle of that time is added.

    Parameters
    ----------
    plan : Run
        Ranks are decided about its states.
    plant : Plant
        What the controller believes of the machine, of the plan's mechanism, without transport delay.
    rate : float
        Samples per second [Hz].
    poles : float or dict of str to sequence of complex, optional
        One time constant T [s] (all poles at -1/T), default 0.25 s, or the poles [1/s] of each residual, as many as its
        relative degree with the extension (`law.info["orders"]`).
    delay : int
        Samples by which the loop will be late: the plan's actuation is taken as much ahead, and the poles are checked
        for it.

    Returns
    -------
    Law

    Raises
    ------
    UnstableInternalDynamics
        If what the program leaves free is unstable along the plan: linearisation would hide it, not stabilise it.
    SpecificationError
        If the sampled error dynamics are unstable with these poles at this rate, poles are of another number, or a path
        is not smooth enough: a lagging actuator's command holds one derivative more than the plan's actuation.
    NotRealisable
        If a residual depends on no input.
    """
    rate = positive("rate", rate)
    require_plan(plan, plant)
    refuse_transport(plant, "The linearisation is")
    if isinstance(delay, bool) or not isinstance(delay, (int, np.integer)) or delay < 0:
        raise SpecificationError(
            f"delay={delay!r} was given.", "A delay is a whole number of samples, at least 0.", do="Give one."
        )
    _require_stable(plan)
    found = linearise(plan, plant)
    reduction = plan.model.reduction
    if reduction.timed and any(order > reduction.needs.get(name, 0) for name, order in found.orders.items()):
        require_smooth(reduction.switches, plan.model.parameters, found.orders, (plan.t[0], plan.t[-1]))
    poles = _poles(poles, found.orders)
    for name, values in poles.items():
        _require_slow(name, values, rate, delay)
    coefficients = [np.poly(values).real[:0:-1] for values in poles.values() if len(values)]
    reference, count = Reference(plan, plant, rate), len(found.memory_names)
    ahead = reference.ahead(delay)
    rows = ([plant.parameters, [1.0 / rate], u, *coefficients] for u in ahead.T)
    table = np.column_stack([np.concatenate(row) for row in rows])
    idle = np.array([plan[name][0] for name in plant.inputs])
    facts = {"orders": found.orders, "relative degree": found.relative_degree, "poles": poles}
    facts["error dynamics"] = ", ".join(f"{name} of order {order}" for name, order in found.orders.items())
    return Law(
        "computed", plant.state_names, plant.inputs, rate, float(plan.t[0]), found.step, table,
        np.zeros(count), found.memory_names, (), idle, plan, facts,
    )  # fmt: skip


def _require_stable(plan):
    internal = internal_dynamics(plan.model, plan)
    if internal.verdict == "unstable" and internal.growth > GROWN:
        worst = float(internal.eigenvalues.real.max())
        raise UnstableInternalDynamics(
            f"The program leaves {len(internal.names)} states free ({', '.join(internal.names)}), with an eigenvalue "
            f"of {worst:.6g} 1/s along the plan.",
            "Exact linearisation makes them unobservable and does not stabilise them.",
            nearest="lqr(plan, plant, rate=...), which stabilises the whole state about the plan.",
            do="Use it, or choose another output.",
            eigenvalue=worst,
            states=internal.names,
        )


def _poles(poles, orders):
    """Poles of each residual by name."""
    if poles is None or np.ndim(poles) == 0 and not isinstance(poles, dict):
        constant = TIME_CONSTANT if poles is None else positive("time constant", poles)
        return {name: np.full(order, -1.0 / constant) for name, order in orders.items()}
    if not isinstance(poles, dict):
        raise SpecificationError(
            f"poles={poles!r} was given.",
            "Poles are one time constant, or go by residual.",
            nearest="{" + ", ".join(f"{name!r}: {order} poles" for name, order in orders.items()) + "}.",
            do="Give a dict.",
        )
    for name in poles:
        if name not in orders:
            raise unknown(name, orders, "residual")
    found = {}
    for name, order in orders.items():
        try:
            values = np.atleast_1d(poles.get(name, ())).astype(complex)
        except (TypeError, ValueError):
            values = np.full(order, np.nan)
        if values.shape != (order,) or not np.isfinite(values).all() or not _paired(values):
            raise SpecificationError(
                f"The poles of {name!r} are {poles.get(name)!r}.",
                f"Its error dynamics have order {order}: as many poles, complex ones in conjugate pairs.",
                nearest=f"{[-4.0] * order}.",
                do="Give them.",
                name=name,
                order=order,
            )
        found[name] = values
    return found


def _paired(poles):
    """Whether complex poles come in conjugate pairs."""
    return np.allclose(np.sort_complex(poles), np.sort_complex(poles.conj()), rtol=1e-9, atol=0)


def _require_slow(name, poles, rate, delay):
    """Refuse poles whose error dynamics are unstable under a zero-order hold."""
    order = len(poles)
    if np.any(poles.real >= 0):
        raise SpecificationError(
            f"The poles of {name!r} are {poles}.",
            "Error dynamics decay where each pole has a negative real part.",
            nearest=f"{[-4.0] * order}.",
            do="Change the sign.",
            name=name,
        )
    radius = sampled_radius(poles, rate, delay) if order else 0.0
    if not radius < 1.0:
        fastest, bound = float(np.abs(poles).max()), sampled_bound(order, delay)
        late = f" with {delay} samples of delay" if delay else ""
        raise SpecificationError(
            f"The fastest pole of {name!r}, {fastest:.4g} 1/s, is sampled at {rate:g} Hz{late}: |p| Ts = "
            f"{fastest / rate:.4g}, and the held feedback multiplies errors by {radius:.4g} each sample.",
            f"{order} equal poles -p are stable under a zero-order hold{late} for p Ts < {bound:.4f}.",
            nearest=f"Poles slower than {bound * rate:.4g} 1/s, or a rate above {fastest / bound:.4g} Hz.",
            do="Change one of them.",
            name=name,
            bound=bound,
            radius=radius,
        )


def sampled_radius(poles, rate, delay=0):
    """The largest factor per sample of a chain of integrators whose poles are placed by held feedback.

    Parameters
    ----------
    poles : (ρ,) array of complex
        [1/s]
    rate : float
        [Hz]
    delay : int
        Samples.

    Returns
    -------
    float
    """
    from math import factorial

    order, h = len(poles), 1.0 / rate
    n = order + delay
    A = np.zeros((n, n))
    for i in range(order):
        for j in range(i, order):
            A[i, j] = h ** (j - i) / factorial(j - i)
    B = np.array([h ** (order - i) / factorial(order - i) for i in range(order)])
    K = np.poly(poles).real[:0:-1]
    if delay:
        A[:order, order] = B
        A[range(order, n - 1), range(order + 1, n)] = 1.0
        A[n - 1, :order] = -K
    else:
        A -= np.outer(B, K)
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))
