"""Where cases are computed: one after the other in this process, or on an executor; Ctrl-C keeps what is finished."""

import contextlib
import multiprocessing
import signal
import threading
from concurrent.futures import as_completed

from servoctl.codegen.compiler import fixed
from servoctl.errors import ServoError


def computed(function, calls, executor, take):
    """Compute a function for arguments by key, and `take(key, result)` each as it is finished.

    Without an executor an error of the function ends all. Returns the columns `FAILURE` of the calls that an executor
    did not finish, by key, and whether Ctrl-C was pressed, which cancels the calls that have not begun.
    """
    lost = {}
    results = _in_turn(function, calls) if executor is None else _on(executor, function, calls)
    try:
        for key, result, error in results:
            if error is None:
                take(key, result)
            else:
                message = f"The executor did not finish this case{f': {error}' if str(error) else '.'}"
                lost[key] = {"error": type(error).__name__, "message": message, "facts": "{}"}
    except KeyboardInterrupt:
        return lost, True
    return lost, False


def _in_turn(function, calls):
    """(key, result, None) of the calls, in this process."""
    with _recorded_interrupts() as interrupts:
        for key, arguments in calls.items():
            with fixed(True):  # the same bits in any order and on any worker
                result = function(*arguments)
            if interrupts:
                raise KeyboardInterrupt  # which `simulate` inside the function caught: it is the result of half a run
            yield key, result, None


def _on(executor, function, calls):
    """(key, result, error) of the calls, as an executor finishes them."""
    futures, unsent = {}, {}
    try:
        for key, arguments in calls.items():
            try:
                futures[executor.submit(_in_worker, function, arguments)] = key
            except RuntimeError as error:  # the pool has died, or was shut down
                unsent[key] = error
        for future in as_completed(futures):
            try:
                result = future.result()
            except Exception as error:
                yield futures[future], None, error
            else:
                yield futures[future], result, None
    except (KeyboardInterrupt, GeneratorExit):
        for future in futures:
            future.cancel()
        raise
    yield from ((key, None, error) for key, error in unsent.items())


def _in_worker(function, arguments):
    """The result of a call; a process leaves Ctrl-C to its parent, and finishes what it is at."""
    if multiprocessing.parent_process() is not None and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    with fixed(True):
        return function(*arguments)


@contextlib.contextmanager
def _recorded_interrupts():
    """A list to which every Ctrl-C is appended, also where the KeyboardInterrupt is caught inside."""
    interrupts = []
    in_main = threading.current_thread() is threading.main_thread()
    if not in_main or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield interrupts
        return

    def record(number, frame):
        interrupts.append(number)
        signal.default_int_handler(number, frame)

    signal.signal(signal.SIGINT, record)
    try:
        yield interrupts
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def whole_run(run):
    """The run, if it reached its end; one that Ctrl-C stopped ends what it is part of."""
    if not run.success:
        raise KeyboardInterrupt
    return run


def require_some(lost, finished, count):
    """Refuse what an executor left that finished none of `count` cases; `lost` has the columns `FAILURE` of calls."""
    if not lost or finished:
        return
    first = next(iter(lost.values()))
    raise ServoError(
        f"The executor finished none of {count} cases. {first['error']}: {first['message']}",
        "Each worker imports the module of the case and must have the memory that a case needs.",
        do='Start the sweep of a script below if __name__ == "__main__".',
        error=first["error"],
        message=first["message"],
        cases=count,
    )
