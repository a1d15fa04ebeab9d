"""The C files of the package: read as its resources, part of every library's key, each compiled alone."""

import shlex
import subprocess
from importlib import resources
from pathlib import Path

import pytest

from servoctl.codegen import compiler, loops

LOOPS = resources.files("servoctl.codegen") / "c"
EXPORTED = resources.files("servoctl.export") / "sources"
FILES = [(folder, file.name) for folder in (LOOPS, EXPORTED) for file in folder.iterdir() if file.name.endswith(".c")]


def test_every_loop_has_a_file():
    others = {"allocation.c", "batch.c", "builtin.c", "exponentials.c", "grid.c", "machine.c", "many.c", "normal.c",
              "paths.c", "plans.c", "riccati.c"}
    assert {f"{loop}.c" for loop in loops.LOOPS} | others == {n for folder, n in FILES if folder is LOOPS}
    assert all(loops.source(f"{loop}.c").startswith(("/*", "#include")) for loop in loops.LOOPS)
    exported = {"answer.c", "newton.c", "integrated.c", "advance.c", "law.c", "limited.c", "table.c", "thinned.c"}
    exported |= {"references.c", "join.c"}
    assert {name for folder, name in FILES if folder is EXPORTED} == exported


@pytest.mark.parametrize(("folder", "name"), FILES, ids=[name for _, name in FILES])
@pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")
def test_each_file_compiles_alone_without_a_warning(folder, name):
    command = [*shlex.split(compiler.compiler()), "-fsyntax-only", "-Wall", "-Wextra", "-Wno-unused-function"]
    alone = folder / "alone.h" if folder is EXPORTED else Path(__file__).with_name("alone.h")
    before = ["-Wno-psabi", f"-I{folder}", "-include", str(alone)]  # vectors are arguments
    first = {"law.c": "table.c", "newton.c": "answer.c", "integrated.c": "answer.c"}.get(name)
    before += ["-include", str(folder / str(first))] * (folder is EXPORTED and first is not None)
    done = subprocess.run([*command, "-Werror", *before, str(folder / name)], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


def test_a_file_that_changed_makes_other_libraries(tmp_path, monkeypatch):
    before = loops.digest()
    for file in LOOPS.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    monkeypatch.setattr(loops, "SOURCES", tmp_path)
    digest = loops.digest.__wrapped__
    assert digest() == before
    for name in ("closed.c", "sampled.h"):
        (tmp_path / name).write_text((tmp_path / name).read_text(encoding="utf-8") + "\n", encoding="utf-8")
        assert digest() != before
        before = digest()


@pytest.mark.skipif(compiler.compiler() is None, reason="needs a compiler")
def test_the_key_of_a_library_holds_the_files_that_it_includes(tmp_path, monkeypatch):
    monkeypatch.setenv("SERVOCTL_CACHE", str(tmp_path))
    monkeypatch.setattr(compiler, "_loaded", {})
    for digest in ("one", "another", "one"):
        monkeypatch.setattr(compiler, "digest", lambda digest=digest: digest)
        assert compiler.library("double one(void) { return 1.0; }")["one"]
    assert len(list(tmp_path.iterdir())) == 2
