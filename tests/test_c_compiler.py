"""When a function is compiled, where its library is kept, and what happens without a compiler."""

import subprocess
import warnings

import casadi as ca
import numpy as np
import pytest
from refusals import warned
from test_compiled_functions import P1, RK4, X2, T, function, numpy_rk4, pendulum

from servoctl.codegen import compiler
from servoctl.codegen.function import GRID_POINTS, SCALAR_CALLS, SOLVED, compiled


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """As in a new process with an empty cache; the list holds the compiler's commands."""
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path / "cache"))
    new_process(monkeypatch)
    commands, run = [], subprocess.run
    monkeypatch.setattr(subprocess, "run", lambda command, **rest: commands.append(command) or run(command, **rest))
    return commands


def pendulum_with_loops():
    """Rates of a pendulum; as a Newton step they vanish at once where it hangs."""
    return compiled(function(X2[1], -P1 * ca.sin(X2[0]), 0, 0, 0, 0), "hanging", ("rk", "newton"))


def new_process(monkeypatch):
    monkeypatch.setattr(compiler, "_loaded", {})
    monkeypatch.setattr(compiler, "_warned", False)


def test_nothing_is_compiled_before_it_pays(fresh):
    model = pendulum(("rk",))
    for _ in range(SCALAR_CALLS):
        model(0.0, [0.1, 0.2], [1.0])
    model.grid(0.0, np.zeros((2, GRID_POINTS)), [1.0])
    assert not fresh and model.backend == "casadi"
    before = model(0.3, [0.1, 0.2], [1.0])
    assert len(fresh) == 1 and model.backend == "c"
    np.testing.assert_allclose(model(0.3, [0.1, 0.2], [1.0]), before, rtol=1e-15)


@pytest.mark.parametrize("use", [lambda m: m.grid(0.0, np.zeros((2, GRID_POINTS + 1)), [1.0]),
                                 lambda m: m.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4),
                                 lambda m: m.newton(np.zeros(GRID_POINTS), np.zeros((1, 9)), [1.0])])
def test_a_long_grid_a_long_path_or_an_integration_compiles_at_once(fresh, use):
    model = pendulum_with_loops()
    use(model)
    assert len(fresh) == 1 and model.backend == "c"


def test_a_short_path_is_solved_without_compiling(fresh):
    model = pendulum_with_loops()
    points = GRID_POINTS // SOLVED
    model.newton(np.zeros(points), np.zeros((1, 9)), [1.0])
    assert not fresh and model.backend == "casadi"
    model.newton(np.zeros(1), np.zeros((1, 9)), [1.0])
    assert len(fresh) == 1 and model.backend == "c"


def test_a_kept_library_is_loaded_and_not_compiled(fresh, monkeypatch):
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    again = pendulum(("rk",))
    again(0.0, [0.0, 0.0], [1.0])
    assert again.backend == "c"
    new_process(monkeypatch)
    in_new_process = pendulum(("rk",))
    in_new_process(0.0, [0.0, 0.0], [1.0])
    assert in_new_process.backend == "c"
    assert len(fresh) == 1


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
    (tmp_path / "file").write_text("")
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


@pytest.mark.parametrize(("name", "value"), [("SERVOCTL_COMPILER", "none"), ("CC", "false"), ("PATH", "")])
def test_without_a_compiler_one_warning_and_the_same_results(fresh, monkeypatch, name, value):
    expected = numpy_rk4(0.0, np.array([0.1, 0.0]), 0.1, 5, 1.0)
    monkeypatch.setenv(name, value)
    with warned("CasADi") as caught:
        for k in range(3):
            model = compiled(function(X2[1], -P1 * ca.sin(X2[0]) + ca.cos(T)), f"pendulum_{k}", ("rk",))
            np.testing.assert_allclose(model.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)[1], expected, atol=1e-15)
            assert model.backend == "casadi"
    assert len(caught) == 1


def test_a_compiler_that_refuses_native_code_still_compiles(fresh, tmp_path, monkeypatch):
    script = tmp_path / "plain-cc"
    script.write_text('#!/bin/sh\ncase "$*" in *-march=native*) exit 1;; esac\nexec cc "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    model = pendulum(("rk",))
    model.rk(0.0, [0.1, 0.0], 0.1, 5, [1.0], RK4)
    assert model.backend == "c" and fresh[-1][0] == str(script)


@pytest.mark.parametrize(
    ("script", "patience"),
    [("exec sleep 60", 0.3), (r"printf '\377\376 not a text' >&2; exit 1", 60.0)],
    ids=["hangs", "message that is no text"],
)
def test_a_compiler_that_does_not_serve_is_warned_about(fresh, tmp_path, monkeypatch, script, patience):
    command = tmp_path / "odd-cc"
    command.write_text(f"#!/bin/sh\n{script}\n")
    command.chmod(0o755)
    monkeypatch.setenv("SERVOCTL_COMPILER", str(command))
    monkeypatch.setattr(compiler, "PATIENCE_WITH_COMPILER", patience)
    model = pendulum(("rk",))
    with warned("odd-cc"):
        model.rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
    assert model.backend == "casadi"


def test_an_unclosed_quotation_mark_in_the_command_is_no_traceback(fresh, monkeypatch):
    monkeypatch.setenv("CC", "nothing 'of this name")
    pendulum(("rk",)).rk(0.0, [0.0, 0.0], 0.1, 1, [1.0], RK4)
