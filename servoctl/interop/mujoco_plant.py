"""MuJoCo as an independent plant under a sampled law."""

import math
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np

from servoctl.checks import ON_SAMPLE, as_span, named, require_kind
from servoctl.control.close import as_law, finished, loop_of, require_names
from servoctl.control.conditions import Conditions
from servoctl.control.reference import require_plant
from servoctl.control.result import Closed
from servoctl.errors import ServoError, SpecificationError, unknown
from servoctl.plants.plant import plant as plant_of
from servoctl.robots.joints import PLACE, TWIST, identifier

FREE, SLIDE, HINGE = 0, 2, 3  # types of MuJoCo's joints with a place in a servoctl state


def mujoco(model, law, x0, t_span, *, plant=None, sensors=None, timing=None, disturbance=None) -> Closed:
    """Run a sampled law on MuJoCo's plant: as `close`, with MuJoCo in place of the plant's own equations.

    Inputs act as generalised forces, and are held from sample to sample. Coordinates are those of joints of the same
    name; a free joint has the coordinates and body velocities of `urdf(base="free")`. Accelerations, energy and
    residuals of the result are those of servoctl's equations at MuJoCo's states.

    Parameters
    ----------
    model : mujoco.MjModel, or str or Path
        MuJoCo's model, or the path or the text of an MJCF or URDF file.
    law : Law or callable
        As in `close`.
    x0 : array or dict of str to float
        Initial state.
    t_span : (t0, t1)
        [s]; whole samples of the law. A sample is a whole number of MuJoCo's steps.
    plant : Plant, optional
        The machine whose names, limits and delays the loop has; by default that of the law's plan, without limits.
    sensors, timing, disturbance
        As in `close`.

    Returns
    -------
    Closed
        Its message names MuJoCo.

    Raises
    ------
    ServoError
        If MuJoCo is not installed.
    SpecificationError
        If the file has no model, a sample is no whole number of steps, or actuators lag.
    NameUnknown
        If a coordinate has no joint in MuJoCo's model.
    """
    library, model = _mujoco(model)
    plan = getattr(law, "plan", None)
    if plant is None and plan is None:
        raise SpecificationError(
            "Neither a plant nor a law with a plan was given.",
            "The names of states and inputs are those of a plant.",
            do="Pass plant=sv.plant(mechanism).",
        )
    plant = plant_of(plan.model.reduction.mechanism) if plant is None else plant
    require_plant(plant)
    conditions, t_span = Conditions(sensors, timing, disturbance), as_span(t_span, forward=True)
    law = as_law(law, plant, conditions.timing.rate, t_span[0], plan)
    require_names(law, plant)
    for name in conditions.disturbance:
        named(name, plant.disturbable, "generalised force")  # MuJoCo does not have the plant's parameters
    machine = _Machine(library, model, plant)
    timing = replace(conditions.timing, substeps=machine.steps(law.period))
    conditions = replace(conditions, timing=timing)
    try:
        plant, loop = loop_of(plant, law, x0, t_span, conditions)
        run = finished(plant, law, plan, loop, conditions, machine.hold)
    except ServoError as error:
        if error.run is not None:
            error.run = _of_mujoco(error.run, library)
        raise
    return _of_mujoco(run, library)


def _of_mujoco(run, library):
    """The run, whose message says that it is MuJoCo's."""
    return replace(run, message=f"{run.message}, in MuJoCo {library.__version__}")


def _mujoco(model):
    """The library, and a model from a model, a path or a text."""
    try:
        import mujoco as library
    except ImportError as error:
        raise ServoError(
            "MuJoCo is not installed.",
            "sv.interop.mujoco steps it as the plant.",
            do="pip install 'servoctl[mujoco]'.",
        ) from error
    if isinstance(model, library.MjModel):
        return library, model
    require_kind((str, Path), "model", model, "mujoco.MjModel.from_xml_path(file)")
    given = str(model)
    read = library.MjModel.from_xml_string if "<" in given else library.MjModel.from_xml_path
    try:
        return library, read(given)
    except ValueError as error:
        raise SpecificationError(
            f"MuJoCo cannot read the model: {error}."[:400],
            "It reads MJCF and URDF files whose meshes it finds.",
            do="Remove visuals and collisions, or load it by mujoco.MjModel.from_xml_path and pass the model.",
        ) from error


