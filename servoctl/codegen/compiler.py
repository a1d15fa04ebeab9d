"""Libraries from C text: compiled by the system's compiler, stored on disk by content, loaded.

What is on disk is used at once; anything else is compiled when its evaluations, in this process and in earlier ones,
have taken as long as compiling takes. A library lies in the cache directory under the hash of its C text, or of what
this is written from, of the sources that write it and the files that it may include, the compiler and the processor.
The compiler is ``SERVOCTL_COMPILER``, else ``CC``, else the first of cc, gcc and clang; a warning says where a named
one is missing.
``SERVOCTL_COMPILER=none`` compiles nothing. Without a compiler, or where it fails, CasADi evaluates instead, and the
process warns once, unless none was chosen.

The flags preserve IEEE arithmetic with one exception: a product and a sum may be contracted to one fused operation,
which rounds once instead of twice.
"""

import atexit
import contextlib
import contextvars
import ctypes
import functools
import hashlib
import math
import os
import platform
import shlex
import shutil
import threading
import warnings
from collections import Counter
from pathlib import Path

from servoctl.codegen.cache import cache_directory, read_cached, replacing
from servoctl.codegen.loops import SOURCES, digest
from servoctl.errors import SpecificationError
from servoctl.progress import stage

CALLS = 10_000  # evaluations of a function by CasADi that take as long as compiling it
PATIENCE_WITH_COMPILER = 120.0  # s: one that takes longer waits for something, such as a licence
USUAL = ("cc", "gcc", "clang")  # compilers that are looked for
FLAGS = ("-fPIC", "-shared", "-w", "-fno-math-errno")
ROUNDED = ("-ffp-contract=off", "-fno-builtin-pow")  # every operation rounds by itself; pow is that of the C library

_loaded = {}  # key -> ctypes.CDLL, or None where it could not be built
_locks = {}  # key -> lock: no two threads compile the same text
_guard = threading.Lock()
_warned = False
_hanging = set()  # commands that did not answer, and are not asked again
_calls = Counter()  # of this process, of what is not loaded, by key
_earlier = {}  # those of earlier processes
choice = contextvars.ContextVar("compiled, of `fixed`", default=None)


class _CompilerFailed(Exception):
    """The compiler refused the text."""


@contextlib.contextmanager
def fixed(compiled):
    """While this holds, libraries are compiled at their first use (True), or not used (False)."""
    if compiled is not True and compiled is not False:
        raise SpecificationError(
            f"compiled={compiled!r} was given.",
            "It is True, False or None.",
            nearest="None, the default.",
            do="Leave it out: what is on disk is used, and the rest compiled where that pays.",
            compiled=compiled,
        )
    token = choice.set(compiled)
    try:
        yield
    finally:
        choice.reset(token)


def library(text, level="-O1", exact=False, calls=math.inf, emitted=None):
    """Load the library of a C translation unit, by which `calls` evaluations would be made now.

    Where it is not on disk it is compiled once the calls that this process and earlier ones have told make up for that,
    and None until then; None, too, without a compiler or if compiling failed (one warning per process, unless none was
    chosen). `emitted` returns C text and level where `text` only stands for them. `level` may have further flags behind
    it, which a compiler may refuse, as clang does those of gcc; "-O1" compiles fastest, and its straight-line code is
    at most a quarter slower than "-O3". With `exact`, results are those of the operations one by one, not contracted.
    """
    command, identity = _compiler()
    if choice.get() is False or os.environ.get("SERVOCTL_COMPILER") == "none":
        return None
    if command is None:
        return _without("No C compiler was found")
    key = hashlib.sha256("\0".join((text, level, str(exact), digest(), _machine(identity))).encode()).hexdigest()
    with _guard:
        lock = _locks.setdefault(key, threading.Lock())
    with lock:
        if key not in _loaded:
            if first := key not in _calls:
                _earlier[key] = _told(key)
            _calls[key] += calls
            due = choice.get() or _calls[key] + _earlier[key] >= CALLS
            found = _open(cache_directory() / f"{key}.so") if first or due else None
            if found is None and not due:
                return None
            _loaded[key] = found or _build(*(emitted() if emitted else (text, level)), exact, f"{key}.so", command)
        return _loaded[key]


def _told(key):
    """The calls by which earlier processes would have used a library."""
    with contextlib.suppress(OSError, ValueError):
        return float(read_cached(cache_directory() / key))
    return 0.0


@atexit.register
def _tell():
    """Leave the calls of what was not compiled to the next process, for which it may pay."""
    for key in _calls.keys() - _loaded.keys():
        calls = _told(key) + _calls[key]
        with contextlib.suppress(OSError), replacing(cache_directory() / key) as temporary:
            Path(temporary).write_text(repr(calls), encoding="utf-8")


def compiler():
    """Command of the C compiler; None without one."""
    command, _ = _compiler()
    return None if command is None else " ".join(command)


def compiler_in_words():
    """The compiler in words: its command, version and flags; "none" without one."""
    import subprocess

    if (command := _compiler()[0]) is None:
        return "none"
    asked = subprocess.run((*command, "--version"), capture_output=True, text=True, timeout=PATIENCE_WITH_COMPILER)
    version = asked.stdout.partition("\n")[0]
    return f"{' '.join(command)}: {version}, {' '.join((*FLAGS, *_optional_flags()))}"


