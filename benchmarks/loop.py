"""The closed loop of the overhead crane, with 15 % more load and friction than its LQR knows: 10 s at 1 kHz.

All integrate by RK4 with one step per sample and log states and inputs, but for python-control, whose controller is
continuous, and solve_ivp, which chooses its steps in each sample. MuJoCo is called from Python with the law in NumPy,
and from C with the law in C; numba compiles the same loop with the equations by hand. Drake's law consists of its own
blocks; it has no RK4, so that it takes its method of third order.
"""

import ctypes
from functools import cache, partial
from pathlib import Path

import numpy as np
from harness import Missing, Row, installed
from native import COMPILER, build, function

import servoctl as sv
from servoctl.gallery import overhead_crane

RATE, END = 1000.0, 10.0
M_TROLLEY, M_HOIST, M_LOAD, G = 10.0, 5.0, 115.0, 9.81  # of the plant; the law believes in 100 kg
DAMPING = {"x": 5.0, "l": 5.0}
WITHIN = 1e-10  # of the largest value of each state
LOOSER = {
    "mujoco, law in NumPy": 1e-8, "mujoco, law in C": 1e-8, "drake": 1e-7, "python-control": 5e-3, "solve_ivp": 1e-5
}  # fmt: skip


@cache
def loop(end=END):
    """Plant, law with the gains of its end, start, and the law's numbers at the samples."""
    mechanism, program = overhead_crane()
    model = sv.derive(mechanism, program)
    plan = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, END), progress=False)
    law = sv.lqr(plan, sv.plant(mechanism), rate=RATE)
    schedule = law.schedule.copy()
    schedule[8:] = schedule[8:, -1:]
    law = sv.Law(
        law.name, law.measures, law.inputs, RATE, 0.0, law.step, schedule, initial_input=law.initial_input, plan=plan
    )
    plant = sv.plant(mechanism, m_load=M_LOAD, damping=DAMPING)
    count = round(end * RATE)
    u_ff, reference = schedule[:2, : count + 1], schedule[2:8, : count + 1]
    return plant, law, plan.state(0.0), u_ff, reference, schedule[8:, -1].reshape(2, 6)


def rates(x, u, m=M_LOAD, c_x=DAMPING["x"], c_l=DAMPING["l"]):
    """x' of (x, l, theta, x', l', theta') under (trolley, hoist), by hand; any number of columns."""
    _, l, theta, dx, dl, dtheta = x
    s, c = np.sin(theta), np.cos(theta)
    w = m * (l * dtheta**2 + G * c)
    along, up = u[0] - c_x * dx + s * w, u[1] - c_l * dl + w
    ms, m_l = m * s, M_HOIST + m
    scale = 1 / (M_TROLLEY * m_l + ms * s * M_HOIST)
    ddx = (along * m_l - ms * up) * scale
    ddl = ((M_TROLLEY + ms * s) * up - ms * along) * scale
    return np.array([dx, dl, dtheta, ddx, ddl, -(ddx * c + 2 * dl * dtheta + G * s) / l])


# ours and peers: the states at all samples, (6, N) -------------------------------------------------------------------


def ours(substeps=1):
    plant, law, x0, *_ = loop()
    return lambda: sv.close(plant, law, x0, (0.0, END), timing=sv.Timing(substeps=substeps)).states


def python_control():
    import control

    _, _, x0, u_ff, reference, K = loop()
    states, inputs = ["x", "l", "theta", "dx", "dl", "dtheta"], ["trolley", "hoist"]
    plant = control.nlsys(
        lambda t, x, u, params: rates(x, u), None, name="plant", states=states, inputs=inputs, outputs=states
    )
    held = [f"ff_{name}" for name in inputs] + [f"ref_{name}" for name in states]
    law = control.nlsys(
        None, lambda t, x, v, params: v[:2] - K @ (v[8:] - v[2:8]), name="law", inputs=held + states, outputs=inputs
    )
    system = control.interconnect([plant, law], inplist=held, inputs=held, outlist=states, outputs=states)
    before = np.hstack([u_ff[:, :1], u_ff[:, :-1]])  # the law holds what is right in the middle of a sample
    t, given = np.arange(u_ff.shape[1]) / RATE, np.vstack([(before + u_ff) / 2, reference])
    return lambda: control.input_output_response(system, t, given, x0).outputs


CRANE = f"""
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{1 / RATE}" integrator="RK4" gravity="0 0 -{G}"><flag constraint="disable"/></option>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0" damping="{DAMPING["x"]}"/>
      <inertial pos="0 0 0" mass="{M_TROLLEY}" diaginertia="1 1 1"/>
      <body>
        <joint name="theta" type="hinge" axis="0 -1 0"/>
        <joint name="l" type="slide" axis="0 0 -1" damping="{DAMPING["l"]}" armature="{M_HOIST}"/>
        <inertial pos="0 0 0" mass="{M_LOAD}" diaginertia="1e-9 1e-9 1e-9"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="x"/><motor joint="l"/></actuator>
</mujoco>
"""


