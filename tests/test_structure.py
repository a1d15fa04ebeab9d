"""Index, relative degrees, zeros at infinity, essential orders and decoupling rank: theory, table of section 3, by row."""

from dataclasses import dataclass
from functools import cache, partial

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.gallery import gallery, mass_on_car, passive_arm, vtol


@dataclass(frozen=True)
class Row:
    """A row of the table: final orders, relative degrees, rank of the decoupling matrix, n', ε, index, realisation."""

    orders: tuple
    r: tuple
    rank: int
    n: tuple
    e: tuple
    index: int
    kind: str


TWO_OF_FOUR = ((2, 2), 1, (2, 4), (4, 4), 5, "mixed")
TABLE = {  # final orders counted without material rows, of order 0 each
    "two-cars": Row((0, 0), (4,), 1, (4,), (4,), 5, "tangential"),
    "three-cars": Row((0, 0, 0), (6,), 1, (6,), (6,), 7, "tangential"),
    "overhead-crane": Row((0, 0, 0), *TWO_OF_FOUR),
    "overhead-crane-redundant": Row((0, 0, 0), *TWO_OF_FOUR),
    "winch-crane": Row((0, 0, 0), *TWO_OF_FOUR),
    "winch-crane-redundant": Row((0, 0, 0), *TWO_OF_FOUR),
    "crane-3d": Row((0, 0, 0, 0, 0), (2, 2, 2), 1, (2, 4, 4), (4, 4, 4), 5, "mixed"),
    "crane-3d-redundant": Row((0, 0, 0, 0, 0), (2, 2, 2), 1, (2, 4, 4), (4, 4, 4), 5, "mixed"),
    "mass-on-car": Row((0, 2), (2,), 1, (2,), (2,), 3, "orthogonal"),
    "mass-on-car-absolute": Row((0, 2), (2,), 1, (2,), (2,), 3, "orthogonal"),
    "vtol-centre": Row((0, 0, 2), (2, 2), 2, (2, 2), (2, 2), 3, "orthogonal"),
    "vtol": Row((0, 0, 0), *TWO_OF_FOUR),
    "passive-arm": Row((0, 2), (2,), 1, (2,), (2,), 3, "orthogonal"),
}
VARIANTS = {
    f"mass on car, {alpha:.0f} deg, d = {damping:g}, {coordinates}": (
        partial(mass_on_car, np.deg2rad(alpha), damping, coordinates), row,
    )
    for coordinates in ("relative", "absolute")
    for alpha, damping, row in (
        (0.0, 0.0, Row((0, 0), (4,), 1, (4,), (4,), 5, "tangential")),
        (0.0, 1.0, Row((0, 1), (3,), 1, (3,), (3,), 4, "tangential")),
        (90.0, 1.0, Row((0, 2), (2,), 1, (2,), (2,), 3, "orthogonal")),
    )
} | {"passive arm, 0.5": (partial(passive_arm, 0.5), Row((0, 2), (2,), 1, (2,), (2,), 3, "orthogonal"))}  # fmt: skip


@cache
def variant(name):
    return sv.derive(*VARIANTS[name][0]())


def check(model, row):
    structure = model.structure()
    material = len(model.reduction.mechanism.constraints)
    orders = sorted(r.order for r in model.reduction.rows)
    assert orders == sorted([0] * material + list(row.orders))
    assert model.free == sum(row.orders)
    assert structure.relative_degree == row.r
    assert structure.decoupling_rank == row.rank
    assert structure.zeros_at_infinity == row.n
    assert structure.essential_orders == row.e
    assert structure.index == row.index == 1 + max(row.n) == 1 + max(row.e)
    assert structure.realisation == row.kind
    states = 2 * (model.n - material)
    assert sum(row.n) + model.free == states  # the plant's states are the zeros at infinity and the internal ones
    assert structure.margin > 0 and structure.uniform
    assert len(repr(structure).splitlines()) <= 12 and f"index {row.index}" in repr(structure)


@pytest.mark.parametrize("name", TABLE)
def test_gallery_rows_of_the_table(name, gallery_model):
    check(gallery_model(name), TABLE[name])


@pytest.mark.parametrize("name", VARIANTS)
def test_other_rows_of_the_table(name):
    check(variant(name), VARIANTS[name][1])


@pytest.mark.parametrize(
    ("name", "free", "index"), [("appell-hamel", 6, 3), ("two-cars-ideal", 2, 3), ("constant-speed", 3, 2)]
)
def test_ideal_programs(name, free, index, gallery_model):
    model = gallery_model(name)
    structure = model.structure()
    assert model.free == free
    assert structure.index == index and structure.realisation == "ideal"


