"""What is being done is said on a terminal where it takes long, and nowhere else."""

import io
import re
import threading
import time
from types import SimpleNamespace

import pytest

from servoctl import progress
from servoctl.progress import stage

LINE = re.compile(r"\r\x1b\[K([a-z ]+) (\d+\.\d) s")
ERASED = "\r\x1b[K"


class Terminal(io.StringIO):
    def isatty(self):
        return True

    def written(self):
        """What was written since the last call."""
        text = self.getvalue()
        self.truncate(self.seek(0))
        return text


@pytest.fixture
def terminal(monkeypatch):
    monkeypatch.setattr(progress, "REFRESH", 0.01)
    monkeypatch.setattr(progress, "sys", SimpleNamespace(stderr=Terminal()))  # pytest replaces that of sys
    return progress.sys.stderr


def test_a_long_stage_is_named_with_its_time_and_erased(terminal):
    with stage("deriving"):
        time.sleep(progress.PATIENCE + 0.15)
    text = terminal.written()
    names, seconds = zip(*LINE.findall(text), strict=True)
    assert set(names) == {"deriving"} and text.endswith(ERASED)
    assert progress.PATIENCE - 0.05 <= float(seconds[0]) <= float(seconds[-1])
    assert list(map(float, seconds)) == sorted(map(float, seconds))


def test_a_short_stage_is_not_named(terminal):
    with stage("deriving"):
        pass
    assert not terminal.written()


def test_an_inner_stage_is_written_in_place_of_the_outer_one(terminal, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.02)
    with stage("deriving"):
        with stage("compiling"):
            time.sleep(0.1)
            inner = terminal.written()
        time.sleep(0.1)
    assert {name for name, _ in LINE.findall(inner)} == {"compiling"}
    assert "deriving" in terminal.written()


def test_a_stage_that_fails_is_erased(terminal, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.01)
    with pytest.raises(ZeroDivisionError), stage("compiling"):
        time.sleep(0.1)
        raise ZeroDivisionError
    assert terminal.written().endswith(ERASED) and not progress._stages
    assert all(thread.name != "servoctl-progress" for thread in threading.enumerate())


def test_other_threads_and_files_get_no_lines(terminal, monkeypatch):
    monkeypatch.setattr(progress, "PATIENCE", 0.01)

    def work():
        with stage("compiling"):
            time.sleep(0.05)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert not terminal.written()
    monkeypatch.setattr(terminal, "isatty", lambda: False)
    work()
    monkeypatch.setattr(progress.sys, "stderr", None)  # pythonw
    work()
    assert not terminal.written()


def test_deriving_compiling_starting_and_verifying_are_named(terminal, monkeypatch, tmp_path):
    import servoctl as sv
    from servoctl.gallery import gallery

    monkeypatch.setattr(progress, "PATIENCE", 0.0)
    scene = gallery["two-cars-ideal"]
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    model = sv.derive(*scene.build())
    run = sv.simulate(model, model.start(**scene.start), scene.t_span, "RK4", progress=False)
    sv.verify(run)
    names = {name for name, _ in LINE.findall(terminal.written())}
    assert names >= {"deriving", "solving for the start", "verifying"}