def _coordinate(joint, q):
    """The name of a joint's coordinate, which ends in underscores where the joint's name was taken."""
    plain = identifier(joint or "joint")
    alike = [name for name in q.names if name.rstrip("_") == plain.rstrip("_")]
    if len(alike) > 1 and joint not in alike:
        raise SpecificationError(
            f"The joint {joint!r} of MuJoCo's model may have the coordinates {', '.join(alike)}.",
            "A coordinate has the name of one joint.",
            do="Rename the joints, so that they differ in letters or digits.",
            joint=joint,
            coordinates=alike,
        )
    return joint if joint in alike else alike[0] if alike else plain


class _Machine:
    """MuJoCo's model and data under the names of a plant."""

    def __init__(self, library, model, plant):
        if plant.lag:
            raise SpecificationError(
                f"The actuators {', '.join(plant.lag)} lag.",
                "A lag is a state of servoctl's plant, which MuJoCo does not have.",
                do="Leave the lag out, or model it in MuJoCo.",
                lag=list(plant.lag),
            )
        self.library, self.model, self.data, self.plant = library, copy(model), library.MjData(model), plant
        q = plant.mechanism.q
        self.free, self.places, self.speeds = [], np.zeros(q.nq, int), np.zeros(q.n, int)
        self._find(q)
        self._directions, self._inputs = plant.function("directions"), slice(plant.at_u, None)

    def _find(self, q):
        """Addresses of the coordinates and velocities in MuJoCo's state."""
        velocities = q.force_names
        placed, joints = set(), []
        for i in range(self.model.njnt):
            joint = self.model.joint(i)
            name, kind, at_q, at_v = _coordinate(joint.name, q), joint.type[0], joint.qposadr[0], joint.dofadr[0]
            joints.append(joint.name)
            base = name if f"{name}_qw" in q.names else "base"
            if kind == FREE and f"{base}_qw" in q.names:
                scalar_last = np.array([0, 1, 2, 4, 5, 6, 3])
                self.places[[q.names.index(f"{base}_{part}") for part in PLACE]] = at_q + scalar_last
                rows = [velocities.index(f"{base}_{part}") for part in TWIST]
                self.speeds[rows] = at_v + np.arange(6)
                self.free.append((at_q, at_v))
                placed |= {f"{base}_{part}" for part in PLACE}
            elif kind in (SLIDE, HINGE) and name in q.names:
                self.places[q.names.index(name)] = at_q
                self.speeds[velocities.index(name if q.plain else f"{name}_rate")] = at_v
                placed.add(name)
        for name in q.names:
            if name not in placed:
                raise unknown(name, joints, "joint of MuJoCo's model")

    def steps(self, period):
        """MuJoCo's steps in a sample."""
        step = self.model.opt.timestep
        count = round(period / step)
        if not count or abs(count * step - period) > ON_SAMPLE * period:
            raise SpecificationError(
                f"A sample lasts {period:g} s, MuJoCo's step {step:g} s.",
                "A sample is a whole number of steps.",
                f"model.opt.timestep = {period / max(count, math.ceil(period / step)):g}.",
                period=period,
                timestep=step,
            )
        return count

    def hold(self, _ode, t, x, steps):
        """The state after a sample: MuJoCo's steps under the plant's inputs and disturbances."""
        data, nq = self.data, self.plant.mechanism.q.nq
        data.time, data.qpos[self.places], data.qvel[self.speeds] = t, x[:nq], x[nq:]
        for at_q, at_v in self.free:
            data.qvel[at_v : at_v + 3] = self._turn(at_q) @ data.qvel[at_v : at_v + 3]
        for _begin, self.model.opt.timestep, (start, _middle, _end) in steps:
            forces = start[self._inputs]
            u, d = forces[: len(self.plant.inputs)], forces[len(self.plant.inputs) :]
            state = np.concatenate([data.qpos[self.places], x[nq:]])
            E = self._directions(data.time, state, start)[: len(self.speeds) * len(u)].reshape(len(u), -1).T
            data.qfrc_applied[self.speeds] = E @ u + d
            for at_q, at_v in self.free:
                data.qfrc_applied[at_v : at_v + 3] = self._turn(at_q) @ data.qfrc_applied[at_v : at_v + 3]
            self.library.mj_step(self.model, data)
        speeds = data.qvel.copy()
        for at_q, at_v in self.free:
            speeds[at_v : at_v + 3] = self._turn(at_q).T @ speeds[at_v : at_v + 3]
        return np.concatenate([data.qpos[self.places], speeds[self.speeds]])

    def _turn(self, at_q):
        """The rotation of a free body (3, 3)."""
        matrix = np.zeros(9)
        self.library.mju_quat2Mat(matrix, self.data.qpos[at_q + 3 : at_q + 7])
        return matrix.reshape(3, 3)
