"""Feedforward: the plan's actuation alone."""

from servoctl.control.feedback import affine_law
from servoctl.control.law import Law
from servoctl.control.reference import Reference


def feedforward(plan, plant, rate=100.0):
    """The plan's actuation in the middle of each sample, held over it; no feedback.

    The error of the hold is then of second order in the period. An actuator's lag T is inverted, u + T du/dt, and its
    transport delay is met by commanding earlier.

    Parameters
    ----------
    plan : Run
        With its model, by="actuators".
    plant : Plant
        What the controller believes of the machine.
    rate : float
        Samples per second [Hz]; default 100, a usual rate of industrial drives.

    Returns
    -------
    Law
    """
    reference = Reference(plan, plant, rate)
    return Law(
        name="feedforward", measures=(), inputs=plant.inputs, rate=reference.rate, t0=reference.t[0],
        step=affine_law((), len(plant.inputs), feedback=False), schedule=reference.inputs(), idle=reference.idle,
        plan=plan,
    )  # fmt: skip
