"""MuJoCo as an independent plant under servoctl's laws."""

import numpy as np
import pytest
import robots
from conftest import needs
from refusals import refused
from test_robot_programs import HOME, LEGS, STANDING, arm_plan, place, quadruped_plan

import servoctl as sv

mujoco = needs("mujoco")


def model_of(name, step=1e-3, more=0.0):
    """MuJoCo's model of an own robot, by Runge-Kutta steps; `more` mass [kg] in the last body."""
    model = mujoco.MjModel.from_xml_path(robots.file_of(name))
    model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_RK4
    model.body_mass[-1] += more
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


@pytest.mark.parametrize("name", ["six_axis_arm", "seven_axis_arm", "pendubot"])
def test_accelerations_equal_mujoco(name):
    arm = sv.urdf(robots.file_of(name))
    plant, model, random = sv.plant(arm.mechanism()), model_of(name), np.random.default_rng(6)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    data = mujoco.MjData(model)
    order = [model.joint(joint).dofadr[0] for joint in arm.joints.values()]
    for _ in range(20):
        q, v, _ = robots.random_state(arm, random)
        u = random.normal(size=len(plant.inputs))
        data.qpos[order], data.qvel[order], data.qfrc_applied[order] = q, v, u
        mujoco.mj_forward(model, data)
        ours = plant.rates(0.0, np.concatenate([q, v]), u)[len(q) :]
        assert np.abs(ours - data.qacc[order]).max() < 1e-12 * np.abs(ours).max()


def test_a_loop_in_mujoco_is_that_of_close():
    arm, mechanism, model, run = arm_plan()
    plant = sv.plant(mechanism, limits=arm.effort)
    law, start = sv.lqr(run, plant, rate=1000.0), model.start(guess=HOME)
    theirs = sv.interop.mujoco(model_of("six_axis_arm"), law, start, (0.0, 2.0), plant=plant)
    ours = sv.close(plant, law, start, (0.0, 2.0), timing=sv.Timing(substeps=1))
    assert "MuJoCo" in theirs.message
    assert "MuJoCo" in repr(theirs)
    assert theirs.success
    assert np.abs(theirs.states - ours.states).max() < 1e-11


def test_integrals_carry_two_more_kilograms():
    arm, mechanism, model, run = arm_plan()
    plant, heavier = sv.plant(mechanism, limits=arm.effort), model_of("six_axis_arm", more=2.0)
    ends = []
    for integral in (None, True):
        law = sv.lqr(run, plant, rate=1000.0, integral=integral)
        loop = sv.interop.mujoco(heavier, law, model.start(guess=HOME), (0.0, 4.0), plant=plant)
        ends.append(max(abs(loop.error[name][-1]) for name in arm.q.names))
    assert ends[0] > 1e-2
    assert ends[1] < 1e-3


def test_a_pendubot_is_held_upright():
    arm = sv.urdf(robots.file_of("pendubot"))
    mechanism = arm.mechanism(actuators=("shoulder",))
    model = sv.derive(mechanism, sv.Program({"arm": arm.q["shoulder"] - np.pi}))
    with pytest.warns(RuntimeWarning, match="nternal dynamics"):
        run = sv.simulate(model, model.start(elbow=0.0, delbow=0.0, guess={"shoulder": np.pi}), (0.0, 3.0))
    plant = sv.plant(mechanism, limits=arm.effort)
    start = {"shoulder": np.pi + 0.03, "elbow": 0.05, "dshoulder": 0.0, "delbow": 0.0}
    loop = sv.interop.mujoco(model_of("pendubot"), sv.lqr(run, plant, rate=500.0), start, (0.0, 3.0), plant=plant)
    assert max(abs(loop.error[name][-1]) for name in arm.q.names) < 1e-4


def standing_model():
    """The quadruped with a free trunk, its feet held by stiff constraints between sites."""
    spec, robot = mujoco.MjSpec.from_file(robots.file_of("quadruped")), quadruped_plan()[0]
    spec.compiler.fusestatic = False
    spec.body("trunk").add_freejoint(name="base")
    for leg in LEGS:
        foot = f"{leg}_foot"
        spec.worldbody.add_site(name=f"at_{foot}", pos=place(robot, foot, STANDING)[0].ravel())
        spec.body(foot).add_site(name=f"of_{foot}")
        row = spec.add_equality()
        row.type, row.objtype = mujoco.mjtEq.mjEQ_CONNECT, mujoco.mjtObj.mjOBJ_SITE
        row.name1, row.name2 = f"at_{foot}", f"of_{foot}"
        row.solref, row.solimp = [0.004, 1.0], [0.999, 0.9999, 0.001, 0.5, 2.0]
    model = spec.compile()
    model.opt.timestep, model.opt.integrator = 5e-4, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return model