MUJOCO_LOOP = """
#include <mujoco/mujoco.h>
void sampled(const mjModel *m, mjData *d, void (*step)(const mjModel *, mjData *), long count, const double *u_ff,
             const double *reference, const double *K, double *states, double *inputs)
{
    static const int order[3] = {0, 2, 1};
    for (long k = 0; k < count; k++, u_ff += 2, reference += 6, states += 6, inputs += 2) {
        for (int i = 0; i < 3; i++) states[i] = d->qpos[order[i]], states[3 + i] = d->qvel[order[i]];
        for (int i = 0; i < 2; i++) {
            inputs[i] = u_ff[i];
            for (int j = 0; j < 6; j++) inputs[i] -= K[6 * i + j] * (states[j] - reference[j]);
            d->ctrl[i] = inputs[i];
        }
        step(m, d);
    }
}
"""


def mujoco_loop(compiled):
    """MuJoCo's steps, with the law between them in C or in NumPy."""
    import mujoco

    _, _, x0, u_ff, reference, K = loop()
    model = mujoco.MjModel.from_xml_string(CRANE)
    data = mujoco.MjData(model)
    order = np.array([0, 2, 1])  # theta before l, which slides along the rope
    u_ff, reference, K = (np.ascontiguousarray(values) for values in (u_ff.T, reference.T, K))

    def in_numpy(states, inputs):
        x = np.empty(6)
        for k in range(len(u_ff)):
            x[:3], x[3:] = data.qpos[order], data.qvel[order]
            states[k] = x
            inputs[k] = data.ctrl[:] = u_ff[k] - K @ (x - reference[k])
            mujoco.mj_step(model, data)

    def in_c(states, inputs):
        arrays = (array.ctypes.data for array in (u_ff, reference, K, states, inputs))
        sampled(model._address, data._address, step, len(u_ff), *arrays)

    if compiled:
        home = Path(mujoco.__file__).parent
        step = ctypes.cast(ctypes.CDLL(str(next(home.glob("libmujoco*")))).mj_step, ctypes.c_void_p)
        library = build(MUJOCO_LOOP, "-O3", f"-I{home / 'include'}")
        sampled = function(library, "sampled", *3 * [ctypes.c_void_p], ctypes.c_long, *5 * [ctypes.c_void_p])

    def call():
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = x0[:3][order], x0[3:][order]
        states, inputs = np.empty((len(u_ff), 6)), np.empty((len(u_ff), 2))
        (in_c if compiled else in_numpy)(states, inputs)
        return states.T

    return call


def numba_loop():
    """The equations by hand and the loop, compiled; in numbers, which takes less than half as long as in arrays."""
    import numba

    _, _, x0, u_ff, reference, K = loop()
    c_x, c_l = DAMPING["x"], DAMPING["l"]
    u_ff, reference, K = (np.ascontiguousarray(values) for values in (u_ff.T, reference.T, K))

    @numba.njit(fastmath=True, inline="always")
    def rate(x, u):
        _, l, theta, dx, dl, dtheta = x
        s, c = np.sin(theta), np.cos(theta)
        w = M_LOAD * (l * dtheta * dtheta + G * c)
        along, up, ms = u[0] - c_x * dx + s * w, u[1] - c_l * dl + w, M_LOAD * s
        scale = 1 / (M_TROLLEY * (M_HOIST + M_LOAD) + ms * s * M_HOIST)
        ddx = (along * (M_HOIST + M_LOAD) - ms * up) * scale
        ddl = ((M_TROLLEY + ms * s) * up - ms * along) * scale
        return dx, dl, dtheta, ddx, ddl, -(ddx * c + 2 * dl * dtheta + G * s) / l

    @numba.njit(fastmath=True, inline="always")
    def moved(x, h, k):
        return (x[0] + h * k[0], x[1] + h * k[1], x[2] + h * k[2], x[3] + h * k[3], x[4] + h * k[4], x[5] + h * k[5])

    @numba.njit(fastmath=True)
    def run(x, u_ff, reference, K, states, inputs):
        h = 1 / RATE
        for k in range(len(u_ff)):
            for i in range(2):
                inputs[k, i] = u_ff[k, i]
                for j in range(6):
                    inputs[k, i] -= K[i, j] * (x[j] - reference[k, j])
            for j in range(6):
                states[k, j] = x[j]
            u = inputs[k, 0], inputs[k, 1]
            a = rate(x, u)
            b = rate(moved(x, h / 2, a), u)
            c = rate(moved(x, h / 2, b), u)
            d = rate(moved(x, h, c), u)
            x = moved(moved(moved(moved(x, h / 6, a), h / 3, b), h / 3, c), h / 6, d)

    def call():
        states, inputs = np.empty((len(u_ff), 6)), np.empty((len(u_ff), 2))
        run(tuple(x0), u_ff, reference, K, states, inputs)
        return states.T

    return call