def test_programs_of_order_three_have_no_index_computed(gallery_model):
    model = gallery_model("spiral")
    assert model.structure().index is None and model.free == 5
    assert "Chetaev" in repr(model)


# along a motion ------------------------------------------------------------------------------------------------------


def test_the_crane_along_its_whole_reference(gallery_model):
    model = gallery_model("overhead-crane")
    run = sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 8.0))
    structure = model.structure(run.t[::25], run.jets[:, ::25])
    assert structure.index == 5 and structure.zeros_at_infinity == (2, 4) and not structure.uniform
    assert len(structure.at) == len(run.t[::25])
    for t, local in structure.at:
        assert local.zeros_at_infinity == (2, 4) and local.index == 5 and local.margin > 0.5
        if t == 0.0 or t >= 6.0:  # hanging at rest: a vector relative degree, which is lost in motion
            assert local.relative_degree == (4, 2) and local.decoupling_rank == 2 and local.essential_orders == (4, 2)
        elif abs(t - 3.0) > 1e-3:
            assert local.relative_degree == (2, 2) and local.decoupling_rank == 1
            assert local.essential_orders == (4, 4)
        else:  # the rope hangs, but turns
            assert local.relative_degree == (3, 2) and local.decoupling_rank == 1
    assert "differs at" in repr(structure)


@pytest.mark.parametrize("name", ["two-cars", "vtol", "crane-3d-redundant"])
def test_the_structure_is_the_same_in_motion(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    t = np.linspace(*scene.t_span, 9)[1:-1]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span, t_eval=t)
    at = [k for k, instant in enumerate(run.t) if abs(instant - np.mean(scene.t_span)) > 1e-3 and instant in t]
    structure = model.structure(run.t[at], run.jets[:, at])
    seeded = model.structure()
    assert structure.zeros_at_infinity == seeded.zeros_at_infinity and structure.index == seeded.index
    assert {local.index for _, local in structure.at} == {seeded.index}


def test_the_essential_order_is_the_class_that_a_path_needs():
    mechanism, _ = vtol()
    p = mechanism.parameters
    x, z, theta = mechanism.q
    height = p.J * ca.sin(p.tilt) / (p.M * (p.l * ca.cos(p.tilt) + p.h * ca.sin(p.tilt)))
    paths = [sv.paths.rest_to_rest((0.0, 0.0), (5.0, 2.0), duration=4.0, smoothness=k) for k in (3, 4)]
    r = mechanism.q.references(across=None, up=None)
    program = sv.Program({"X": x - height * ca.sin(theta) - r.across, "Z": z + height * ca.cos(theta) - r.up})
    model = sv.derive(mechanism, program)
    assert model.flat
    rough, smooth = (model.with_references(across=path[0], up=path[1]) for path in paths)
    assert sv.simulate(smooth, smooth.start(), (0.0, 5.0)).success
    with refused(sv.errors.SpecificationError, needs=4, has=3, t=4.0):
        sv.simulate(rough, rough.start(), (0.0, 5.0))


# units and margins ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "factor"),
    [("overhead-crane", 1e-9), ("winch-crane-redundant", 1e9), ("vtol", 1e-9), ("passive-arm", 1e9)],
)
def test_the_structure_does_not_depend_on_units(name, factor):
    mechanism, program = gallery[name].build()
    residuals = {key: factor ** (1 - 2 * (i % 2)) * e for i, (key, e) in enumerate(program.residuals.items())}
    model = sv.derive(mechanism, sv.Program(residuals, by=program.by))
    check(model, TABLE[name])
    assert model.structure().margin > 0.1


def test_the_margin_shrinks_where_the_guide_becomes_horizontal():
    margins = [sv.derive(*mass_on_car(alpha)).reduction.rank.kept for alpha in (np.pi / 4, 1e-1, 1e-2, 1e-3)]
    assert margins[0] > 0.1
    assert margins[1:] == pytest.approx([1e-2, 1e-4, 1e-6], rel=0.1)  # sin² alpha


@pytest.mark.parametrize("damping", [0.0, 1.0])
def test_a_rank_that_cannot_be_told_is_refused(damping):
    with refused(sv.errors.SingularProgram, "z", "balance of s"):
        sv.derive(*mass_on_car(1e-6, damping))


