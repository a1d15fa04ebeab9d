"""Pictures of mechanisms: where their shapes are, that up is up, and what the files hold."""

import io
import json
import pickle
import re
import shutil
import stat
import subprocess
import xml.etree.ElementTree as ET

import casadi as ca
import numpy as np
import pytest
import robots
from PIL import Image
from refusals import refused

import servoctl as sv
from servoctl.errors import NameUnknown, ServoError, SpecificationError
from servoctl.figures import page_motion, style
from servoctl.figures.animation import MOST_FRAMES, shows_mechanism
from servoctl.gallery import gallery
from servoctl.spec.shapes import heights, moved


@pytest.fixture(scope="module")
def crane(gallery_model):
    model, scene = gallery_model("overhead-crane"), gallery["overhead-crane"]
    return sv.simulate(model, model.start(guess=scene.guess), (0.0, 1.0), t_eval=np.linspace(0.0, 1.0, 41))


@pytest.fixture(scope="module")
def loop(crane):
    plant = sv.plant(crane.model.reduction.mechanism, m_load=130.0)
    law = sv.lqr(crane, sv.plant(crane.model.reduction.mechanism), 50.0)
    return sv.close(plant, law, crane.state(0.0), (0.0, 1.0))


def at_random(mechanism, count=3, **values):
    """The shapes at random coordinates, or at given ones."""
    q = np.random.default_rng(7).uniform(0.2, 1.2, (mechanism.q.nq, count))
    for name, value in values.items():
        q[mechanism.q.names.index(name)] = value
    named = dict(zip(mechanism.q.names, q, strict=True))
    return moved(mechanism, np.zeros(count), q, mechanism.parameters.values({})), named


# --- where shapes are


@pytest.mark.parametrize("name", gallery)
def test_every_scene_has_shapes_in_one_space(name):
    mechanism, _ = gallery[name].build()
    shapes, _ = at_random(mechanism)
    assert {points.shape[0] for points in shapes.values()} in ({2}, {3})
    assert all(np.isfinite(points).all() for points in shapes.values())
    assert any(np.ptp(points, axis=-1).max() > 1e-3 for points in shapes.values())


def test_links_keep_their_lengths_and_ropes_theirs():
    shapes, q = at_random(gallery["pendubot"].build()[0])
    for link, length in (("first link", 0.6), ("second link", 0.5)):
        assert np.linalg.norm(shapes[link][:, 1] - shapes[link][:, 0], axis=0) == pytest.approx(length)
    end = 0.6 * np.sin(q["q1"]) + 0.5 * np.sin(q["q1"] + q["q2"])
    assert shapes["end"][1, 0] == pytest.approx(end)
    shapes, q = at_random(gallery["crane-3d"].build()[0])
    assert np.linalg.norm(np.diff(shapes["rope"], axis=1)[:, 0], axis=0) == pytest.approx(q["l"])
    assert (shapes["load"][2, 0] < 0).all()  # below the trolley, whose height is zero


def test_the_spatial_arm_is_a_chain_of_equal_rods():
    from servoctl.gallery import spatial_arm

    shapes, q = at_random(spatial_arm(3)[0])
    rods = np.diff(shapes["links"], axis=1)
    assert np.linalg.norm(rods, axis=0) == pytest.approx(0.5)
    one, two = q["theta1"], q["theta2"]
    along = [np.cos(one) * np.cos(two), np.sin(one) * np.cos(two), -np.sin(two)]  # about z, then about y
    assert rods[:, 1] == pytest.approx(0.5 * np.array(along))
    bodies, _ = at_random(spatial_arm(3, "bodies")[0], **{name: values for name, values in q.items()})
    assert bodies["links"] == pytest.approx(shapes["links"])


def test_the_wheel_touches_the_ground_and_its_spoke_rolls():
    shapes, q = at_random(gallery["appell-hamel"].build()[0])
    wheel = shapes["wheel"]
    centre, rim = wheel[:, 0], wheel[:, 1:-1]
    assert np.linalg.norm(rim - centre[:, None], axis=0) == pytest.approx(0.5)
    ahead = np.array([np.cos(q["theta"]), np.sin(q["theta"]), 0 * q["theta"]])
    spoke = rim[:, 0] - centre
    assert (spoke * ahead).sum(axis=0) == pytest.approx(0.5 * np.cos(q["phi"]))
    assert spoke[2] == pytest.approx(-0.5 * np.sin(q["phi"]))  # the top of the wheel goes ahead


