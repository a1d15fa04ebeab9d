"""The closed loop of the overhead crane, with 15 % more load and friction than its LQR knows: 10 s at 1 kHz.

All integrate by RK4 with one step per sample and log states and inputs, but for python-control, whose controller is
continuous, and solve_ivp, which chooses its steps in each sample.
"""

from functools import cache

import numpy as np
from harness import Missing, Row, installed
from native import COMPILER

import servoctl as sv
from servoctl.gallery import overhead_crane

RATE, END = 1000.0, 10.0
M_TROLLEY, M_HOIST, M_LOAD, G = 10.0, 5.0, 115.0, 9.81  # of the plant; the law believes in 100 kg
DAMPING = {"x": 5.0, "l": 5.0}
WITHIN = 1e-10  # of the largest value of each state
LOOSER = {"mujoco": 1e-8, "python-control": 5e-3, "solve_ivp": 1e-5}


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


def mujoco_loop():
    import mujoco

    _, _, x0, u_ff, reference, K = loop()
    model = mujoco.MjModel.from_xml_string(CRANE)
    data = mujoco.MjData(model)
    order = np.array([0, 2, 1])  # theta before l, which slides along the rope
    u_ff, reference = np.ascontiguousarray(u_ff.T), np.ascontiguousarray(reference.T)

    def call():
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = x0[:3][order], x0[3:][order]
        states, inputs, x = np.empty((len(u_ff), 6)), np.empty((len(u_ff), 2)), np.empty(6)
        for k in range(len(u_ff)):
            x[:3], x[3:] = data.qpos[order], data.qvel[order]
            states[k] = x
            inputs[k] = data.ctrl[:] = u_ff[k] - K @ (x - reference[k])
            mujoco.mj_step(model, data)
        return states.T

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


def closed_loop():
    exact = ours(4)()
    size = np.abs(exact).max(axis=1, keepdims=True)
    peers = {
        "python-control": python_control() if installed("control") else Missing("control is not installed"),
        "mujoco": mujoco_loop() if installed("mujoco") else Missing("mujoco is not installed"),
        "solve_ivp": solve_ivp_loop(),
    }
    return Row(
        "Closed loop of the crane, 10 s at 1 kHz, all samples logged, one call",
        ours() if COMPILER else Missing("gcc is not installed"),
        peers,
        lambda states: np.abs((states - exact) / size).max(),
        WITHIN,
        {"python-control": 250, "mujoco": 50, "solve_ivp": 500},
        LOOSER,
    )


ROWS = {"loop": closed_loop}
