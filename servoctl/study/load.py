"""What was saved, from its file."""

from servoctl import archive
from servoctl.errors import SpecificationError
from servoctl.run import Run, as_saved, of_model
from servoctl.study.table import Study


def load(path, model=None) -> Run | Study:
    """What `save` of a run, a closed loop or a study wrote.

    Parameters
    ----------
    path : str or Path
        A missing suffix .npz is added.
    model : Model, optional
        The model of a run, derived again: with it the run can be verified, interpolated, and made a law of.

    Returns
    -------
    Run or Study
        A run with its samples, signals and residuals, and with the model; a closed loop as such a run; or a study, a
        `TradeOff` if that is what was saved.

    Raises
    ------
    ServoError
        If the file is missing, damaged, or was written by something else.
    SpecificationError
        If the run is not of this model: names, parameters, or values of signals differ; or a study is given one.
    """
    saved, facts = archive.read(
        path, lambda facts, arrays: ((_study if "kind" in facts else as_saved)(facts, arrays), facts)
    )
    if model is not None and not isinstance(saved, Run):
        raise SpecificationError(f"{path} holds a study.", "A run alone has a model.", do="Leave out the model.")
    return saved if model is None else of_model(saved, facts, model)


def _study(facts, arrays):
    """The study of an archive, of the class that wrote it."""
    from servoctl.study.tradeoff import TradeOff

    columns = {name: arrays[f"column_{i}"] for i, name in enumerate(archive.named(facts["names"]))}
    damaged = [name for name, values in columns.items() if values.ndim != 1 or values.dtype.kind not in "fiubU"]
    whole = isinstance(facts["kind"], str) and isinstance(facts["meta"], dict) and not damaged
    archive.require(whole, f"its kind, its facts or its columns {damaged} are damaged")
    return (TradeOff if facts["kind"] == "tradeoff" else Study)(facts["kind"], columns, facts["meta"])