def test_boxes_and_springs():
    corners = np.array(ca.evalf(ca.horzcat(*sv.shapes.box((1.0, 2.0), 0.6, 0.2, np.pi / 2))))
    assert corners[:, :-1].mean(axis=1) == pytest.approx([1.0, 2.0])
    assert np.ptp(corners, axis=1) == pytest.approx([0.2, 0.6]) and np.array_equal(corners[:, 0], corners[:, -1])
    zigzag = np.array(ca.evalf(ca.horzcat(*sv.shapes.spring((0.0, 0.0), (3.0, 4.0), 0.2, coils=2))))
    aside = np.array([-0.8, 0.6]) @ zigzag
    assert np.ptp(aside) == pytest.approx(0.2, rel=1e-6) and zigzag[:, -1] == pytest.approx([3.0, 4.0])
    assert np.isfinite(np.array(ca.evalf(ca.horzcat(*sv.shapes.spring((1.0, 1.0), (1.0, 1.0), 0.2))))).all()


def two_masses(shapes=None, **rest):
    p = sv.parameters(m=1.0, g=9.81)
    q = sv.coordinates("x y far")
    x, y, far = q
    S = sv.particle(q, p.m, ca.vertcat(x, y)) + sv.particle(q, p.m, far)
    shapes = {"near": [(x, y)], "far": [(x, y), (far, 0)]} if shapes is None else shapes(q, p)
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"u": x, "v": y}, parameters=p, shapes=shapes, **rest)
    return mechanism, sv.Program({"X": x - q.t**2, "Y": y - q.t}, by="actuators")


def test_arrays_hold_a_point_in_each_row():
    mechanism, _ = two_masses(lambda q, p: {"ground": np.array([[0.0, 1.0], [2.0, 3.0], [4.0, 5.0]])})
    assert at_random(mechanism, 1)[0]["ground"][:, :, 0] == pytest.approx(np.array([[0.0, 2.0, 4.0], [1.0, 3.0, 5.0]]))


def test_shapes_of_what_plays_no_part_are_left_out():
    model = sv.derive(*two_masses())
    assert list(model.reduction.mechanism.shapes) == ["near"]
    assert list(sv.derive(*two_masses(), keep=["far"]).reduction.mechanism.shapes) == ["near", "far"]


