"""LQR about a plan: time-varying by the discrete Riccati equation along it, or frozen at each instant."""

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from servoctl.checks import as_numbers, numbers_by_name, rows_read
from servoctl.codegen.matrices import riccati
from servoctl.control.feedback import StateFeedback, affine, integral_names
from servoctl.control.law import Law
from servoctl.control.reference import Reference, of_plan, refuse_transport
from servoctl.control.residuals import Residuals, program_residuals
from servoctl.control.sampling import discretised, spectral_radii
from servoctl.errors import ServoError, SpecificationError
from servoctl.plants.plant import Plant
from servoctl.run import Run
from servoctl.values import Deferred, evenly

MARGINAL = 1 + 1e-6  # spectral radius up to which a mode that no input reaches neither decays nor grows
DECAYS = 1e-9  # how far below 1 the spectral radius under a steady gain is: nearer it is a neutral mode's rounding
UNREACHED = 1e-7  # product of a mode with the inputs' directions, each of size 1, below which no input reaches it
NAMED = 0.05  # share of a state in a mode, of the largest, above which an error names it
COMPARED = 8  # samples along the plan at which a combination of states must be conserved
DOUBLINGS, CONVERGED = 60, 1e-12  # of the horizon of the Riccati equation; relative change at convergence
LARGEST_RADIUS, LAST_RADIUS = "largest spectral radius along the plan", "spectral radius at its end"
Q_POSITION, Q_VELOCITY, R_INPUT, Q_INTEGRAL = 1e3, 1e2, 1e-3, 1e4  # weights by default, in SI units


def lqr(
    plan: Run,
    plant: Plant,
    rate: float = 100.0,
    Q: ArrayLike | Mapping[str, float] | None = None,
    R: ArrayLike | Mapping[str, float] | None = None,
    integral: bool | ArrayLike | Mapping[str, float] | None = None,
    varying: bool = True,
) -> Law:
    """The plan's actuation with sampled linear-quadratic feedback about the plan.

    The plant is linearised along the plan in the middle of each sample and discretised exactly under the zero-order
    hold. The gains minimise Σ δxᵀQ δx + δuᵀR δu + zᵀQ_i z over the samples. Time-varying gains come from the Riccati
    equation backwards along the plan, from the steady solution at its end; frozen-time gains from the steady solution
    at each sample. Frozen-time gains depend on the choice of coordinates where the plan moves: linearisations in two of
    them differ by a transformation that varies in time. The design does not include the delay of `close`; a larger R
    makes room for it.

    Parameters
    ----------
    plan : Run
        With its model, by="actuators".
    plant : Plant
        The controller's model of the machine, without transport delay.
    rate : float
        Samples per second [Hz].
    Q : float, dict of str to float, or (n_x,) or (n_x, n_x) array, optional
        Weights of the states, by name for some of them. Default: 1e3 for coordinates, 1e2 for velocities, 0 for lagged
        inputs. With the default R an error of 3 cm then costs as much as 0.1 m/s, 0.1 rad/s or 30 N, which suits
        machines of metres and kilonewtons.
    R : float, dict of str to float, or (m,) or (m, m) array, optional
        Weights of the inputs; default 1e-3.
    integral : bool, float, dict of str to float, or (k,) array, optional
        Weights of the integrals of the program's residuals, by residual; they remove the error that a constant mismatch
        or disturbance leaves. True: 1e4 each, so that an error of 3 mm that lasts for 1 s costs as much as 1 cm of
        error. Of an output of the mechanism, a state, or F of a residual of order 3 or more that is a derivative of F,
        the deviation from its value along the plan is integrated; a residual with the name of one is NAME_residual.
        Default: none.
    varying : bool
        False: frozen-time gains.

    Returns
    -------
    Law
        `info` has "gains" (N, m, n_x + k) on "states" and integrals, the spectral radii of the sampled error dynamics,
        Q and R.

    Raises
    ------
    NameUnknown
        For a weight of an unknown state, input, residual or output, and if plan and plant have different names.
    SpecificationError
        For weights of a wrong shape, or not (semi)definite.
    ServoError
        If no input reaches, or no weight sees, an unstable mode; with frozen-time gains, also a marginal one.
    """
    if not isinstance(varying, (bool, np.bool_)):
        raise SpecificationError(
            f"varying={varying!r} was given.", "It is True (along the plan) or False (frozen time).", value=varying
        )
    plant = of_plan(plan, plant)
    reference = Reference(plan, plant, rate)
    refuse_transport(plant, "The design is")
    Q = weights(Q, by_level(plant, Q_POSITION, Q_VELOCITY), plant.state_names, "state", "Q")
    R = weights(R, np.full(len(plant.inputs), R_INPUT), plant.inputs, "actuator", "R", positive=True)
    residuals, Q_i = _integrals(integral, plan, plant)
    A, B = discretised(*reference.linearised(), reference.period)
    augmented = _with_integrals(A, B, Q, residuals, Q_i, reference) if residuals else (A, B, Q)
    integrated = residuals.names if residuals else ()
    basis = tangents(reference, len(integrated))
    names = (*plant.state_names, *integral_names(integrated))
    try:
        K = _varying(*augmented, R, basis) if varying else steady(*augmented, R, basis)[0]
    except ServoError as error:
        raise _explained(error, augmented, basis, names, plant, varying) from None
    K_x, K_i = np.split(K, [plant.n_x], axis=2)
    how = f"lqr, {'time-varying' if varying else 'frozen-time'}" + (", with integrals" if residuals else "")
    known = {"gains": K, "Q": augmented[2], "R": R, "integrated": integrated, "states": plant.state_names}
    info = Deferred(known, (LARGEST_RADIUS, LAST_RADIUS), partial(_radii, augmented[:2], K, basis))
    law = affine(how, reference, K_x, K_i, residuals, info)
    return replace(law, feedback=StateFeedback(plant.state_names, integrated, K_x, K_i))