def drake_loop():
    """A multibody plant, a hold, and its law from blocks of Drake, by its third-order Runge-Kutta method."""
    from pydrake.multibody.plant import MultibodyPlant
    from pydrake.multibody.tree import PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia
    from pydrake.systems.analysis import ResetIntegratorFromFlags, Simulator
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.primitives import Adder, LogVectorOutput, MatrixGain, TrajectorySource, ZeroOrderHold
    from pydrake.trajectories import PiecewisePolynomial

    _, _, x0, u_ff, reference, K = loop()
    order, h = [0, 2, 1, 3, 5, 4], 1 / RATE  # theta before l
    builder = DiagramBuilder()
    plant = builder.AddSystem(MultibodyPlant(time_step=0.0))
    point = np.zeros(3), UnitInertia(0, 0, 0)
    trolley, rope, load = (
        plant.AddRigidBody(name, SpatialInertia(mass, *point))
        for name, mass in (("trolley", M_TROLLEY), ("rope", 0.0), ("load", M_LOAD))
    )
    frames = plant.world_frame(), trolley.body_frame(), rope.body_frame(), load.body_frame()
    x = plant.AddJoint(PrismaticJoint("x", *frames[:2], [1, 0, 0], damping=DAMPING["x"]))
    plant.AddJoint(RevoluteJoint("theta", *frames[1:3], [0, -1, 0]))
    l = plant.AddJoint(PrismaticJoint("l", *frames[2:], [0, 0, -1], damping=DAMPING["l"]))
    plant.AddJointActuator("trolley", x)
    hoist = plant.AddJointActuator("hoist", l)
    hoist.set_default_rotor_inertia(M_HOIST)
    hoist.set_default_gear_ratio(1.0)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -G])
    plant.Finalize()
    times = (np.arange(u_ff.shape[1] + 1) - 0.5) * h  # jumps between samples, which then are exact
    open_loop = u_ff + K @ reference
    table = PiecewisePolynomial.ZeroOrderHold(times, np.hstack([open_loop, open_loop[:, -1:]]))
    source, adder = builder.AddSystem(TrajectorySource(table)), builder.AddSystem(Adder(2, 2))
    gain, hold = builder.AddSystem(MatrixGain(-K[:, order])), builder.AddSystem(ZeroOrderHold(h, 2))
    state = plant.get_state_output_port()
    builder.Connect(state, gain.get_input_port())
    builder.Connect(source.get_output_port(), adder.get_input_port(0))
    builder.Connect(gain.get_output_port(), adder.get_input_port(1))
    builder.Connect(adder.get_output_port(), hold.get_input_port())
    builder.Connect(hold.get_output_port(), plant.get_actuation_input_port())
    log = LogVectorOutput(state, builder, publish_period=h)
    simulator = Simulator(builder.Build())
    context = simulator.get_mutable_context()
    ResetIntegratorFromFlags(simulator, "runge_kutta3", h).set_fixed_step_mode(True)

    def call():
        context.SetTime(0.0)
        simulator.get_system().SetDefaultContext(context)
        plant.SetPositionsAndVelocities(plant.GetMyMutableContextFromRoot(context), x0[order])
        log.FindMutableLog(context).Clear()
        simulator.Initialize()
        simulator.AdvanceTo(END)
        return log.FindLog(context).data()[order]

    return call


def solve_ivp_loop():
    from scipy.integrate import solve_ivp

    _, _, x0, u_ff, reference, K = loop()

    def call():
        states, inputs, x = np.empty((6, u_ff.shape[1])), np.empty_like(u_ff), x0
        for k in range(u_ff.shape[1]):
            states[:, k] = x
            inputs[:, k] = u = u_ff[:, k] - K @ (x - reference[:, k])
            x = solve_ivp(lambda t, x, u=u: rates(x, u), (k / RATE, (k + 1) / RATE), x).y[:, -1]
        return states

    return call


# rows ----------------------------------------------------------------------------------------------------------------


def peer(module, make, compiler=True):
    missing = [name for name, there in ((module, installed(module)), ("gcc", compiler)) if not there]
    return Missing(f"{missing[0]} is not installed") if missing else make()


def closed_loop():
    exact = ours(4)()
    size = np.abs(exact).max(axis=1, keepdims=True)
    peers = {
        "python-control": peer("control", python_control),
        "mujoco, law in NumPy": peer("mujoco", partial(mujoco_loop, False)),
        "mujoco, law in C": peer("mujoco", partial(mujoco_loop, True), COMPILER),
        "drake": peer("pydrake", drake_loop),
        "numba": peer("numba", numba_loop),
        "solve_ivp": solve_ivp_loop(),
    }
    return Row(
        "Closed loop of the crane, 10 s at 1 kHz, all samples logged, one call",
        ours() if COMPILER else Missing("gcc is not installed"),
        peers,
        lambda states: np.abs((states - exact) / size).max(),
        WITHIN,
        {"python-control": 250, "mujoco, law in NumPy": 50, "solve_ivp": 500},
        LOOSER,
    )


ROWS = {"loop": closed_loop}