def test_shapes_count_for_equality_and_survive_a_pickle(crane):
    assert two_masses()[0] != two_masses(lambda q, p: {"near": [(q["x"], 0)]})[0] and two_masses()[0] == two_masses()[0]
    copy = pickle.loads(pickle.dumps(crane.model)).reduction.mechanism
    mechanism = crane.model.reduction.mechanism
    one, other = at_random(mechanism)[0], at_random(copy)[0]
    assert list(one) == list(other) and all(np.array_equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize(
    ("shapes", "facts"),
    [
        (lambda q, p: {"rope": []}, {"name": "rope"}),
        (lambda q, p: {"rope": [(q["x"], 0), (0, 0, 0)]}, {"what": "The shape 'rope', point 2,", "entries": 3, "sizes": (2,)}),
        (lambda q, p: {"rope": [q["x"]]}, {"entries": 1, "sizes": (2, 3)}),
        (lambda q, p: {"rope": [(q["x"], 0)], "far": [(0, 0, 0)]}, {"what": "The shape 'far', point 1,", "sizes": (2,)}),
        (lambda q, p: {"rope": [(q.d(1)[0], 0)]}, {"what": "The shape 'rope'", "order": 1, "limit": 0}),
        (lambda q, p: {"rope": [(ca.SX.sym("y"), 0)]}, {"name": "y"}),
        (lambda q, p: {"rope": [(np.nan, 0)]}, {}),
        (lambda q, p: [(0, 0)], {}),
        (lambda q, p: {"rope": "xy"}, {"name": "rope"}),
        (lambda q, p: {"rope": ca.SX.zeros(2, 3)}, {"name": "rope"}),  # columns or rows?
    ],
)
def test_what_is_no_shape_is_refused(shapes, facts):
    with refused(SpecificationError, **facts):
        two_masses(shapes)


# --- up is up


def test_depth_is_drawn_downwards(gallery_model):
    for name, axes in (("overhead-crane", ("X [m]", "Z [m]")), ("crane-3d", ("X [m]", "Z [m]"))):
        model, scene = gallery_model(name), gallery[name]
        run = sv.simulate(model, model.start(guess=scene.guess), (0.0, 3.0), t_eval=[0.0, 1.5, 3.0])
        ax = sv.figures.path(run)
        assert (ax.get_xlabel(), ax.get_ylabel()) == axes and ax.yaxis_inverted()


@pytest.mark.parametrize(
    ("rest", "signs"),
    [
        (lambda y, p: {"potential": p.m * p.g * y}, [0, 1]),
        (lambda y, p: {"potential": -p.m * p.g * y}, [0, -1]),
        (lambda y, p: {"forces": {"y": p.m * p.g}}, [0, -1]),
        (lambda y, p: {}, [0, 0]),
        (lambda y, p: {"potential": 50 * (y - 0.5) ** 2}, [0, 0]),  # a spring pulls to both sides
        (lambda y, p: {"forces": {"y": p.m * p.g, "x": 1.0}}, [0, 0]),  # an oblique force is no weight
    ],
)
def test_height_is_what_weight_acts_along(rest, signs):
    p, q = sv.parameters(m=2.0, g=9.81), sv.coordinates("x y")
    mechanism = sv.Mechanism(q, gibbs=sv.particle(q, p.m, ca.vertcat(*q)), parameters=p, **rest(q["y"], p))
    places = np.array([[0.0, 0.3, 1.0], [0.0, 0.4, 1.0]])
    assert heights(mechanism, ["x", "y"], np.zeros(3), places, [2.0, 9.81]) == signs


# --- animations


def test_an_animation_shows_the_motion(crane):
    shown = sv.figures.animate(crane, fps=20)
    assert (len(shown.t), shown.pace, shown.space) == (41, 0.5, False)  # a second, shown in two
    assert "slowed down 2 times" in repr(shown)
    assert shown.shapes["load"] == pytest.approx(np.array([crane["X"], -crane["Z"]]), abs=1e-9)
    assert shown.shapes["rope"][:, 0] == pytest.approx(np.array([crane["x"], 0 * crane["x"]]), abs=1e-9)
    assert shown.trails["load"] is not shown.shapes["load"] and list(shown.trails) == ["load"]
    X, height = shown.programmed["load"]
    assert height == pytest.approx(-4 + 2 * X / 5, abs=1e-9)
    assert list(sv.figures.animate(crane, trail=["trolley", "load"]).trails) == ["trolley", "load"]
    assert sv.figures.animate(crane, trail=()).programmed == {}
    middle = sv.figures.animate(crane, fps=20, trail="trolley").trails["trolley"]
    assert middle == pytest.approx(np.array([crane["x"], 0 * crane["x"]]), abs=1e-9)  # of a body


def test_the_path_of_a_loop_lies_over_that_of_its_plan(crane, loop):
    shown = sv.figures.animate(loop, fps=25)
    assert shown.trails["load"] == pytest.approx(np.array([loop["X"], -loop["Z"]]), abs=1e-9)
    X, height = shown.programmed["load"]
    assert height == pytest.approx(-4 + 2 * X / 5, abs=1e-6)
    assert np.abs(shown.trails["load"][1] - (-4 + 2 * shown.trails["load"][0] / 5)).max() > 1e-3  # a heavier load


def test_a_file_has_the_frames_and_the_load_rises(crane, tmp_path):
    path = sv.figures.animate(crane, fps=10).save(tmp_path / "crane")
    assert path.name == "crane.gif"
    picture = Image.open(path)
    assert (picture.n_frames, picture.info["loop"], picture.info["duration"]) == (21, 0, 100)
    lines = []
    for frame in (0, 20):
        picture.seek(frame)
        red, _, blue = np.moveaxis(np.asarray(picture.convert("RGB")).astype(int), -1, 0)
        lines.append(np.nonzero(red - blue > 120)[0].min())
    assert lines[1] < lines[0]  # rows of pixels count downwards
    html = sv.figures.animate(crane, fps=1)._repr_html_()
    assert html.startswith("<img ") and "data:image/gif;base64," in html


def test_a_long_motion_is_shown_faster(crane):
    fps, run = 50, sv.simulate(crane.model, crane.start, (0.0, 40.0), t_eval=np.linspace(0.0, 40.0, 401))
    shown = sv.figures.animate(run, fps=fps)
    assert len(shown.t) == MOST_FRAMES and shown.pace == pytest.approx(40 * fps / (MOST_FRAMES - 1))
    assert "times as fast" in repr(shown)
    assert next(shown._frames()).shape[-1] == 3  # the clock of a frame says so as well


def drawn_by_its_script(page, frame):
    """What the script of a page writes into the clock, and into each moving line, at a frame."""
    if shutil.which("node") is None:
        pytest.skip("needs node")
    data = re.search('<script type="application/json">(.*?)</script>', page)[1]
    script = re.search("<script>(.*?)</script>", page, re.S)[1]
    elements = "Array.from({length: %d}, () => ({setAttribute(name, value) { this[name] = value; }}))"
    moving, trails = (elements % len(json.loads(data)[name]) for name in ("shapes", "trails"))
    program = f"""
        const moving = {moving}, trails = {trails}, button = {{}}, input = {{value: 0}}, output = {{}}, queue = [];
        const found = {{"script[type='application/json']": {{textContent: {json.dumps(data)}}}, button, input, output}};
        const figure = {{querySelector: (s) => found[s], querySelectorAll: (s) => (s === ".moving" ? moving : trails)}};
        globalThis.document = {{currentScript: {{parentElement: figure}}}};
        globalThis.requestAnimationFrame = (call) => queue.push(call);
        {script}
        queue.shift()(500);
        queue.shift()(500 + {frame} * 1000 / JSON.parse({json.dumps(data)}).fps + 1);
        button.onclick();
        queue.shift()(1e9);
        console.log(JSON.stringify([output.textContent, button.textContent, input.value, moving, trails]));
    """
    done = subprocess.run(["node", "-e", program], capture_output=True, text=True, check=True)
    return json.loads(done.stdout)


def points_of(text):
    return np.array([point.split(",") for point in text.split()], dtype=float)


def test_a_page_moves_the_lines_by_its_script(crane, tmp_path):
    shown = sv.figures.animate(crane, fps=10)
    page = shown.save(tmp_path / "crane.html").read_text(encoding="utf-8")
    assert not re.search("href|https?://|src=", page)
    drawing = ET.fromstring(re.search("<svg.*?</svg>", page, re.S)[0])
    bar = points_of(drawing.findall("polyline")[-1].get("points"))
    scale = (bar[1] - bar[0])[0] / float(drawing.find("text").text.split()[0])  # units of the drawing in a metre
    clock, button, frame, moving, (trail,) = drawn_by_its_script(page, 15)
    assert (clock, button, frame) == ("t = 0.75 s, slowed down 2 times", "Play", 15)
    load, start = points_of(moving[-1]["points"]), points_of(drawing.findall("polyline")[-2].get("points"))
    assert np.array_equal(load[0], load[1])  # a dot, drawn last
    moved_by = [crane["X"][30] - crane["X"][0], crane["Z"][30] - crane["Z"][0]]  # Z points down, as the drawing's y
    assert load[0] - start[0] == pytest.approx(scale * np.array(moved_by), abs=1.0) and crane.t[30] == 0.75
    assert np.array_equal(points_of(trail["points"])[-1], load[0]) and len(trail["points"].split()) == 16


def test_a_page_of_many_points_leaves_frames_out(crane, monkeypatch):
    shown = sv.figures.animate(crane, fps=40)
    whole, t = shown.html(), shown.t
    monkeypatch.setattr(page_motion, "MOST_POINTS", 40 * 10)
    data = json.loads(re.search('<script type="application/json">(.*?)</script>', shown.html())[1])
    every = round(shown.fps / data["fps"])
    assert every > 1 and data["t"] == pytest.approx(t[::every]) and len(shown.html()) < len(whole)
    assert {len(frames) for frames in (*data["shapes"], *data["trails"])} == {len(data["t"])}


@pytest.mark.parametrize("name", ["crane-3d", "appell-hamel", "wheeled-robot", "two-cars", "vtol"])
def test_bodies_lie_below_lines_and_lines_below_dots_in_a_page(name, gallery_model):
    model, scene = gallery_model(name), gallery[name]
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), (0.0, 0.2), t_eval=np.linspace(0.0, 0.2, 5))
    drawing = ET.fromstring(re.search("<svg.*?</svg>", sv.figures.animate(run).html(), re.S)[0])
    looks = ["body" if line.get("fill") != "none" else "dot" if line.get("stroke") == style.COLOURS[1] else "line"
             for line in drawing.findall("polyline") if line.get("class") == "moving"]  # fmt: skip
    assert looks == sorted(looks, key=["body", "line", "dot"].index) and looks
    assert (drawing.find("text") is None) == (name in ("crane-3d", "appell-hamel"))  # a projection has no scale