def _radii(plant, K, basis):
    """The largest and the last spectral radius of the sampled error dynamics; an eigenvalue problem at each sample."""
    A, B = plant
    radii = spectral_radii(reduced(A - B @ K, basis))
    return {LARGEST_RADIUS: float(radii.max()), LAST_RADIUS: float(radii[-1])}


def by_level(plant, of_coordinates, of_velocities):
    """A diagonal for the states: a number for coordinates, one for velocities, and 0 for lagged inputs."""
    q, diagonal = plant.mechanism.q, np.zeros(plant.n_x)
    diagonal[: q.nq + q.n] = [of_coordinates] * q.nq + [of_velocities] * q.n
    return diagonal


def _with_integrals(A, B, Q, residuals, Q_i, reference):
    """The plant with z+ = z + Ts φ, φ = C δx among its states."""
    (count, n, m), k = B.shape, len(Q_i)
    both, inputs, weight = np.zeros((count, n + k, n + k)), np.zeros((count, n + k, m)), np.zeros((n + k, n + k))
    both[:, :n, :n], inputs[:, :n], weight[:n, :n], weight[n:, n:] = A, B, Q, Q_i
    both[:, n:, :n] = reference.period * residuals.jacobian(reference.t, reference.x)
    both[:, n:, n:] = np.eye(k)
    return both, inputs, weight


def tangents(reference, extra=0):
    """Orthonormal bases of the tangent spaces of material constraints, (N, n, r); the identity without any."""
    plant, count = reference.plant, len(reference.t)
    T = np.eye(plant.n_x)
    if plant.constrained:
        y = plant.function("constraints_jacobian").grid(reference.t, reference.x, plant.p())
        J = y.reshape(plant.n_x, -1, count).transpose(2, 1, 0)
        rank = int(np.linalg.matrix_rank(J[0], tol=1e-9 * np.abs(J[0]).max()))
        T = np.linalg.svd(J)[2][:, rank:].transpose(0, 2, 1)
    n, r = T.shape[-2:]
    bases = np.zeros((count, n + extra, r + extra))
    bases[:, :n, :r], bases[:, n:, r:] = T, np.eye(extra)
    return bases


def reduced(A, T):
    """TᵀAT: error dynamics on the tangent spaces."""
    return T.swapaxes(1, 2) @ A @ T


