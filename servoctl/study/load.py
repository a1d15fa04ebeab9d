"""Studies from files."""

from servoctl import archive
from servoctl.study.table import Study
from servoctl.study.tradeoff import TradeOff

KINDS = {"tradeoff": TradeOff}  # all others are of class Study


def load_study(path) -> Study:
    """Read a study that `Study.save` wrote.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Study
        A `TradeOff` if that is what was saved.

    Raises
    ------
    ServoError
        If the file is missing, damaged or no study.
    """
    return archive.read(path, "study", _from_archive)


def _from_archive(facts, arrays):
    kind, meta = facts["kind"], facts["meta"]
    archive.require(isinstance(kind, str) and isinstance(meta, dict), "its kind or its facts are damaged")
    columns = {name: arrays[f"column_{i}"] for i, name in enumerate(archive.named(facts["names"]))}
    for name, column in columns.items():
        archive.require(column.ndim == 1 and column.dtype.kind in "fiubU", f"its column {name!r} is damaged")
    return KINDS.get(kind, Study)(kind, columns, meta)