def test_the_margin_of_the_critical_arm_is_small():
    regular, critical = (sv.derive(*passive_arm(Gamma)) for Gamma in (0.3, 0.4))
    assert critical.reduction.rank.kept < 0.02 < 0.2 < regular.reduction.rank.kept
    assert f"smallest pivot {critical.reduction.rank.kept:.1e}" in critical.details


# states at which relative degrees are lost ---------------------------------------------------------------------------


def fixed_rope_crane(length=1.0, target=None, damping=0.0):
    """A cart with a pendulum, and X the load's place: X'' contains the force times sin² theta."""
    q = sv.coordinates("x theta")
    x, theta = q
    load = ca.vertcat(x + length * ca.sin(theta), -length * ca.cos(theta))
    if target is None:
        path = q.references(X=sv.paths.rest_to_rest(0.0, 3.0, duration=4.0, smoothness=4)).X
    else:
        path = target(q.t)
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, 10.0, x) + sv.particle(q, 2.0, load), potential=2.0 * 9.81 * load[1],
        forces={"x": -damping * q.dt(x)}, actuators={"force": x},
    )  # fmt: skip
    return sv.derive(mechanism, sv.Program({"X": load[0] - path}))


def ball_and_beam():
    """r'' = r θ'² - g sin θ: degree 3 in motion by r θ'², 4 where the beam rests."""
    q = sv.coordinates("r theta")
    r, theta = q
    ball = ca.vertcat(r * ca.cos(theta), r * ca.sin(theta))
    gibbs = sv.particle(q, 0.05, ball) + 0.02 * q.d(2)[1] ** 2 / 2
    mechanism = sv.Mechanism(q, gibbs=gibbs, potential=0.05 * 9.81 * ball[1], actuators={"torque": theta})
    return sv.derive(mechanism, sv.Program({"r": r - 0.3 - 0.1 * ca.sin(q.t)}))


LOST = {  # the model, degrees in motion and at the start, a jet that is zero there
    "crane": (fixed_rope_crane, 2, 4, "theta"),
    "crane with friction": (partial(fixed_rope_crane, damping=3.0), 2, 4, "theta"),
    "crane in mm": (partial(fixed_rope_crane, 1000.0), 2, 4, "theta"),
    "short crane": (partial(fixed_rope_crane, 0.01), 2, 4, "theta"),
    "crane on a sine": (partial(fixed_rope_crane, 1.0, lambda t: 0.3 * ca.sin(t)), 2, 4, "theta"),
    "ball and beam": (ball_and_beam, 3, 4, "dtheta"),
}


@pytest.mark.usefixtures("uncompiled")
@pytest.mark.parametrize("name", LOST)
def test_a_relative_degree_that_is_lost_at_the_start_is_told_with_that_of_the_motion(name):
    build, moving, resting, zero = LOST[name]
    model = build()
    structure = model.structure()
    assert structure.relative_degree == (moving,) and structure.uniform
    t, local = structure.start
    assert local.relative_degree == local.zeros_at_infinity == (resting,) and zero in local.zero
    assert f"{zero} = 0" in repr(structure) and f" {resting}" in repr(structure) and "lost" in repr(structure)
    start = model.start()
    assert model.structure(start).at == ((0.0, local),)
    with refused(sv.errors.SingularProgram, f"{zero} = 0", relative_degree=(resting,), in_motion=(moving,)) as caught:
        sv.simulate(model, start, (0.0, 4.0))
    assert "square" not in str(caught.value) and caught.value.details["t"] == 0.0


def test_a_relative_degree_that_is_lost_on_the_way_is_told():
    """The pendulum swings down: theta = 0 at t = 0.78 s."""
    model = fixed_rope_crane(target=lambda t: 0.5 * ca.sin(t))
    start = model.start(t=0.7, theta=0.2, dtheta=0.3)
    with refused(sv.errors.SingularProgram, "theta = 0", relative_degree=(4,), in_motion=(2,), zero=["theta"]) as caught:
        sv.simulate(model, start, (0.7, 4.0))
    run = caught.value.run
    assert 0 < run["theta"][-1] < 0.1 and caught.value.details["t"] == pytest.approx(0.7786, abs=1e-3)
    along = model.structure(run)
    assert along.relative_degree == (2,) and len(along.at) <= 50


def test_the_place_of_a_lost_relative_degree_need_not_be_zero():
    """The rope upside down."""
    model = fixed_rope_crane()
    with refused(sv.errors.SingularProgram, "theta = 3.142", relative_degree=(4,), zero=[]):
        sv.simulate(model, model.start(theta=np.pi), (0.0, 1.0))


