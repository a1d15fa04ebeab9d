"""What is being done and how far it is, on a terminal, where work takes long."""

import inspect
import sys
import threading
import time
from contextlib import contextmanager, nullcontext

from servoctl.errors import SpecificationError

PATIENCE = 0.3  # s before a bar or the name of a stage appears
REFRESH = 0.2  # s between two updates of the time that a stage has taken

_stages = []  # those under way, the innermost last


def progress_bar(name, wanted, total=None, **options):
    """A bar of tqdm, with its options, that appears where work takes long; `wanted` None means on a terminal."""
    if not _shown(wanted):
        return _NoBar()
    from tqdm import tqdm

    return tqdm(desc=name, total=total, **{"delay": PATIENCE, **options})


class _NoBar(nullcontext):
    """What is updated as a bar is, and shows nothing."""

    n = 0

    def __enter__(self):
        return self

    def update(self, count=1):
        """Nothing."""


@contextmanager
def stage(name):
    """Write on a terminal what is being done, and the time that it has taken, if that is long."""
    if not _shown(None) or threading.current_thread() is not threading.main_thread():
        yield
        return
    ended, since = threading.Event(), time.monotonic()
    writer = threading.Thread(target=_write_stage, args=(name, since, ended), name="servoctl-progress", daemon=True)
    _stages.append(ended)
    writer.start()
    try:
        yield
    finally:
        ended.set()
        writer.join()
        _stages.remove(ended)


def _write_stage(name, since, ended):
    written, wait = False, PATIENCE
    while not ended.wait(wait):
        if _stages[-1] is ended:  # an inner stage writes in its place
            sys.stderr.write(f"\r\x1b[K{name} {time.monotonic() - since:.1f} s")
            sys.stderr.flush()
            written, wait = True, REFRESH
    if written:
        sys.stderr.write("\r\x1b[K")  # the line is erased
        sys.stderr.flush()


class Progress:
    """Progress over a span [s], as a bar or as calls of a function of time; `wanted` None means a bar on a terminal."""

    def __init__(self, span, wanted):
        if callable(wanted):
            _require_one_argument(wanted)
        self.t0, self.total = span[0], abs(span[1] - span[0])
        self.call = wanted if callable(wanted) else None
        self.wanted = self.call is None and _shown(wanted)
        self.since, self.bar, self.done = time.monotonic(), None, 0.0

    def __call__(self, t):
        """Show that t [s] is reached."""
        if self.call is not None:
            self.call(t)
        elif self.wanted and (self.bar is not None or time.monotonic() - self.since >= PATIENCE):
            if self.bar is None:  # tqdm is not imported before: most simulations end sooner
                form = "{l_bar}{bar}| {n:.3g}/{total:.3g} s"
                self.bar = progress_bar("simulate", True, self.total, delay=0, unit="s", bar_format=form)
            self.bar.update(abs(t - self.t0) - self.done)
            self.done = abs(t - self.t0)

    def close(self):
        """Remove the bar."""
        if self.bar is not None:
            self.bar.close()


def _shown(wanted):
    if not (wanted is None or isinstance(wanted, bool)):
        rule = "It is True, False, or None for a bar on a terminal; `simulate` also takes a function of the time."
        raise SpecificationError(f"progress={repr(wanted)[:150]} was given.", rule, progress=wanted)
    on_terminal = sys.stderr is not None and sys.stderr.isatty()  # pythonw has no stderr
    return on_terminal if wanted is None else wanted


def _require_one_argument(function):
    """Refuse a function that takes no time; those of C have no signature and pass."""
    try:
        inspect.signature(function).bind(0.0)
    except ValueError:
        return
    except TypeError as error:
        rule = "A function that follows the progress receives the time reached [s]."
        do = "Write progress=lambda t: print(t)."
        raise SpecificationError(f"progress={function!r} was given.", rule, do=do, progress=function) from error
