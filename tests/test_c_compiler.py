"""When a function is compiled, where its library is kept, and what happens without a compiler."""

import os
import subprocess
import time
import warnings
from collections import Counter
from contextvars import ContextVar

import casadi as ca
import numpy as np
import pytest
from conftest import FULLY_OPTIMISED
from refusals import warned
from test_compiled_functions import P1, RK4, X2, T, function, numpy_rk4, pendulum

import servoctl as sv
from servoctl.codegen import cache, compiler
from servoctl.codegen import function as functions
from servoctl.codegen.compiler import CALLS
from servoctl.codegen.function import MANY_POINTS, compiled
from servoctl.codegen.paths import Followed
from servoctl.errors import SpecificationError
from servoctl.gallery import gallery
from servoctl.model.equations import signal_groups
from servoctl.shell.main import main


@pytest.fixture
def fresh(tmp_path, monkeypatch, c_compiler):
    """As in a new process with an empty cache; the list holds the compiler's commands."""
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(functions, "FULLY_OPTIMISED", FULLY_OPTIMISED)
    new_process(monkeypatch)
    commands, run = [], subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, **rest: commands.append(command) or run(command, **rest))
    return commands


@pytest.fixture
def by_rule(fresh, monkeypatch):
    """As users have it: no call says whether it is compiled."""
    monkeypatch.setattr(compiler, "choice", ContextVar("compiled", default=None))
    return fresh


def pendulum_with_loops():
    """Rates of a pendulum; as a Newton step they vanish at once where it hangs."""
    return compiled(function(X2[1], -P1 * ca.sin(X2[0]), 0, 0, 0, 0), "hanging", ("rk", "newton"))


def new_process(monkeypatch):
    monkeypatch.setattr(compiler, "_loaded", {})
    monkeypatch.setattr(compiler, "_calls", Counter())
    monkeypatch.setattr(Followed, "library", None)
    monkeypatch.setattr(compiler, "_warned", False)


def test_points_and_short_grids_compile_no_function_however_many(fresh):
    for model in (pendulum(), compiled(function(X2[1], -P1 * X2[0]), "spring")):
        for _ in range(200):
            model(0.0, [0.1, 0.2], [1.0])
            model.grid(0.0, np.zeros((2, MANY_POINTS)), [1.0])
        assert len(fresh) == 1 and model.backend == "casadi"  # the unit that takes the operations of any function


def test_points_called_ten_thousand_times_are_compiled(fresh):
    model, x, p = pendulum(), np.array([0.1, 0.2]), np.ones(1)
    first, compilations = model(0.0, x, p), []
    for calls in (2_000, 8_000):
        for _ in range(calls):
            y = model(0.0, x, p)
        compilations.append(len(fresh))
        np.testing.assert_array_equal(y, first)
    assert compilations == [0, 1]


def test_a_long_grid_is_compiled(fresh):
    model = pendulum()
    model.grid(0.0, np.zeros((2, MANY_POINTS + 1)), [1.0])
    assert len(fresh) == 1 and model.backend == "c"


@pytest.mark.parametrize("use", [lambda m: m.grid(0.0, np.zeros((2, 1)), [1.0]),
                                 lambda m: m.buffer(),
                                 lambda m: m.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4),
                                 lambda m: m.newton(np.zeros(1), np.zeros((1, 9)), [1.0])])
def test_what_an_integration_uses_is_compiled_at_its_first_use(fresh, use):
    model = pendulum_with_loops()
    use(model)
    assert len(fresh) == 1 and model.backend == "c"
    use(model)
    assert len(fresh) == 1