def test_a_swinging_load_has_the_degree_of_the_hanging_one():
    """Through theta = 0 no motion of this program passes; the degree there is that of the plant's own motion."""
    model = fixed_rope_crane(target=lambda t: 0.5 * ca.sin(t))
    for rate in (0.0, 0.3, -1.0):
        structure = model.structure(model.start(t=0.7, theta=0.0, dtheta=rate))
        assert structure.relative_degree == (4,) and structure.at[0][1].zero == ("theta",)


def test_an_entry_that_cancels_to_rounding_is_no_relative_degree():
    """The ball's inertia is uncoupled, -r cos sin + r sin cos = 0: every instant of its motion has the degree 3."""
    assert {local.relative_degree for _, local in ball_and_beam().structure().at} == {(3,)}


def test_the_structure_of_a_run_and_of_a_start(gallery_model, crane_plan):
    model = crane_plan.model
    structure = model.structure(crane_plan)
    assert 40 <= len(structure.at) <= 50 and structure.at[0][0] == 0.0 and structure.at[-1][0] == 8.0
    assert structure.zeros_at_infinity == (2, 4) and not structure.uniform
    assert structure.at[0][1].relative_degree == (4, 2) and structure.at[0][1].zero == ("theta",)
    start = model.start(guess={"l": 4.0})
    assert model.structure(start).relative_degree == (4, 2)


@pytest.mark.parametrize(
    "motion",
    [
        lambda m, run: ("run",),
        lambda m, run: (run.t,),
        lambda m, run: (run.t, run.jets[:3]),
        lambda m, run: (run.t[:5], run.jets),
        lambda m, run: (run.t, run.jets * np.nan),
        lambda m, run: ([], np.zeros((9, 0))),
    ],
)
def test_what_is_no_motion_is_refused(motion, crane_plan):
    with refused(sv.errors.SpecificationError, "run.jets"):
        crane_plan.model.structure(*motion(crane_plan.model, crane_plan))


def test_the_structure_of_a_run_of_another_model_is_refused(gallery_model, crane_plan):
    with refused(sv.errors.SpecificationError):
        gallery_model("two-cars").structure(crane_plan)


@pytest.mark.parametrize("alpha", [1e-2, 1e-3, 1e-4])
def test_the_structure_has_the_margin_of_the_reduction(alpha):
    model = sv.derive(*mass_on_car(alpha))
    assert model.structure().margin <= model.reduction.rank.kept == pytest.approx(alpha**2, rel=0.1)


@pytest.mark.parametrize("chart", ["a b", "b a"])
def test_a_load_is_judged_where_its_angles_are_regular(chart):
    q = sv.coordinates("x y z a b")
    x, y, z, a, b = q
    load = ca.vertcat(x, y, z)  # one angle loses its inertia where the other is a right angle
    if chart == "a b":
        load += ca.vertcat(ca.sin(a), ca.cos(a) * ca.sin(b), -ca.cos(a) * ca.cos(b))
    else:
        load += ca.vertcat(ca.cos(b) * ca.sin(a), ca.sin(b), -ca.cos(a) * ca.cos(b))
    S = sv.particle(q, 1.0, ca.vertcat(x, y, z)) + sv.particle(q, 0.4, load)
    vehicle = sv.Mechanism(q, S, 9.81 * (z + 0.4 * load[2]), {"Fx": x, "Fy": y, "Fz": z})
    path = sv.paths.rest_to_rest((0.0, 0.0, 0.0), (3.0, 2.0, 1.0), duration=4.0)
    r = q.references(X=path[0], Y=path[1], Z=path[2])
    model = sv.derive(vehicle, sv.Program({name: load[i] - r[name] for i, name in enumerate("XYZ")}))
    structure = model.structure()
    assert structure.zeros_at_infinity == (2, 4, 4) and "differs" not in str(structure)
    plan = sv.simulate(model, model.start(), (0.0, 4.0), t_eval=np.linspace(0.0, 4.0, 101))
    assert sv.verify(plan).passed


def test_a_structure_without_all_zeros_at_infinity_says_so(monkeypatch):
    monkeypatch.setattr("servoctl.reduction.structure.DEPTHS", (2, 3))
    model = sv.derive(*gallery["two-cars"].build())
    structure = model.structure()
    assert structure.index is None and structure.realisation == "undecided" and structure.zeros_at_infinity == ()
    assert "not decided" in repr(structure) and "two" not in repr(structure)
    assert repr(model)
