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
        If the file is missing or is no study.
    """
    return archive.read(path, "study", _from_archive)


def _from_archive(facts, arrays):
    columns = {name: arrays[f"column_{i}"] for i, name in enumerate(facts["names"])}
    return KINDS.get(facts["kind"], Study)(facts["kind"], columns, facts["meta"])
