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
    for smoothness in (3, 4):
        path = sv.paths.rest_to_rest(mechanism.q.t, (0.0, 0.0), (5.0, 2.0), duration=4.0, smoothness=smoothness)
        program = sv.Program({"X": x - height * ca.sin(theta) - path[0], "Z": z + height * ca.cos(theta) - path[1]})
        if smoothness == 3:
            with refused(sv.SpecificationError, needs=4, has=3):
                sv.derive(mechanism, program)
        else:
            assert sv.derive(mechanism, program).flat


# units and margins ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("factor", [1e-9, 1e9])
@pytest.mark.parametrize(
    "name", ["two-cars", "overhead-crane", "winch-crane-redundant", "mass-on-car", "vtol", "passive-arm"]
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
    with refused(sv.SingularProgram, "z", "balance of s"):
        sv.derive(*mass_on_car(1e-6, damping))


def test_the_margin_of_the_critical_arm_is_small():
    regular, critical = (sv.derive(*passive_arm(Gamma)) for Gamma in (0.3, 0.4))
    assert critical.reduction.rank.kept < 0.02 < 0.2 < regular.reduction.rank.kept
    assert "smallest pivot 3" in repr(critical) or f"{critical.reduction.rank.kept:.1e}" in repr(critical)