def steady(A, B, Q, R, T):
    """K (N, m, n) of the steady Riccati equation at each sample, and the last P (n, n).

    The structure-preserving doubling algorithm (Chu, Fan, Lin, Wang 2004) for all samples at once: step k is the
    solution of a horizon of 2^k samples. A, B are (N, n, n), (N, n, m); Q, R are (n, n), (m, m); bases T of the
    tangent spaces are (N, n, r).
    """
    left = T.swapaxes(1, 2)
    A, B, eye = left @ A @ T, left @ B, np.eye(T.shape[2])
    a, G, P = A, B @ np.linalg.solve(R, B.swapaxes(1, 2)), np.broadcast_to(left @ Q @ T, A.shape)
    radii = np.full(1, np.inf)
    with np.errstate(all="ignore"), contextlib.suppress(np.linalg.LinAlgError):  # of weights beyond the range of floats
        for _ in range(DOUBLINGS):
            before, half = P, np.linalg.inv(eye + G @ P)
            a, G, P = a @ half @ a, G + a @ half @ G @ a.swapaxes(1, 2), P + a.swapaxes(1, 2) @ P @ half @ a
            change = np.abs(P - before).max() / np.abs(P).max()
            if not change > CONVERGED:
                break
        K = np.linalg.solve(R + B.swapaxes(1, 2) @ P @ B, B.swapaxes(1, 2) @ P @ A)
        radii = spectral_radii(A - B @ K) if change <= CONVERGED else radii
    if not radii.max() < 1 - DECAYS:
        raise ServoError(
            "The steady Riccati equation has no stabilising solution.",
            "The inputs must reach, and the weights must see, each unstable or marginal mode.",
            do="Weigh all states, integrate fewer residuals than there are inputs, or choose other actuators.",
            radius=float(radii.max()),
        )
    return K @ left, T[-1] @ P[-1] @ T[-1].T


def _explained(error, augmented, basis, names, plant, varying):
    """The error of a Riccati equation without a solution, with the mode that inputs do not reach or weights not see."""
    A, B, Q = augmented
    some = evenly(len(A), COMPARED)
    T = basis[-1]
    a = T.T @ A[-1] @ T
    unreached, unseen = _conserved(A[some], B[some], basis[some]), _fixed_modes(a.T, Q @ T)
    unreached = unreached if unreached.size else T @ _fixed_modes(a, B[-1].T @ T)
    if unreached.size:
        mode, moves = _states_in(unreached, names), np.abs(A[some] - np.eye(len(Q))).max(axis=(0, 1))
        weighs = np.diag(Q) > 0 if varying else np.ones(len(Q), dtype=bool)
        alone = [n for n, m, w in zip(names, moves, weighs, strict=True) if n in mode and m < UNREACHED and w]
        return _beyond_inputs(error, mode, alone, plant, varying)
    if unseen.size:
        mode = _states_in(T @ unseen, names)
        return ServoError(
            f"No weight sees a mode in {', '.join(mode)} that does not decay.",
            "The weights must see each unstable or marginal mode (Riccati).",
            do=f"Weigh {' or '.join(mode)}.",
            **error.details | {"mode": mode},
        )
    return error


def _conserved(A, B, T):
    """Combinations c of states, (n, number), that no sample and no input changes: cᵀ(A - 1)T = 0 and cᵀB = 0 at all.

    The combinations are those of the tangent spaces T.
    """
    changes = (A - np.eye(A.shape[1])) @ T
    null = _null_space(np.hstack([*changes, *(B / max(np.abs(B).max(), 1e-300))]).T)
    _, sizes, rows = np.linalg.svd(np.vstack(T.swapaxes(1, 2) @ null))
    return null @ rows[sizes > NAMED].T


def _null_space(matrix):
    _, sizes, rows = np.linalg.svd(matrix)
    return rows[np.sum(sizes > UNREACHED) :].T


def _states_in(modes, names):
    """Names of the states in modes (n, number), by their share in the largest."""
    share = np.linalg.norm(modes, axis=1)
    return [name for name, size in zip(names, share, strict=True) if size > NAMED * share.max()]


def _fixed_modes(A, C):
    """Vectors w, (n, number), with wᵀA = λwᵀ and C w = 0 for an eigenvalue λ that does not decay (Popov, Hautus)."""
    C = C / max(np.abs(C).max(initial=0.0), 1e-300)
    modes = np.zeros((len(A), 0))
    for value in (value for value in np.linalg.eigvals(A) if abs(value) > 1 / MARGINAL):
        null = _null_space(np.vstack([A.T - value * np.eye(len(A)), C])).conj()
        modes = np.hstack([modes, null.real, null.imag])
    return modes[:, np.abs(modes).max(axis=0, initial=0.0) > UNREACHED]


