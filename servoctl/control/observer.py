"""Output feedback: a Kalman filter along the plan estimates the state from some measured entries."""

from collections.abc import Mapping
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import numbers_by_name
from servoctl.codegen.matrices import riccati
from servoctl.control.feedback import integral_names, integrating, integration, law_step
from servoctl.control.law import Law
from servoctl.control.lqr import by_level, reduced, tangents, weights
from servoctl.control.reference import Reference, of_plan, refuse_transport, require_plant
from servoctl.control.residuals import Residuals
from servoctl.control.sampling import discretised, spectral_radii
from servoctl.errors import ServoError, SpecificationError
from servoctl.plants.plant import Plant
from servoctl.values import Deferred

FILTER_RADIUS = "spectral radius of the filter"
POSITION_NOISE, VELOCITY_NOISE = 1e-3, 1.0  # per √s, of coordinates and velocities


def estimating_law(states, where, n_u, residuals=None):
    """The step of affine feedback on an estimated state.

    δx⁺ = δx̂ + L (y - y_ref - C δx̂),  u = u_ff - K δx⁺ - K_i z,  δx̂+ = A δx⁺ + B δu,  z+ = z + Ts φ(t, x_ref + δx⁺).

    Columns of the schedule are [u_ff; x_ref; K, K_i, L, A, B row by row; Ts; parameters of φ]. `states` are those of
    the plant, `where` the indices of the measured ones; z integrates the residuals φ.
    """
    n_x, n_y, n_z = len(states), len(where), len(residuals.names) if residuals else 0
    t, y, estimate, z = (ca.SX.sym("t"), *(ca.SX.sym(s, n) for s, n in (("y", n_y), ("e", n_x), ("z", n_z))))
    u_ff, x_ref = ca.SX.sym("u_ff", n_u), ca.SX.sym("x_ref", n_x)
    shapes = {"K": (n_u, n_x), "K_i": (n_u, n_z), "L": (n_x, n_y), "A": (n_x, n_x), "B": (n_x, n_u)}
    symbols = {name: ca.SX.sym(name, columns, rows) for name, (rows, columns) in shapes.items()}  # transposed
    K, K_i, L, A, B = (matrix.T for matrix in symbols.values())
    corrected = estimate + L @ (y - x_ref[where] - estimate[where])
    du = -K @ corrected - K_i @ z
    further, z_next = integrating(residuals, t, x_ref + corrected, states, z)
    column = ca.vertcat(u_ff, x_ref, *map(ca.vec, symbols.values()), *further)
    outputs = [u_ff + du, A @ corrected + B @ du, *z_next]
    return law_step("estimating", t, ca.vertcat(y, estimate, z), column, outputs)