def test_films_are_written_by_ffmpeg(crane, tmp_path, monkeypatch):
    shown = sv.figures.animate(crane, fps=1)
    monkeypatch.setenv("PATH", str(tmp_path))
    with refused(ServoError, "ffmpeg"):
        shown.save(tmp_path / "crane.mp4")
    program = tmp_path / "ffmpeg"
    program.write_text('#!/bin/sh\nfor last; do :; done\n/bin/cat > "$last"\necho "$@" > "$last.txt"\n', encoding="utf-8")
    program.chmod(program.stat().st_mode | stat.S_IEXEC)
    raw = shown.save(tmp_path / "crane.mp4").read_bytes()
    words = (tmp_path / "crane.mp4.txt").read_text(encoding="utf-8").split()
    width, height = map(int, words[words.index("-s") + 1].split("x"))
    assert width % 2 == height % 2 == 0 and len(raw) == 3 * width * height * 3 and words[words.index("-r") + 1] == "1"
    program.write_text("#!/bin/sh\necho broken codec >&2\nexit 1\n", encoding="utf-8")
    with refused(ServoError, "broken codec"):
        shown.save(tmp_path / "crane.mp4")


def test_a_spatial_mechanism_is_projected_with_up_up(gallery_model):
    model, scene = gallery_model("crane-3d"), gallery["crane-3d"]
    run = sv.simulate(model, model.start(guess=scene.guess), scene.t_span, t_eval=np.linspace(*scene.t_span, 25))
    shown = sv.figures.animate(run, fps=4)
    assert shown.space and shown.shapes["load"][1, -1] > shown.shapes["load"][1, 0]  # it is lifted
    assert len(Image.open(io.BytesIO(shown.gif())).getbbox()) == 4


