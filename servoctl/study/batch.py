"""Batches: many motions or closed loops in a table with a row per case, with traces and the failures among them."""

import contextlib
import json
from collections.abc import Mapping

import numpy as np

from servoctl.markup import Shown
from servoctl.study.cases import FAILURE
from servoctl.study.signals import Signals
from servoctl.study.table import Study, machine, table
from servoctl.values import frozen

FINAL = "final "  # names of values at the end


@frozen(eq=False)
class Batch(Shown):
    """Many motions, or many closed loops; made by `simulate_many` and `close_many`.

    `batch["final theta"]` is a column of the table, (N,), `batch.trace["theta"]` is (K, N). Of motions, forces and
    outputs have the names of a `Run`: `batch.trace["trolley"]` and `batch["final trolley"]` follow from the states when
    they are read, as the signals of a `Run` do.

    Attributes
    ----------
    study : Study
        A row per case: its numbers and results. Results of a case that ended early are NaN; "error", "message" and
        "facts" have the reason.
    t : (K,) array
        Instants of the traces [s].
    trace : mapping of str to (K, N) array
        Signals at these; NaN for motions that ended early.
    """

    study: Study
    t: np.ndarray
    trace: Mapping

    def __len__(self) -> int:
        return len(self.study)

    def __getitem__(self, name: str) -> np.ndarray:
        signal = name.removeprefix(FINAL) if isinstance(name, str) else name
        known = signal == name or name in self.study.columns or not isinstance(self.trace, Signals)
        return self.study[name] if known else self.trace.final(signal)

    def __repr__(self):
        failed = int(np.sum(self.study["error"] != ""))
        lines = [f"Batch: {len(self)} {self.study.kind}, {failed} with an error; {self.study.meta['by']}"]
        lines += [f"  traces at {len(self.t)} instants" if len(self.t) else "  no traces"]
        shown = [name for name in self.study.columns if name not in FAILURE[1:]][:8]
        return "\n".join([*(line[:120] for line in lines), *table(self.study, shown, most=5)])


def failure(error):
    """The columns `FAILURE` of an error; message and facts are empty where they cannot be written."""
    columns = {"error": type(error).__name__, "message": "", "facts": "{}"}
    with contextlib.suppress(Exception):
        columns["message"] = str(error)
    with contextlib.suppress(Exception):
        columns["facts"] = json.dumps(getattr(error, "details", {}), default=str)
    return columns


def of_finished(kind, done, columns, errors, meta):
    """The study of those of N cases that are done (N,), from columns (N,) and the columns `FAILURE` by index."""
    which = np.flatnonzero(done)
    if not len(which):
        raise KeyboardInterrupt
    columns = {"case": which} | {name: values[which] for name, values in columns.items()}
    meta = meta | {"interrupted": len(which) < len(done), "machine": machine()}
    return Study(kind, columns | failures(errors, which), meta)


def failures(errors, which):
    """The columns `FAILURE` of cases with the indices `which` (N,), from those of cases that failed, by index."""
    if not errors:
        return {name: np.full(len(which), "") for name in FAILURE}
    rows = [errors.get(i, {}) for i in np.asarray(which).tolist()]
    return {name: np.array([row.get(name, "") for row in rows], dtype=str) for name in FAILURE}
