"""Derivations on disk: the same results to the bit, nothing derived twice, and never those of another specification."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.codegen import cache
from servoctl.gallery import gallery
from servoctl.model import model as models
from servoctl.model import store
from servoctl.model.equations import signal_groups
from servoctl.model.pivots import pivot_sizes, usual_column_sizes
from servoctl.model.variants import derived_near

PACKAGE = Path(sv.__file__).parent


@pytest.fixture
def derived(monkeypatch, tmp_path):
    """A list that grows with every derivation; what is derived is kept under `tmp_path`."""
    calls, reduce = [], models.reduce
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    monkeypatch.delenv("SERVOCTL_MEMO", raising=False)
    monkeypatch.setattr(store, "_stamp", lambda: "these sources")
    monkeypatch.setattr(models, "reduce", lambda *given: calls.append(given) or reduce(*given))
    return calls


def entries(tmp_path):
    return sorted((tmp_path / "derived").glob("*"))


def pendulum(*, name="phi", m=2.0, length=0.5, path=None, by="actuators", torque="torque", output=None, gravity=9.81):
    """A driven pendulum that follows a path."""
    q = sv.coordinates(name)
    p = sv.parameters(m=m, g=9.81)
    angle = next(iter(q))
    mechanism = sv.Mechanism(
        q,
        gibbs=p.m * length**2 * q.d(2)[0] ** 2 / 2,
        potential=-p.m * (p.g if gravity == 9.81 else gravity) * length * ca.cos(angle),
        actuators={torque: angle},
        parameters=p,
        outputs=output and output(q),
    )
    return mechanism, sv.Program({"swing": angle - (ca.sin(q.t) if path is None else path(q.t))}, by=by)


def planned(name, **options):
    """Everything that a run of a scene holds, and the run."""
    scene = gallery[name]
    model = sv.derive(*scene.build())
    start = model.start(**scene.start, guess=scene.guess)
    span = (scene.t_span[0], min(scene.t_span[1], scene.t_span[0] + 1.0))
    run = sv.simulate(model, start, span, progress=False, t_eval=np.linspace(*span, 21), **options)
    signals = [run[signal] for signal in signal_groups(model.reduction)]
    return [run.t, run.jets, *signals, *usual_column_sizes(model), pivot_sizes(model)], run


CASES = [
    ("overhead-crane", {}),
    ("appell-hamel", {"method": "Taylor", "drift": "project"}),
    ("mass-on-car", {"drift": 0.1}),
    ("crane-3d", {"method": "RadauIIA"}),
]


@pytest.mark.parametrize(("name", "options"), [c for c in CASES if c[0] in gallery])
def test_the_memo_gives_the_same_run_to_the_bit_and_derives_nothing(derived, name, options, c_compiler):
    first, run = planned(name, **options)
    after_first = len(derived)
    again, repeated = planned(name, **options)
    assert after_first > 0 and len(derived) == after_first
    assert len(first) == len(again)
    assert all(np.array_equal(a, b, equal_nan=True) for a, b in zip(first, again, strict=True))
    assert repr(run.model) == repr(repeated.model)
    assert len(derived) == after_first


SECOND_PROCESS = """
import json
import servoctl as sv
from servoctl.gallery import gallery
from servoctl.model import model as models