def _compiler():
    """Command of the compiler (a tuple) and its identity (str); (None, None) where there is none to use."""
    if choice.get() is False:
        return None, None
    return _identified(*(os.environ.get(name) for name in ("SERVOCTL_COMPILER", "CC", "PATH")))


@functools.cache
def _identified(chosen, cc, path):
    # Place, time and size of the program identify it: calling it for its version takes longer than loading a library.
    if chosen == "none":
        return None, None
    for variable, candidate in (("SERVOCTL_COMPILER", chosen), ("CC", cc), *(("", name) for name in USUAL)):
        try:
            command = shlex.split(candidate or "", posix=os.name == "posix")  # else a backslash separates folders
        except ValueError:  # a quotation mark that is not closed
            command = (candidate or "").split()
        if command and (program := shutil.which(command[0], path=path)):
            files = [os.path.realpath(file) for word in command if (file := shutil.which(word, path=path))]
            stats = [(file, os.stat(file).st_mtime_ns, os.stat(file).st_size) for file in files]
            return (os.path.abspath(program), *command[1:]), repr((command, stats))
        if command and variable:
            what = f"{variable}={candidate!r} names no program: the next of CC, {', '.join(USUAL)} is taken."
            warnings.warn(what, RuntimeWarning, stacklevel=2)
    return None, None


@functools.cache
def _machine(identity):
    """What libraries depend on beside their sources: the identity of the compiler, and the processor."""
    return repr((identity, platform.machine(), _processor()))


@functools.cache
def _processor():
    """The processor's model and features; "" where the system does not publish them."""
    identifying = ("vendor_id", "cpu family", "model", "stepping", "flags", "Features", "CPU ")
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            first = iter(lambda: lines.readline().rstrip("\n"), "")
            return "\n".join(line for line in first if line.startswith(identifying))
    except OSError:
        return ""


def processor():
    """The name of the processor's model, or what the system calls it."""
    names = [line.partition(": ")[2] for line in _processor().splitlines() if line.startswith("model name")]
    return "".join(names) or platform.processor() or platform.machine()


@functools.cache
def features():
    """Features of the processor, as words; empty where the system does not publish them."""
    return frozenset(_processor().split())


def lanes():
    """Number of doubles in one vector of the processor: 8 with AVX-512, 4 with AVX2, else 1."""
    words = features()
    return 8 if "avx512f" in words else 4 if "avx2" in words else 1


def _optional_flags():
    # A compiler may refuse them. Code for this very processor only where the library's key names the processor.
    return ("-fno-semantic-interposition", *(("-march=native",) if _processor() else ()))


@functools.cache
def _scratch():
    import tempfile

    # Windows does not delete loaded libraries.
    directory = tempfile.TemporaryDirectory(prefix="servoctl-", ignore_cleanup_errors=True)
    atexit.register(directory.cleanup)
    return Path(directory.name)


@stage("compiling")
def _build(text, level, exact, file_name, command):
    """Compile into the cache, or into a temporary directory if that fails, as where the cache's disk is full."""
    import subprocess

    if command in _hanging:
        return None
    level, *tuning = level.split()
    flags = (level, *FLAGS, *(ROUNDED if exact else ())), (*_optional_flags(), *tuning)
    for directory in (cache_directory, _scratch):
        try:
            return _compile(text, flags, directory() / file_name, command)
        except (OSError, _CompilerFailed) as error:
            failed = error
        except subprocess.TimeoutExpired:
            failed = f"no answer within {PATIENCE_WITH_COMPILER:g} s"
            _hanging.add(command)
            break
    return _without(f"{' '.join(command)} failed: {failed}")


def _compile(text, flags, target, command):
    """Compile with flags that the compiler takes, and those that it may refuse."""
    import subprocess

    flags, optional = flags
    with replacing(target) as temporary:
        for some in dict.fromkeys((optional, _optional_flags(), ())):
            done = subprocess.run(
                [*command, *flags, *some, f"-I{SOURCES}", "-x", "c", "-", "-o", temporary, "-lm"],
                input=text,
                encoding="utf-8",
                errors="replace",
                capture_output=True,
                cwd=target.parent,
                check=False,
                timeout=PATIENCE_WITH_COMPILER,
            )
            if done.returncode == 0:
                break
        else:
            raise _CompilerFailed("; ".join(done.stderr.strip().splitlines()[:2]) or f"status {done.returncode}")
    return ctypes.CDLL(str(target))


def _open(path):
    try:
        read_cached(path)  # loading a damaged library can end the process
        return ctypes.CDLL(str(path))
    except OSError:
        return None


def _without(reason):
    global _warned
    if not _warned:
        _warned = True
        warnings.warn(
            f"{reason}. CasADi evaluates the models: the same results, repeated calls 10 to 1,000 times slower. "
            "Install gcc or clang, or name a compiler in CC.",
            RuntimeWarning,
            stacklevel=2,
        )
