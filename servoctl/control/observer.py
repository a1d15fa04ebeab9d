"""Output feedback: a Kalman filter along the plan estimates what is not measured."""

import numpy as np

from servoctl.checks import finite, mapping
from servoctl.control.feedback import Residuals, estimating_law
from servoctl.control.law import Law
from servoctl.control.lqr import tangents, weights
from servoctl.control.sampling import discretised, spectral_radii
from servoctl.control.tracking import Reference, refuse_transport, require_plant
from servoctl.errors import ServoError, SpecificationError, unknown

POSITION_NOISE, VELOCITY_NOISE = 1e-3, 1.0  # per √s, of coordinates and velocities


def output_feedback(law, plant, noise, process=None):
    """The feedback of an LQR on a state that is estimated from some measured entries by a Kalman filter.

    At each sample the prediction of the state's deviation from the plan is corrected by the measurement, fed back, and
    predicted on by the plant linearised along the plan: δx⁺ = δx̂ + L (δy - C δx̂), u = u_ff - K δx⁺ - K_i z,
    δx̂ = A δx⁺ + B δu. The filter's covariance follows the discrete Riccati equation along the plan, from the steady
    solution at its start.

    Parameters
    ----------
    law : Law
        Made by `lqr` for the same plant.
    plant : Plant
        What the controller believes of the machine.
    noise : dict of str to float
        Standard deviation of the noise of each measured state, by name: only these are measured.
    process : float, dict of str to float, or (n_x,) or (n_x, n_x) array, optional
        Intensity of what disturbs each state: variance that it gathers per second; by name for those that differ from
        the defaults, 1e-6 for coordinates and 1 for velocities (unknown accelerations of about 1 m/s² or rad/s² that
        change within a second: model errors and gusts of cranes and arms).

    Returns
    -------
    Law

    Raises
    ------
    NameUnknown
        For noise of no state of the plant.
    SpecificationError
        If the law is no LQR's, or nothing is measured.
    ServoError
        If the measured states do not tell the others: a mode that they do not see does not decay.
    """
    _require_lqr(law, plant)
    measured, deviations = _measured(noise, plant)
    reference = Reference(law.plan, plant, law.rate)
    basis = tangents(reference)
    A, B = _onto(basis, *discretised(*reference.linearised(), reference.period))
    n_x, n = plant.n_x, len(plant.disturbable)
    default = np.zeros(n_x)
    default[: n_x - len(plant.lag)] = POSITION_NOISE**2
    default[n_x - len(plant.lag) - n : n_x - len(plant.lag)] = VELOCITY_NOISE**2
    W = weights(process, default, plant.state_names, "state", "process") * reference.period
    where = [plant.state_names.index(name) for name in measured]
    L = _filter(A, np.eye(n_x)[where], W, np.diag(deviations**2), basis)
    names = law.info["integrated"]
    residuals = Residuals(law.plan.model, plant, names) if names else None
    K = law.info["gains"]
    count, columns = len(reference.t), []
    for part in (K[:, :, :n_x], K[:, :, n_x:], L, A, B):  # row by row
        columns.append(part.reshape(count, -1).T)
    table = [reference.inputs(), reference.x, *columns]
    if residuals:
        table.append(np.tile(np.append(reference.period, residuals.parameters)[:, None], count))
    step = estimating_law(plant.state_names, where, len(plant.inputs), residuals)
    memory_names = (*(f"estimated error of {name}" for name in plant.state_names), *law.memory_names)
    errors = A @ (np.eye(n_x) - L @ np.eye(n_x)[where])
    errors = errors if basis is None else basis.swapaxes(1, 2) @ errors @ basis
    told = np.concatenate([B, np.zeros((count, len(names), B.shape[2]))], axis=1)
    facts = law.info | {"measured": measured, "memory from input": told}
    facts["spectral radius of the filter"] = float(spectral_radii(errors).max())
    return Law(
        f"{law.name}, output feedback", measured, plant.inputs, law.rate, law.t0, step, np.vstack(table),
        np.zeros(n_x + len(names)), memory_names, (), law.idle, law.plan, facts,
    )  # fmt: skip


def _require_lqr(law, plant):
    """Refuse a law that has no gains on the states of this plant."""
    require_plant(plant)
    info = getattr(law, "info", {})
    if "gains" not in info or "measured" in info or "slack of" in info:
        raise SpecificationError(
            f"The law {getattr(law, 'name', law)!r} is no LQR's on the state.",
            "Output feedback puts an estimate in the place of the state.",
            nearest="lqr(plan, plant, ...).",
            do="Give the law that lqr made.",
        )
    if law.info["states"] != plant.state_names:
        raise SpecificationError(
            f"The law has gains on {', '.join(law.info['states'])}.",
            f"The plant has the states {', '.join(plant.state_names)}.",
            do="Make law and estimator for the same plant, lagging actuators included.",
        )
    refuse_transport(plant, "The prediction is")


def _onto(basis, A, B):
    """A and B followed by the projection onto what material constraints allow at the next sample."""
    if basis is None:
        return A, B
    T = basis[np.minimum(np.arange(len(A)) + 1, len(A) - 1)]
    return T @ (T.swapaxes(1, 2) @ A), T @ (T.swapaxes(1, 2) @ B)


def _measured(noise, plant):
    found = {}
    for name, value in mapping(noise, "The noise").items():
        if name not in plant.state_names:
            raise unknown(name, plant.state_names, "state of the plant")
        found[name] = finite(name, value, "standard deviation")
        if found[name] <= 0:
            raise SpecificationError(
                f"The noise of {name!r} is {found[name]:g}.",
                "A filter weighs measurements by positive standard deviations.",
                do="Give the resolution of the sensor.",
                name=name,
            )
    if not found:
        raise SpecificationError(
            "No noise was given.",
            "The states whose noise is given are those that are measured.",
            nearest='{"x": 1e-3}.',
            do="Name the measured states.",
        )
    return tuple(found), np.array(list(found.values()))


def _filter(A, C, W, V, basis):
    """Gains L (N, n_x, n_y) of the filter along the plan, the covariance in the basis of each sample."""
    from scipy.linalg import solve_discrete_are

    count, n_x = len(A), A.shape[1]
    T = np.broadcast_to(np.eye(n_x), (count, n_x, n_x)) if basis is None else basis
    after = T[np.minimum(np.arange(count) + 1, count - 1)]
    moved, seen, gathered = after.swapaxes(1, 2) @ A @ T, C @ T, after.swapaxes(1, 2) @ W @ after
    try:
        P = solve_discrete_are((T[0].T @ A[0] @ T[0]).T, seen[0].T, T[0].T @ W @ T[0], V)
    except (np.linalg.LinAlgError, ValueError) as error:
        raise ServoError(
            f"The filter's Riccati equation has no stabilising solution ({error}).",
            "Each mode that does not decay by itself is seen by the measured states.",
            nearest="Measure the coordinates; velocities alone do not tell where a machine is.",
            do="Measure more states.",
        ) from error
    L = np.empty((count, n_x, len(C)))
    for k in range(count):
        S = seen[k] @ P @ seen[k].T + V
        gain = np.linalg.solve(S, seen[k] @ P).T
        L[k] = T[k] @ gain
        corrected = P - gain @ seen[k] @ P
        P = moved[k] @ corrected @ moved[k].T + gathered[k]
        P = (P + P.T) / 2
    return L