calls, reduce = [], models.reduce
models.reduce = lambda *given: calls.append(given) or reduce(*given)
scene = gallery["overhead-crane"]
model = sv.derive(*scene.build())
run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span, progress=False)
print(json.dumps([len(calls), run["trolley"].tolist()]))
"""


def test_another_process_reads_what_one_derived(tmp_path):
    environment = {name: value for name, value in os.environ.items() if name != "SERVOCTL_MEMO"}
    environment |= {"SERVOCTL_CACHE": str(tmp_path), "PYTHONPATH": str(PACKAGE.parent)}
    command = [sys.executable, "-c", SECOND_PROCESS]
    told = [subprocess.run(command, env=environment, capture_output=True, text=True, check=True) for _ in range(2)]
    (first, forces), (second, same) = (json.loads(done.stdout) for done in told)
    assert (first, second) == (1, 0)
    assert forces == same


def test_one_specification_has_one_key(derived):
    assert store.fingerprint(*pendulum()) == store.fingerprint(*pendulum()) is not None
    assert store.fingerprint(*gallery["crane-3d"].build()) == store.fingerprint(*gallery["crane-3d"].build())


def weighted(weights):
    q = sv.coordinates("x")
    mechanism = sv.Mechanism(q, gibbs=q.d(2)[0] ** 2 / 2, actuators={"left": next(iter(q)), "right": next(iter(q))})
    return mechanism, sv.Program({"x": next(iter(q)) - q.t}, weights=weights)


def test_every_difference_makes_another_key(derived):
    near = (0.5, {"phi": 0.1, "dphi": 0.0, "d2phi": 0.0}, {"phi": 1.0})
    keys = [
        store.fingerprint(*pendulum()),
        store.fingerprint(*pendulum(name="psi")),
        store.fingerprint(*pendulum(m=np.nextafter(2.0, 3.0))),
        store.fingerprint(*pendulum(length=np.nextafter(0.5, 1.0))),
        store.fingerprint(*pendulum(path=ca.cos)),
        store.fingerprint(*pendulum(path=lambda t: ca.sin(t + 0))),
        store.fingerprint(*pendulum(path=lambda t: ca.sin(2 * t))),
        store.fingerprint(*pendulum(output=lambda q: {"height": ca.if_else(q[0] < 1, q[0], 1)})),
        store.fingerprint(*pendulum(output=lambda q: {"height": ca.if_else(q[0] <= 1, q[0], 1)})),
        store.fingerprint(*pendulum(by="ideal")),
        store.fingerprint(*pendulum(torque="motor")),
        store.fingerprint(*pendulum(gravity=9.80665)),
        store.fingerprint(*pendulum(output=lambda q: {"height": ca.cos(next(iter(q)))})),
        store.fingerprint(*pendulum(output=lambda q: {"depth": ca.cos(next(iter(q)))})),
        store.fingerprint(*pendulum(output=lambda q: {"height": ca.sin(next(iter(q)))})),
        store.fingerprint(*pendulum(), guess={"phi": 0.1}),
        store.fingerprint(*pendulum(), guess={"phi": 0.2}),
        store.fingerprint(*pendulum(), guess={"dphi": 0.1}),
        store.fingerprint(*pendulum(), near=near),
        store.fingerprint(*pendulum(), near=(0.6, *near[1:])),
        store.fingerprint(*pendulum(), near=(0.5, near[1] | {"phi": 0.2}, near[2])),
        store.fingerprint(*pendulum(), near=(0.5, near[1], {"phi": 0.5})),
        store.fingerprint(*pendulum(), values=[2.5, 9.81]),
        store.fingerprint(*weighted(None)),
        store.fingerprint(*weighted({"left": 1.0})),
        store.fingerprint(*weighted({"right": 1.0})),
        store.fingerprint(*weighted({"left": 2.0})),
        store.fingerprint(*weighted({"left": 1.0, "right": 1.0})),
    ]
    same = pendulum(path=lambda t: ca.sin(t + 0))  # CasADi drops the zero: the same expression
    assert store.fingerprint(*same) == keys[0] == keys.pop(5)
    assert None not in keys and len(set(keys)) == len(keys)


def test_sums_in_another_order_are_another_specification(derived):
    left, right = (
        store.fingerprint(*pendulum(path=path)) for path in (lambda t: (t + t**2) + t**3, lambda t: t + (t**2 + t**3))
    )
    assert left != right


def test_quasi_velocities_and_constraints_are_told_apart(derived):
    def sled(V=1.0, names="u", constraint="skate", factor=1.0, h=0.0):
        q = sv.coordinates("x").with_quasi_velocities(names, [[V]], [h])
        other = sv.coordinates("x y")
        x, y = other
        mechanism = sv.Mechanism(q, gibbs=q.w(1)[0] ** 2 / 2, actuators={"push": [1.0]})
        bound = sv.Mechanism(
            other, gibbs=(other.d(2)[0] ** 2 + other.d(2)[1] ** 2) / 2, actuators={"push": x},
            constraints={constraint: y - factor * x},
        )  # fmt: skip
        return (
            store.fingerprint(mechanism, sv.Program({"x": next(iter(q)) - q.t})),
            store.fingerprint(bound, sv.Program({"x": x - other.t})),
        )

    frames = [sled()[0], sled(V=2.0)[0], sled(names="v")[0], sled(h=0.5)[0]]
    bounds = [sled()[1], sled(constraint="wall")[1], sled(factor=2.0)[1]]
    assert len({*frames, *bounds}) == 7 and None not in frames + bounds


def test_the_key_holds_all_that_a_derivation_reads():
    told = {
        "mechanism": {"q", "balance", "mass", "energy", "forces", "followers", "E", "actuators", "constraints", "outputs",
                      "inputs", "reported", "parameters"},
        "program": {"residuals", "with_turns", "names", "by", "metric", "jumps", "weights", "toward",
                    "integrals", "stated"},
    }  # fmt: skip
    files = [*(PACKAGE / "reduction").glob("*.py"), *(PACKAGE / "model").glob("*.py")]
    files.remove(PACKAGE / "reduction" / "idle.py")  # it makes the mechanism of the key
    read = {"mechanism": set(), "program": set()}
    for path in files:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Attribute):
                owner = getattr(node.value, "id", getattr(node.value, "attr", ""))
                if owner in read:
                    read[owner].add(node.attr)
    # `as_text` holds them; `mass` is the Jacobian of `balance`; `whole` is derived by itself; the others are names
    read["mechanism"] -= {"as_text", "whole", "left_out", "no", "signals", "longer"}
    read["program"] -= {"again"}
    assert read == told


def test_what_cannot_be_told_is_derived(derived, tmp_path):
    class Own(sv.Mechanism):
        pass

    mechanism, program = pendulum()
    mechanism.__class__ = Own
    assert store.fingerprint(mechanism, program) is None
    for count in (1, 2):
        assert sv.derive(mechanism, program).flat
        assert len(derived) == count
    assert not (tmp_path / "derived").exists()


def test_a_refused_specification_is_refused_again(derived, tmp_path):
    mechanism, _ = pendulum()
    q = mechanism.q
    program = sv.Program({"a": next(iter(q)) - q.t, "b": next(iter(q)) - ca.sin(q.t)})
    for _ in range(2):
        with refused(sv.errors.SpecificationError, "contradict", rows=["a", "b"]):
            sv.derive(mechanism, program)
    with pytest.raises(sv.errors.SpecificationError):
        sv.derive(mechanism, "a program")
    with pytest.raises(sv.errors.SpecificationError):
        sv.derive(mechanism, program, guess={"phi": np.nan})
    assert len(derived) == 2 and not (tmp_path / "derived").exists()


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b[:-1], lambda b: bytes([b[0] ^ 1]) + b[1:]])
def test_a_damaged_entry_is_derived_anew(derived, tmp_path, damage):
    first, _ = planned("overhead-crane")
    whole = {path: path.read_bytes() for path in entries(tmp_path)}
    for path, content in whole.items():
        path.write_bytes(damage(content))
    again, _ = planned("overhead-crane")
    assert len(derived) == 2
    assert all(np.array_equal(a, b) for a, b in zip(first, again, strict=True))
    assert entries(tmp_path) == sorted(whole)
    planned("overhead-crane")
    assert len(derived) == 2


def test_without_a_directory_everything_is_derived(derived, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("no directory", encoding="utf-8")
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path / "file" / "cache"))
    for count in (1, 2):
        assert sv.derive(*pendulum()).flat
        assert len(derived) == count


def test_the_memo_can_be_switched_off(derived, tmp_path, monkeypatch):
    monkeypatch.setenv("SERVOCTL_MEMO", "none")
    for count in (1, 2):
        assert sv.derive(*pendulum()).flat
        assert len(derived) == count
    assert not (tmp_path / "derived").exists()


def as_text(reduction):
    """All expressions of a reduction."""
    matrices = [
        ("B", reduction.realisation.B),
        ("actuation", reduction.actuation),
        ("multipliers", ca.cse(reduction.multipliers)),  # what parts of them share is no part of the text
    ]
    rows = [(row.name, row.expression) for row in (*reduction.rows, *reduction.original.values())]
    return [(name, str(expression)) for name, expression in (*rows, *reduction.pivots, *matrices)]


@pytest.mark.parametrize("name", gallery)
def test_a_reduction_is_read_whole(derived, name):
    first, again = (sv.derive(*gallery[name].build()).reduction for _ in range(2))
    assert len(derived) == 1
    assert as_text(first) == as_text(again)
    assert all(getattr(first, name) == getattr(again, name) for name in ("rank", "follows"))
    assert np.array_equal(first.points.z, again.points.z) and np.array_equal(first.points.t, again.points.t)
    values = [r.points.evaluate(r.leading.elements()) for r in (first, again)]
    assert np.array_equal(*values)


def test_what_was_read_takes_other_numbers_as_what_was_derived(derived):
    early, late = (sv.derive(*gallery["overhead-crane"].build()) for _ in range(2))
    assert len(derived) == 1
    changed = [model.with_parameters(m_load=50.0) for model in (early, late)]
    assert len(derived) == 1
    jets = np.array([0.0, 4.0, 0.1, *np.full(6, 0.1)])
    values = [model.signals("actuation")[1](0.3, jets, model.p) for model in changed]
    assert np.array_equal(*values) and not np.array_equal(
        values[0], early.signals("actuation")[1](0.3, jets, early.p)
    )


def test_other_pivots_are_kept_too(derived):
    early, late = (sv.derive(*gallery["overhead-crane"].build()) for _ in range(2))
    jets = np.array([0.0, 4.0, 0.1, *np.full(6, 0.1)])
    found = [derived_near(model, 0.3, jets).function("path")(0.3, jets[:3], model.p) for model in (early, late)]
    assert len(derived) == 2 and np.array_equal(*found)


def test_a_changed_specification_changes_no_model(derived):
    sv.derive(*pendulum())
    mechanism, program = pendulum()
    model = sv.derive(mechanism, program)
    program.residuals["swing"] = next(iter(mechanism.q)) - ca.cos(mechanism.q.t)
    assert as_text(model.reduction) == as_text(sv.derive(*pendulum()).reduction)
    with refused(sv.errors.SpecificationError, "mechanism", "program"):
        model.signals("residuals")


def test_what_a_changed_specification_gives_is_not_kept(derived):
    made = [pendulum(output=lambda q: {"height": ca.cos(next(iter(q)))}) for _ in range(2)]
    changed, model = (sv.derive(*specification) for specification in made)
    made[0][0].outputs["height"] = ca.SX(7.0)
    with refused(sv.errors.SpecificationError, "mechanism", "program"):
        changed.signals("outputs")
    with refused(sv.errors.SpecificationError, "mechanism", "program"):
        derived_near(changed, 0.0, [0.0, 1.0, 0.0])
    assert model.signals("outputs")[1](0.0, [0.3, 0.0, 0.0], model.p) == np.cos(0.3)


def test_what_another_user_wrote_is_not_read(derived, tmp_path, monkeypatch):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    cache.read_cached(entry)
    with monkeypatch.context() as patched:
        status = os.stat(entry)
        other = SimpleNamespace(st_uid=os.geteuid() + 1, st_mode=status.st_mode, st_size=status.st_size)
        patched.setattr(os, "fstat", lambda _: other)
        with pytest.raises(PermissionError):
            cache.read_cached(entry)
        sv.derive(*pendulum())
    assert len(derived) == 2


def test_a_whole_entry_that_is_no_pickle_is_derived_anew(derived, tmp_path):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    with cache.replacing(entry) as temporary:
        Path(temporary).write_bytes(b"of another kind")
    sv.derive(*pendulum())
    assert len(derived) == 2
    sv.derive(*pendulum())
    assert len(derived) == 2


def test_least_used_entries_go_first(derived, tmp_path, monkeypatch):
    for length in (0.5, 0.6, 0.7):
        sv.derive(*pendulum(length=length))
    old, new = entries(tmp_path)[:2], entries(tmp_path)[2:]
    for path in old:
        os.utime(path, (1.0, 1.0))
    monkeypatch.setattr(cache, "MOST_BYTES", sum(path.stat().st_size for path in old + new) - 1)
    cache.prune(tmp_path / "derived")
    assert set(entries(tmp_path)) <= set(new) and entries(tmp_path)
    sv.derive(*pendulum(length=0.8))
    assert not list((tmp_path / "derived").glob("*.tmp"))


def test_sources_that_changed_are_other_sources(monkeypatch, tmp_path):
    stamp = store._stamp.__wrapped__
    file = tmp_path / "package" / "model" / "store.py"
    file.parent.mkdir(parents=True)
    file.write_text("a = 1", encoding="utf-8")
    monkeypatch.setattr(store, "__file__", str(file))
    monkeypatch.setattr(store, "_LOADED", file.stat().st_ctime - 1)
    assert stamp() is None  # changed after it was loaded
    monkeypatch.setattr(store, "_LOADED", file.stat().st_ctime + 10)
    found = {stamp(), stamp()}
    assert len(found) == 1 and None not in found
    os.utime(file, ns=(1, 1))
    found.add(stamp())
    file.write_text("a = 12", encoding="utf-8")
    os.utime(file, ns=(1, 1))
    found.add(stamp())
    (tmp_path / "package" / "new.py").write_text("", encoding="utf-8")
    found.add(stamp())
    assert len(found) == 4


@pytest.mark.parametrize("umask", [0o000, 0o002, 0o022])
def test_folders_are_made_for_this_user_alone(derived, tmp_path, monkeypatch, umask):
    place = tmp_path / "a" / "b"
    monkeypatch.setenv("SERVOCTL_CACHE", str(place))
    before = os.umask(umask)
    try:
        sv.derive(*pendulum())
    finally:
        os.umask(before)
    folders = [place.parent, place, *(path for path in place.rglob("*") if path.is_dir())]
    assert len(folders) >= 3 and {path.stat().st_mode & 0o777 for path in folders} == {0o700}


def test_a_folder_that_others_may_write_to_is_not_used(derived, tmp_path):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    entry.parent.chmod(0o777)
    with pytest.raises(PermissionError):
        cache.read_cached(entry)
    sv.derive(*pendulum())
    assert len(derived) == 2
    entry.parent.chmod(0o1777)  # in a sticky folder nobody renames another's file
    cache.read_cached(entry)


def test_an_entry_under_the_name_of_another_is_not_read(derived, tmp_path):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    other = entry.with_name("0" * 64)
    other.write_bytes(entry.read_bytes())
    with pytest.raises(OSError):
        cache.read_cached(other)


def test_a_pipe_in_the_place_of_an_entry_is_not_waited_for(derived, tmp_path):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    entry.unlink()
    os.mkfifo(entry)
    sv.derive(*pendulum())
    assert len(derived) == 2


def test_without_a_home_the_temporary_directory_serves(tmp_path, monkeypatch):
    def nowhere():
        raise RuntimeError("Could not determine home directory.")

    for name in ("SERVOCTL_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(Path, "home", nowhere)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert cache.cache_directory().parent == tmp_path


def test_a_folder_in_the_place_of_an_entry_leaves_no_descriptor_open(derived, tmp_path):
    sv.derive(*pendulum())
    (entry,) = entries(tmp_path)
    entry.unlink()
    entry.mkdir()
    here = Path("/dev/fd") if Path("/dev/fd").exists() else Path("/proc/self/fd")
    before = len(list(here.iterdir()))
    for _ in range(20):
        with pytest.raises(OSError):
            cache.read_cached(entry)
    assert len(list(here.iterdir())) <= before