def test_a_quadruped_moves_its_body_on_feet_that_give_way():
    robot, mechanism, model, run = quadruped_plan()
    plant = sv.plant(mechanism, limits=robot.effort)
    law, start = sv.lqr(run, plant, rate=1000.0), model.start(guess=STANDING | {"base_qw": 1.0})
    loop = sv.interop.mujoco(standing_model(), law, start, (0.0, 1.2), plant=plant)
    for axis in "xyz":
        assert np.abs(loop.residual[f"trunk_{axis}"][0]).max() < 1e-3
    rigid = sv.close(plant, law, start, (0.0, 0.3), timing=sv.Timing(substeps=2))  # given, or a Jacobian decides them
    assert np.abs(rigid.residual["trunk_x"][0]).max() < 1e-6


def test_what_mujoco_cannot_run_is_refused():
    arm, mechanism, model, run = arm_plan()
    plant = sv.plant(mechanism)
    law, start, file = sv.lqr(run, plant, rate=1000.0), model.start(guess=HOME), robots.file_of("six_axis_arm")
    other = model_of("six_axis_arm", step=3e-4)
    with refused(sv.errors.SpecificationError, "0.0003", "timestep", timestep=3e-4):
        sv.interop.mujoco(other, law, start, (0.0, 1.0))
    with refused(sv.errors.NameUnknown, "pan"):
        sv.interop.mujoco(robots.file_of("pendubot"), law, start, (0.0, 1.0))
    with refused(sv.errors.SpecificationError, "cannot read"):
        sv.interop.mujoco("<mujoco><nonsense/></mujoco>", law, start, (0.0, 1.0))
    with refused(sv.errors.SpecificationError, "lag", lag=["torque_pan"]):
        lagging = sv.plant(mechanism, lag={"torque_pan": 0.01})
        sv.interop.mujoco(file, law, start, (0.0, 1.0), plant=lagging)
    with refused(sv.errors.SpecificationError, "plant"):
        sv.interop.mujoco(file, lambda t, y: {}, start, (0.0, 1.0), timing=sv.Timing(rate=100.0))


def two_links(first, second):
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="2" iyz="0" izz="2.5"/>'
    link = f'<link name="{{}}"><inertial><origin xyz="0.1 0 0.2"/><mass value="{{}}"/>{inertia}</inertial></link>'
    joint = '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/><axis xyz="0 1 0"/></joint>'
    parts = (link.format("a", 1), link.format("b", 2), joint.format(first, "root", "a"), joint.format(second, "a", "b"))
    return f'<robot name="two"><link name="root"/>{"".join(parts)}</robot>'


def test_joints_whose_names_were_taken_are_found():
    """The joint dx has the coordinate dx_, for dx is the rate of x; MuJoCo's state of it is its own."""
    text = two_links("x", "dx")
    plant = sv.plant(sv.urdf(text).mechanism())
    start, timing = {"x": 0.4, "dx_": -0.7, "dx": 0.3, "ddx_": 1.0}, sv.Timing(rate=100.0, substeps=5)
    model = mujoco.MjModel.from_xml_string(text)
    model.opt.timestep, model.opt.integrator = 2e-3, mujoco.mjtIntegrator.mjINT_RK4
    idle = lambda t, y: dict.fromkeys(plant.inputs, 0.0)  # noqa: E731
    theirs = sv.interop.mujoco(model, idle, start, (0.0, 0.2), plant=plant, timing=timing)
    ours = sv.close(plant, idle, start, (0.0, 0.2), timing=timing)
    assert np.abs(theirs.states - ours.states).max() < 1e-12
    with refused(sv.errors.SpecificationError, "a.b", coordinates=["a_b", "a_b_"]):
        other = sv.plant(sv.urdf(two_links("a.b", "a_b")).mechanism())
        sv.interop.mujoco(two_links("a.b", "a_b"), idle, [0.0] * 4, (0.0, 0.2), plant=other, timing=timing)