def test_a_loop_is_compiled_when_its_evaluations_pay_for_that_and_used_at_once_where_it_is_on_disk(by_rule, monkeypatch):
    x, p, quarter = np.array([0.1, 0.0]), np.ones(1), CALLS // 16  # four evaluations a step
    model, known, backends = pendulum_with_loops(), [], []
    for _ in range(6):
        known.append(model.rk(0.0, x, 1e-3, quarter, p, RK4)[1])
        backends.append(model.backend)
    assert backends == ["casadi"] * 3 + ["c"] * 3 and len(by_rule) == 1
    np.testing.assert_array_equal(known[0], known[1])
    np.testing.assert_allclose(known[0], known[-1], rtol=1e-11, atol=1e-14)
    new_process(monkeypatch)
    other = pendulum_with_loops()
    np.testing.assert_array_equal(other.rk(0.0, x, 1e-3, quarter, p, RK4)[1], known[-1])
    assert other.backend == "c" and len(by_rule) == 1
    announced = compiled(function(X2[1], -P1 * X2[0]), "announced", ("rk",))
    announced.rk(0.0, x, 1e-3, CALLS // 4, p, RK4)
    assert announced.backend == "c" and len(by_rule) == 2


def test_evaluations_of_earlier_processes_count(by_rule, monkeypatch):
    x, p, third = np.array([0.1, 0.0]), np.ones(1), CALLS // 12
    backends = []
    for _ in range(4):
        model = pendulum_with_loops()
        model.rk(0.0, x, 1e-3, third, p, RK4)
        backends.append((model.backend, len(by_rule)))
        compiler._tell()
        new_process(monkeypatch)
    assert backends == [("casadi", 0), ("casadi", 0), ("casadi", 0), ("c", 1)]
    for told in compiler.cache_directory().glob("[0-9a-f]*[0-9a-f]"):
        told.write_text("no number")
    other = pendulum_with_loops()
    other.rk(0.0, x, 1e-3, third, p, RK4)
    assert other.backend == "c" and len(by_rule) == 1


def test_steps_of_a_series_in_python_count_more_than_their_evaluations(by_rule):
    sizes = {"nq": 1, "n": 1, "top": 2, "last": 2, "plain": 1}
    model, steps = compiled(function(X2[1], -X2[0] / 2), "series", ("taylor",), sizes=sizes), 0
    while model.backend == "casadi" and steps < CALLS:
        steps += len(model.taylor(0.0, [0.1, 0.2], 1e3, [1.0], 1e-9, 1e-11, 100)) - 1
    assert CALLS / 20 < steps < CALLS / 2 and len(by_rule) == 1


def test_long_grids_are_compiled_when_they_pay_for_it(by_rule):
    model, grids = pendulum(), 0
    while model.backend == "casadi" and grids < 1000:
        model.grid(0.0, np.zeros((2, 10_000)), [1.0])
        grids += 1
    assert 10 < grids < 1000 and 1 <= len(by_rule) <= 2  # of the unit of operations, too


def test_one_motion_compiles_nothing_and_what_is_on_disk_serves_at_once(by_rule, monkeypatch):
    scene = gallery["overhead-crane"]

    def motion(**options):
        model = sv.derive(*scene.build())
        run = sv.simulate(model, model.start(guess=scene.guess), (0.0, 0.5), progress=False, **options)
        return run.jets, model.function("path").backend

    first, backend = motion()
    assert not by_rule and backend == "casadi"
    of_code, backend = motion(compiled=True)
    assert by_rule and backend == "c"
    np.testing.assert_array_equal(motion(compiled=True)[0], of_code)
    interpreted, _ = motion(compiled=False)
    np.testing.assert_allclose(interpreted, of_code, rtol=1e-9, atol=1e-11)
    np.testing.assert_array_equal(interpreted, first)
    compilations = len(by_rule)
    new_process(monkeypatch)
    again, backend = motion()
    np.testing.assert_array_equal(again, of_code)
    assert backend == "c" and len(by_rule) == compilations
    with pytest.raises(SpecificationError, match=r"compiled='x' was given.* True, False or None.*Nearest: None.*Leave it out"):
        motion(compiled="x")


def test_a_call_has_the_same_bits_whatever_was_called_before(fresh, monkeypatch):
    rng = np.random.default_rng(4)
    x, t = rng.normal(size=(2, 300)), np.linspace(0.0, 1.0, 300)
    calls = {
        "point": lambda m: m(0.3, x[:, 0], [1.3]), "short": lambda m: m.grid(t, x, [1.3]),
        "long": lambda m: m.grid(0.3, np.tile(x, 80), [1.3]), "one": lambda m: m.grid(0.3, x[:, :1], [1.3]),
    }  # fmt: skip
    loops = {"steps": lambda m: m.rk(0.0, x[:, 0], 0.1, 50, [1.3], RK4)[1], "of rates": lambda m: m.grid(t, x, [1.3])}
    for make, known in ((pendulum, calls), (lambda: pendulum(("rk",)), calls | loops)):
        alone = {name: call(make()) for name, call in known.items()}
        for _ in range(4):
            new_process(monkeypatch)
            model = make()
            for name in rng.permutation([*known] * 3):
                np.testing.assert_array_equal(known[name](model), alone[name], err_msg=name)


@pytest.mark.parametrize(
    ("name", "method"),
    [("overhead-crane", None), ("appell-hamel", "RK4"), ("appell-hamel", "RadauIIA"), ("pendubot", "Taylor"),
     ("pendubot", "DOP853")],
)
def test_a_repeated_simulation_has_the_same_bits(fresh, name, method):
    scene, model = gallery[name], sv.derive(*gallery[name].build())
    start = model.start(**scene.start, guess=scene.guess)

    def motion():
        run = sv.simulate(model, start, (0.0, 0.3), method, t_eval=np.linspace(0.0, 0.3, 40), progress=False)
        return [run.jets, *(run[signal] for signal in signal_groups(model.reduction))]

    first = motion()
    sv.simulate(model, start, (0.0, 0.2), t_eval=np.linspace(0.0, 0.2, 700), progress=False)
    for _ in range(3):
        for once, again in zip(first, motion(), strict=True):
            np.testing.assert_array_equal(again, once)


def test_a_grid_of_casadi_is_its_points(fresh):
    rng = np.random.default_rng(5)
    t, x, p = rng.normal(size=301), rng.normal(size=(2, 301)), rng.normal(size=(1, 301))
    model = pendulum()
    for numbers in (p, p[:, 0]):
        columns = [model(t[k], x[:, k], numbers[:, k] if numbers.ndim == 2 else numbers) for k in range(301)]
        np.testing.assert_array_equal(model.grid(t, x, numbers).T, columns)
    assert not fresh


def test_a_library_of_another_process_is_loaded_and_not_compiled(fresh, monkeypatch):
    first = pendulum(("rk",)).rk(0.0, [0.1, 0.0], 0.1, 9, [1.0], RK4)[1]
    new_process(monkeypatch)
    again = pendulum(("rk",))
    np.testing.assert_array_equal(again.rk(0.0, [0.1, 0.0], 0.1, 9, [1.0], RK4)[1], first)
    assert again.backend == "c" and len(fresh) == 1


def test_a_long_series_is_left_to_casadi(fresh, monkeypatch):
    f, sizes = function(X2[1], -X2[0] / 2), {"nq": 1, "n": 1, "top": 2, "last": 2, "plain": 1}
    runs = []
    for limit in (9, 0):
        monkeypatch.setattr(functions, "TAYLOR_COMPILED", limit)
        model = compiled(f, "series", ("taylor",), sizes=sizes)
        runs.append(model.taylor(0.0, [0.1, 0.2], 1e-3, [1.0], 1e-6, 1e-9, 5)[-1, 1:3])
        assert model.backend == ("c" if limit else "casadi")
    np.testing.assert_allclose(*runs, rtol=1e-14)


@pytest.mark.parametrize("damage", [lambda data: b"", lambda data: b"not a library", lambda data: data[:-1000],
                                    lambda data: data[:3000] + b"?" + data[3001:]])
def test_a_damaged_library_is_built_again(fresh, monkeypatch, damage):
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    kept, = compiler.cache_directory().iterdir()
    whole = kept.read_bytes()
    kept.unlink()
    kept.write_bytes(damage(whole))
    new_process(monkeypatch)
    model = pendulum(("rk",))
    model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "c" and len(fresh) == 2
    assert len(kept.read_bytes()) == len(whole)


def test_an_unusable_cache_is_replaced_by_a_temporary_directory(fresh, tmp_path, monkeypatch):
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path / "file" / "cache"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = pendulum(("rk",))
        model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "c" and len(fresh) == 1


def test_the_working_directory_is_untouched(fresh, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("SERVOCTL_CACHE", "../relative")
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert len(fresh) == 1
    assert not list((tmp_path / "here").iterdir())
    assert [file.suffix for file in (tmp_path / "relative").iterdir()] == [".so"]


def test_the_cache_is_where_the_platform_keeps_caches(monkeypatch, tmp_path):
    monkeypatch.delenv("SERVOCTL_CACHE", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert compiler.cache_directory() == tmp_path / "servoctl"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert compiler.cache_directory().name == "servoctl"


def test_no_compiler_by_choice_needs_no_warning(fresh, monkeypatch):
    monkeypatch.setenv("SERVOCTL_COMPILER", "none")
    model = pendulum(("rk",))
    model.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)
    model.grid(0.0, np.zeros((2, MANY_POINTS + 1)), [1.0])
    assert compiler.library("int one;") is None
    assert model.backend == "casadi" and not fresh


@pytest.mark.parametrize(("name", "value"), [("CC", "false"), ("PATH", "")])
def test_without_a_compiler_one_warning_and_the_same_results(fresh, monkeypatch, name, value):
    expected = numpy_rk4(0.0, np.array([0.1, 0.0]), 0.1, 5, 1.0)
    monkeypatch.setenv(name, value)
    with warned("CasADi") as caught:
        for k in range(3):
            model = compiled(function(X2[1], -P1 * ca.sin(X2[0]) + ca.cos(T)), f"pendulum_{k}", ("rk",))
            np.testing.assert_allclose(model.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)[1], expected, atol=1e-15)
            assert model.backend == "casadi"
    assert len(caught) == 1


@pytest.mark.parametrize(("refused", "kept"), [("-march=native", ()), ("-fno-tree-pre", compiler._optional_flags())])
def test_a_compiler_that_refuses_flags_still_compiles(fresh, tmp_path, monkeypatch, refused, kept):
    """As clang, which knows no -fno-tree-pre."""
    script = tmp_path / "plain-cc"
    script.write_text(f'#!/bin/sh\ncase "$*" in *{refused}*) exit 1;; esac\nexec cc "$@"\n', encoding="utf-8")
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    assert compiler.library("int seven(void) { return 7; }", functions.ALONG_A_PATH).seven() == 7
    assert fresh[-1][0] == str(script) and refused not in fresh[-1] and {*kept} <= {*fresh[-1]}


@pytest.mark.parametrize(
    ("script", "patience"),
    [("exec sleep 60", 0.3), (r"printf '\377\376 not a text' >&2; exit 1", 60.0)],
    ids=["hangs", "message that is no text"],
)
def test_a_compiler_that_does_not_serve_is_warned_about(fresh, tmp_path, monkeypatch, script, patience):
    command = tmp_path / "odd-cc"
    command.write_text(f"#!/bin/sh\n{script}\n", encoding="utf-8")
    command.chmod(0o755)
    monkeypatch.setenv("SERVOCTL_COMPILER", str(command))
    monkeypatch.setattr(compiler, "PATIENCE_WITH_COMPILER", patience)
    model = pendulum(("rk",))
    with warned("odd-cc"):
        model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "casadi"


def test_a_compiler_that_hangs_is_asked_once(fresh, tmp_path, monkeypatch):
    command, log = tmp_path / "slow-cc", tmp_path / "log"
    command.write_text(f"#!/bin/sh\necho asked >> {log}\nexec sleep 60\n", encoding="utf-8")
    command.chmod(0o755)
    monkeypatch.setenv("SERVOCTL_COMPILER", str(command))
    monkeypatch.setattr(compiler, "PATIENCE_WITH_COMPILER", 0.3)
    monkeypatch.setattr(compiler, "_hanging", set())
    with warned("slow-cc"):
        assert compiler.library("int one(void) { return 1; }") is None
    asked = log.read_text(encoding="utf-8")
    assert compiler.library("int two(void) { return 2; }") is None and log.read_text(encoding="utf-8") == asked


@pytest.mark.parametrize("variable", ["SERVOCTL_COMPILER", "CC"])
@pytest.mark.parametrize("command", ["nothing-of-this-name -O9", "nothing 'of this name", "/no/such/gcc"])
def test_a_named_compiler_that_does_not_exist_is_warned_about(fresh, monkeypatch, variable, command):
    compiler._identified.cache_clear()
    monkeypatch.setenv(variable, command)
    model = pendulum(("rk",))
    with warned(variable, command.split()[0]):
        model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "c" and len(fresh) == 1
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)  # warned about once