def test_a_mechanism_without_shapes_is_shown_by_its_positions():
    p, q = sv.parameters(m=2.0, g=9.81), sv.coordinates("x z")  # z down
    x, z = q
    mechanism = sv.Mechanism(
        q, gibbs=sv.particle(q, p.m, ca.vertcat(x, z)), potential=-p.m * p.g * z, actuators={"a": x, "b": z}, parameters=p
    )
    model = sv.derive(mechanism, sv.Program({"X": x - q.t, "Z": z - q.t**2}, by="actuators"))
    shown = sv.figures.animate(sv.simulate(model, model.start(), (0.0, 1.0)), fps=10)
    assert shown.shapes["x, z"] == pytest.approx(np.array([shown.t, -(shown.t**2)]), abs=1e-6)


def test_poses_are_drawn_at_instants(crane, gallery_model):
    ax = sv.figures.stroboscope(crane, poses=4, title="crane")
    assert ax.get_title() == "crane" and ax.get_aspect() == 1.0
    dots = [line for line in ax.get_lines() if line.get_marker() == "o"]
    places = np.array([line.get_xydata()[0] for line in dots])
    expected = [[crane["X"][k], -crane["Z"][k]] for k in (0, -1)]
    assert len(dots) == 4 and places[[0, -1]] == pytest.approx(np.array(expected), abs=1e-9)
    assert sv.figures.stroboscope(crane, poses=1) is not None
    model = gallery_model("two-cars")
    run = sv.simulate(model, model.start(), (0.0, 2.0), t_eval=np.linspace(0.0, 2.0, 21))
    ax = sv.figures.stroboscope(run, poses=5)  # on one line: one below the other
    assert [label.get_text() for label in ax.get_yticklabels()] == ["0", "0.5", "1", "1.5", "2"]
    assert (np.diff(ax.get_yticks()) < 0).all() and ax.get_ylabel() == "t [s]"


@pytest.mark.parametrize(("reach", "apart"), [(0.1, True), (8.0, False)])
def test_poses_that_would_hide_each_other_are_side_by_side(reach, apart):
    q = sv.coordinates("turn x", units="rad m")
    turn, x = q
    rim = [ca.vertcat(x + ca.cos(turn + a), ca.sin(turn + a), 0) for a in np.linspace(0.0, 2 * np.pi, 9)]
    shapes = {"rim": rim, "spoke": [ca.vertcat(x, 0, 0), rim[0]]}
    S = sv.particle(q, 1.0, x) + sv.rigid_body(q, 1.0, (0, 0, 1.0), position=ca.vertcat(x, 0, 0), rates=(0, 0, q.d(1)[0]))
    mechanism = sv.Mechanism(q, gibbs=S, actuators={"M": turn, "F": x}, shapes=shapes)
    program = sv.Program({"turns": turn - np.pi * q.t, "goes": x - reach * q.t}, by="actuators")
    model = sv.derive(mechanism, program)
    run = sv.simulate(model, model.start(), (0.0, 1.0))
    ax = sv.figures.stroboscope(run, poses=5)
    instants = [entry for entry in ax.texts if entry.get_text().endswith(" s")]
    assert [entry.get_text() for entry in instants] == (["0 s", "0.25 s", "0.5 s", "0.75 s", "1 s"] if apart else [])
    if apart:  # three in the first row, two below them
        columns, rows = np.array([entry.get_position() for entry in instants]).T
        assert np.ptp(rows[:3]) < 1e-12 > np.ptp(rows[3:]) and rows[3] < rows[0]
        assert columns[:2] == pytest.approx(columns[3:]) and (np.diff(columns[:3]) > 1.5).all()