def _beyond_inputs(error, mode, alone, plant, varying):
    """The error of a mode that no input reaches, with those of its states that may stay unweighted.

    These move no other state; without a weight, time-varying gains leave them alone.
    """
    weights_ = "Q={" + ", ".join(f"{name!r}: 0" for name in alone) + "}"
    do = f"Pass {weights_}{'' if varying else ' and varying=True'}, or leave these coordinates out of the mechanism."
    return ServoError(
        f"A mode in {', '.join(mode)} that does not decay is out of reach of {', '.join(plant.inputs)}.",
        "The inputs must reach each unstable or marginal mode that has a weight (Riccati).",
        do=do
        if alone
        else "Choose other actuators, or integrate fewer residuals than there are inputs. If the mode only drifts, "
        "weigh only states that it does not move, with 0 for all others.",
        **error.details | {"mode": mode, "unweighted": alone},
    )


def _varying(A, B, Q, R, basis):
    """The Riccati equation backwards along the plan, from the steady solution at its end.

    If there is none, as for a spin that no input reaches, from a horizon after the end that is as long as the plan.
    """
    Q = np.broadcast_to(Q, A.shape)
    try:
        K, P = steady(A[-1:], B[-1:], Q[-1], R, basis[-1:])
    except ServoError:
        gains, _, P = riccati(np.broadcast_to(A[-1], A.shape), np.broadcast_to(B[-1], B.shape), Q, R, Q[-1])
        K = gains[-1:]
        if not spectral_radii(reduced(A[-1:] - B[-1:] @ K, basis[-1:]))[0] < MARGINAL:
            raise
    backwards = slice(-2, None, -1)
    before, _, _ = riccati(A[backwards], B[backwards], Q[backwards], R, P)
    return np.concatenate([before[::-1], K])


def weights(values, default, names, what, symbol, positive=False):
    """A weight matrix, (n, n), from a number, numbers by name, a diagonal or a matrix.

    `default` is a diagonal; `what` the names stand for, `symbol` the matrix's name in messages; `positive` refuses a
    matrix that is only semidefinite.
    """
    n, entries = len(names), np.array(default, dtype=float)
    if isinstance(values, dict):
        for name, weight in numbers_by_name(values, names, what, "weight").items():
            entries[names.index(name)] = weight
    elif values is not None:
        entries = as_numbers(values)
        entries = np.full(n, float(entries)) if entries.ndim == 0 else entries
    matrix = np.diag(entries) if entries.shape == (n,) else entries
    if matrix.shape != (n, n):
        raise SpecificationError(
            f"{symbol} has the shape {entries.shape}." if entries.size else f"{symbol} is {values!r}."[:200],
            f"It is a number, {n} numbers or an ({n}, {n}) matrix, for {', '.join(names)}; or numbers by name.",
            do=f"Pass one weight for each {what}.",
            name=symbol,
            shape=entries.shape,
            names=names,
        )
    symmetric = np.isfinite(matrix).all() and np.allclose(matrix, matrix.T, rtol=1e-9, atol=0)
    least = np.linalg.eigvalsh(matrix).min(initial=np.inf) if symmetric else -np.inf
    scale = np.abs(matrix).max(initial=0.0) if symmetric else 1.0
    if least < (1e-14 if positive else -1e-12) * max(scale, 1e-300):
        raise SpecificationError(
            f"{symbol} is {repr(values)[:150]}.",
            f"It is finite, symmetric and positive {'definite' if positive else 'semidefinite'}.",
            do="Pass positive weights.",
            name=symbol,
            least=float(least),
        )
    return matrix


def _integrals(integral, plan, plant):
    """The integrated residuals and deviations, and their weights; (None, None) without integrals."""
    integral = bool(integral) if isinstance(integral, np.bool_) else integral
    if integral is None or integral is False or (isinstance(integral, dict) and not integral):
        return None, None
    rows, signals = Residuals(plan.model, plant).names, plan.model.reduction.mechanism.signals
    names = integral if isinstance(integral, dict) else rows_read(rows, signals)
    residuals = Residuals(plan.model, plant, tuple(names))
    if not residuals.names:
        raise SpecificationError(
            "The program has no residual of order 0 or 1.",
            "A residual that is fed back is a function of the state (q, γ').",
            do=f'Integrate deviations from the plan: integral={{"{plant.state_names[0]}": {Q_INTEGRAL:g}}}.',
            names=tuple(program_residuals(plan.model)),
        )
    weighted = None if integral is True else integral
    names = residuals.names
    return residuals, weights(weighted, np.full(len(names), Q_INTEGRAL), names, "residual", "integral", positive=True)