def test_a_cache_without_room_is_replaced_by_a_temporary_directory(fresh, tmp_path, monkeypatch):
    script = tmp_path / "full-cc"
    script.write_text(f'#!/bin/sh\ncase "$*" in *{tmp_path}/cache*) echo "No space left on device" >&2; exit 1;; esac\n'
                      'exec cc "$@"\n', encoding="utf-8")
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    model = pendulum(("rk",))
    model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "c"


# what is deleted -----------------------------------------------------------------------------------------------------


def library_files(tmp_path):
    return sorted((tmp_path / "cache").glob("*.so"))


def test_libraries_are_pruned_by_size_and_age_and_abandoned_files_go(fresh, tmp_path, monkeypatch):
    folder, now = tmp_path / "cache", time.time()
    for k in range(4):
        compiled(function(X2[1] * k, X2[0]), f"many_{k}", ("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    oldest, older, *new = library_files(tmp_path)
    young, abandoned, foreign = (folder / name for name in ("tmpyoung.tmp", "tmpleft.tmp", "notes.txt"))
    for path, age in ((oldest, 200 * 86400), (older, 100), (young, 10), (abandoned, 7200), (foreign, 10**9)):
        path.touch()
        os.utime(path, (now - age, now - age))
    cache.prune(folder)
    assert set(folder.iterdir()) == {older, *new, young, foreign}
    monkeypatch.setattr(cache, "MOST_BYTES", older.stat().st_size)
    cache.prune(folder)
    assert older not in folder.iterdir() and {young, foreign} <= set(folder.iterdir())


def test_a_library_that_is_used_stays_young(fresh, tmp_path, monkeypatch):
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    (path,) = library_files(tmp_path)
    os.utime(path, (1.0, 1.0))
    new_process(monkeypatch)
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert path.stat().st_mtime > 1e9 and len(fresh) == 1


def test_writes_prune_from_time_to_time(fresh, tmp_path, monkeypatch):
    monkeypatch.setattr(cache, "WRITES", 1)
    (tmp_path / "cache").mkdir(mode=0o700)
    left = tmp_path / "cache" / "tmpleft.tmp"
    left.touch()
    os.utime(left, (1.0, 1.0))
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert not left.exists() and len(library_files(tmp_path)) == 1


def test_the_command_says_what_the_cache_holds_and_clears_it(fresh, tmp_path, capsys, monkeypatch):
    def said(*options):
        assert main(["cache", *options]) == 0
        place, *lines = capsys.readouterr().out.splitlines()
        assert place == str(tmp_path / "cache")
        return {line.split()[0]: int(line.split()[1]) for line in lines}

    assert said() == {"libraries": 0, "derivations": 0, "temporary": 0}
    monkeypatch.delenv("SERVOCTL_MEMO", raising=False)
    model = sv.derive(*gallery["overhead-crane"].build())
    sv.simulate(model, model.start(guess={"l": 4.0}), (0.0, 1.0))
    (tmp_path / "cache" / "notes.txt").write_text("not of the cache", encoding="utf-8")
    held = said()
    assert held["libraries"] == len(library_files(tmp_path)) > 0
    assert said("--clear") == {"libraries": 0, "derivations": 0, "temporary": 0}
    assert (tmp_path / "cache" / "notes.txt").exists()
    new_process(monkeypatch)
    again = sv.derive(*gallery["overhead-crane"].build())
    sv.simulate(again, again.start(guess={"l": 4.0}), (0.0, 1.0))
    assert said()["libraries"] == held["libraries"]