def test_what_cannot_be_animated_is_refused(crane, loop, tmp_path):
    for fps in (0.5, 1000, np.nan, "fast"):
        with refused(SpecificationError):
            sv.figures.animate(crane, fps=fps)
    with refused(NameUnknown, match="load"):
        sv.figures.animate(crane, trail="lod")
    with refused(SpecificationError, type="int"):
        sv.figures.animate(3)
    loaded = sv.load(crane.save(tmp_path / "crane"))
    assert not shows_mechanism(loaded) and shows_mechanism(crane) and shows_mechanism(loop)
    with refused(SpecificationError, "sv.load(path, model)"):
        sv.figures.animate(loaded)
    with refused(SpecificationError, suffix=".webm"):
        sv.figures.animate(crane, fps=1).save(tmp_path / "crane.webm")
    q = sv.coordinates("a b")
    model = sv.derive(sv.Mechanism(q, gibbs=sv.particle(q, 1.0, ca.vertcat(*q)), actuators={"u": q["a"], "v": q["b"]}),
                      sv.Program({"A": q["a"] - q.t, "B": q["b"]}, by="actuators"))  # fmt: skip
    run = sv.simulate(model, model.start(), (0.0, 0.1))
    assert not shows_mechanism(run)
    with refused(SpecificationError, "shapes=", coordinates=["a", "b"], outputs=[]):
        sv.figures.animate(run)


@pytest.mark.parametrize(("name", "base"), [("six_axis_arm", "fixed"), ("quadruped", "free"), ("scara", "fixed")])
def test_a_robot_is_drawn_by_its_frames(name, base):
    robot = sv.urdf(robots.file_of(name), base=base)
    mechanism, posture = robot.mechanism(friction=0.0), {q: 0.1 * i for i, q in enumerate(robot.joints) if q in robot.q.names}
    shapes = moved(mechanism, [0.0], robot.posture(posture)[:, None], robot.parameters.values({}))
    assert set(shapes) < set(robot.links)  # all but the root
    for link, points in shapes.items():
        assert points[:, -1, 0] == pytest.approx(robot.at(posture, link)[0], abs=1e-12)
    starts = {tuple(np.round(points[:, 0, 0], 9)) for points in shapes.values()}
    ends = {tuple(np.round(points[:, -1, 0], 9)) for points in shapes.values()}
    assert len(starts - ends) <= 1  # a tree: each link begins where another ends, or at the root


def test_motions_of_every_kind_are_drawn(crane, loop, tmp_path):
    mechanism, start = crane.model.reduction.mechanism, crane.start
    runs = {
        "one sample": sv.simulate(crane.model, start, (0.0, 1.0), t_eval=[0.5]),
        "two samples": sv.simulate(crane.model, start, (0.0, 1.0), t_eval=[0.0, 1.0]),
        "loaded": sv.load(crane.save(tmp_path / "crane"), crane.model),
        "under its own weight": sv.simulate(sv.plant(mechanism), crane.state(0.0), (0.0, 1.0)),
        "without feedback": sv.close(loop.plant, sv.feedforward(crane, loop.plant, 50.0), crane.state(0.0), (0.0, 1.0)),
    }
    for name, run in runs.items():
        shown = sv.figures.animate(run, fps=2)
        assert np.isfinite(shown.shapes["load"]).all(), name
    assert sv.figures.animate(runs["two samples"], fps=40).trails["load"] == pytest.approx(
        sv.figures.animate(crane, fps=40).trails["load"], abs=1e-3
    )  # by the polynomial between samples
    still = sv.figures.animate(runs["one sample"], fps=2)
    assert len(still.t) == 1 and Image.open(io.BytesIO(still.gif())).n_frames == 1
    copy = pickle.loads(pickle.dumps(still))
    assert copy == still
