"""Feedforward: the plan's actuation alone."""

import casadi as ca

from servoctl.control.feedback import law_step
from servoctl.control.law import Law
from servoctl.control.reference import Reference, of_plan
from servoctl.plants.plant import Plant
from servoctl.run import Run


def feedforward(plan: Run, plant: Plant, rate: float = 100.0) -> Law:
    """The plan's actuation in the middle of each sample, held over it; no feedback.

    The error of the hold is then of second order in the period. An actuator's lag T is inverted, u + T du/dt, and its
    transport delay is compensated by earlier commands.

    Parameters
    ----------
    plan : Run
        With its model, by="actuators".
    plant : Plant
        The controller's model of the machine.
    rate : float
        Samples per second [Hz]; default 100, a usual rate of industrial drives.

    Returns
    -------
    Law
    """
    plant = of_plan(plan, plant)
    reference = Reference(plan, plant, rate)
    u_ff = ca.SX.sym("u_ff", len(plant.inputs))
    return Law(
        name="feedforward",
        measures=(),
        inputs=plant.inputs,
        rate=reference.rate,
        t0=reference.t[0],
        step=law_step("feedforward", ca.SX.sym("t"), ca.SX.sym("x", 0), u_ff, [u_ff]),
        schedule=reference.inputs(),
        initial_input=reference.initial_input,
        plan=plan,
    )
