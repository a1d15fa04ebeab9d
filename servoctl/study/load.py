"""Studies from files."""

from servoctl import archive
from servoctl.study.table import Study
from servoctl.study.tradeoff import TradeOff

KINDS = {"tradeoff": TradeOff}  # others are plain studies


def load_study(path) -> Study:
    """A study from a file that `Study.save` wrote.

    Parameters
    ----------
    path : str or Path

    Returns
    -------
    Study
        A `TradeOff` if one was saved.

    Raises
    ------
    ServoError
        If the file is missing or was not written by `Study.save`.
    """
    return archive.read(path, "study", _from_archive)


def _from_archive(facts, arrays):
    columns = {name: arrays[f"column_{i}"] for i, name in enumerate(facts["names"])}
    return KINDS.get(facts["kind"], Study)(facts["kind"], columns, facts["meta"])