def output_feedback(
    law: Law,
    plant: Plant,
    noise: Mapping[str, float],
    process: ArrayLike | Mapping[str, float] | None = None,
) -> Law:
    """The feedback of an LQR on a state that a Kalman filter estimates from some measured entries.

    At each sample the measurement corrects the predicted deviation from the plan, the gains act on it, and the plant
    linearised along the plan predicts the next one: δx⁺ = δx̂ + L (δy - C δx̂), u = u_ff - K δx⁺ - K_i z,
    δx̂ = A δx⁺ + B δu. The filter's covariance follows the discrete Riccati equation along the plan, from the steady
    solution at its start.

    Parameters
    ----------
    law : Law
        Made by `lqr` for the same plant.
    plant : Plant
        The controller's model of the machine.
    noise : dict of str to float
        Standard deviation of the measurement noise by measured state. Other states are not measured.
    process : float, dict of str to float, or (n_x,) or (n_x, n_x) array, optional
        Intensity of the process noise: variance that each state gathers per second, by name for some of them. Default:
        1e-6 for coordinates and 1 for velocities, i.e. unknown accelerations of about 1 m/s² or rad/s² that change
        within a second, as by model errors and gusts of cranes and arms.

    Returns
    -------
    Law

    Raises
    ------
    NameUnknown
        For noise of an unknown state.
    SpecificationError
        If the law is not made by `lqr`, or nothing is measured.
    ServoError
        If a mode that the measured states do not see does not decay.
    """
    plant = of_plan(getattr(law, "plan", None), plant)
    _require_lqr(law, plant)
    measured, deviations = _deviations(noise, plant)
    reference, gains = Reference(law.plan, plant, law.rate), law.feedback
    basis = tangents(reference)
    after = basis[np.minimum(np.arange(len(basis)) + 1, len(basis) - 1)]  # at the next sample
    A, B = (after @ (after.swapaxes(1, 2) @ X) for X in discretised(*reference.linearised(), reference.period))
    n_x, n_z = plant.n_x, len(gains.residuals)
    intensity = by_level(plant, POSITION_NOISE**2, VELOCITY_NOISE**2)
    W = weights(process, intensity, plant.state_names, "state", "process") * reference.period
    where = [plant.state_names.index(name) for name in measured]
    C = np.eye(n_x)[where]
    L = _filter(A, C, W, np.diag(deviations**2), basis, after)
    residuals = Residuals(law.plan.model, plant, gains.residuals) if n_z else None
    schedule = [reference.inputs(), reference.x]
    schedule += [part.reshape(len(A), -1).T for part in (gains.K, gains.K_i, L, A, B)]  # row by row
    schedule += [integration(reference, residuals)] if residuals else []
    input_matrix = np.concatenate([B, np.zeros((len(B), n_z, B.shape[2]))], axis=1)
    return Law(
        name=f"{law.name}, output feedback",
        measures=measured,
        inputs=plant.inputs,
        rate=law.rate,
        t0=law.t0,
        step=estimating_law(plant.state_names, where, len(plant.inputs), residuals),
        schedule=np.vstack(schedule),
        state=np.zeros(n_x + n_z),
        initial_input=law.initial_input,
        plan=law.plan,
        state_names=(*(f"estimated error of {name}" for name in plant.state_names), *integral_names(gains.residuals)),
        info=Deferred({}, (*law.info.keys(), FILTER_RADIUS), partial(_info, law, A, L @ C, basis)),
        integrators=tuple(range(n_x, n_x + n_z)),
        feedback=gains,
        input_matrix=input_matrix,
    )


def _info(law, A, LC, basis):
    """The results of a law's design, and the largest spectral radius of the filter's errors."""
    errors = reduced(A @ (np.eye(A.shape[1]) - LC), basis)
    return law.info | {FILTER_RADIUS: float(spectral_radii(errors).max())}


def _require_lqr(law, plant):
    """Refuse a law without gains on the states of this plant, or with an estimator or an allocation."""
    require_plant(plant)
    if not isinstance(law, Law) or law.feedback is None or law.input_matrix is not None or law.allocation:
        raise SpecificationError(
            f"The law {getattr(law, 'name', law)!r} has no feedback of the measured state.",
            "Output feedback applies the gains of an LQR to an estimated state.",
            do="Pass the law of sv.lqr.",
            name=getattr(law, "name", None),
        )
    if law.feedback.states != plant.state_names:
        raise SpecificationError(
            f"The law has gains on {', '.join(law.feedback.states)}.",
            f"The plant has the states {', '.join(plant.state_names)}.",
            do="Design law and estimator for the same plant, lagging actuators included.",
            states=law.feedback.states,
            valid=plant.state_names,
        )
    refuse_transport(plant, "The prediction is")


def _deviations(noise, plant):
    """Names of the measured states, and the standard deviations of their noise, (n_y,)."""
    deviations = numbers_by_name(noise, plant.state_names, "state of the plant", "standard deviation", positive=True)
    if not deviations:
        raise SpecificationError(
            "No state has a noise.",
            "States with a standard deviation are measured, no others.",
            do='Name the measured states: noise={"x": 1e-3}.',
            names=plant.state_names,
        )
    return tuple(deviations), np.array(list(deviations.values()))


def _filter(A, C, W, V, basis, after):
    """Gains L (N, n_x, n_y) of the filter along the plan; covariances are in the basis of each sample."""
    from scipy.linalg import solve_discrete_are

    moved, seen, gathered = after.swapaxes(1, 2) @ A @ basis, C @ basis, reduced(W, after)
    A_0, W_0 = (basis[0].T @ part @ basis[0] for part in (A[0], W))
    try:
        P = solve_discrete_are(A_0.T, seen[0].T, W_0, V)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ServoError(
            f"The filter's Riccati equation has no stabilising solution ({error}).",
            "The measured states must see each mode that does not decay.",
            do="Measure more states; velocities alone do not determine the position.",
            measured=len(C),
        ) from error
    gains, _, _ = riccati(moved.swapaxes(1, 2), seen.swapaxes(1, 2), gathered, V, P, of_state=False)
    return basis @ gains.swapaxes(1, 2)
