"""A study: a table by column names, failures among its rows, with its inputs and the machine that computed it."""

import functools
import os
import platform
from collections.abc import Mapping
from dataclasses import field, replace
from importlib import metadata

import numpy as np

from servoctl import archive
from servoctl.checks import as_numbers, is_number, mapping, named, require_kind, text
from servoctl.codegen.compiler import compiler, processor
from servoctl.errors import SpecificationError
from servoctl.markup import Shown
from servoctl.units import unit_of_column, with_unit
from servoctl.values import frozen
from servoctl.version import __version__

ENTRIES = bool, int, float, str, np.number, np.bool_
SHOWN, MOST_COLUMNS = 7, 12  # rows of a table in a repr, and columns


@frozen(eq=False)
class Study(Shown):
    """A table of results; made by `tradeoff`, `sweep` or `load`.

    `study["seconds"]` is a column, `study.rows()` a list of dicts, `len(study)` the number of rows.

    Attributes
    ----------
    kind : str
        "tradeoff", "sweep", "motions" or "closed loops".
    columns : dict of str to (N,) array
        Numbers or texts by name. A missing number is NaN, a missing text is empty.
    meta : dict
        The inputs, and the machine with its versions: texts, numbers, and lists and dicts of them. Its entry "units"
        has the units of signals and parameters by name.
    """

    kind: str
    columns: dict
    meta: dict = field(default_factory=dict)

    def __post_init__(self):
        text("kind", self.kind)
        require_kind(Mapping, "columns", self.columns, "a dict of lists by name")
        columns = {name: _array(name, values) for name, values in mapping(self.columns, "The columns").items()}
        object.__setattr__(self, "meta", mapping(self.meta, "The facts"))
        lengths = {name: len(values) for name, values in columns.items()}
        if len(set(lengths.values())) > 1:
            raise SpecificationError(
                f"The columns have the lengths {lengths}.", "All columns must have the same length.", lengths=lengths
            )
        object.__setattr__(self, "columns", columns)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, name: str) -> np.ndarray:
        return self.column(name)

    def column(self, name: str) -> np.ndarray:
        """The column with this name, (N,); NameUnknown if there is none."""
        return self.columns[named(name, self.columns, "column")]

    def rows(self) -> list[dict]:
        """All rows as dicts of plain values."""
        plain = {name: values.tolist() for name, values in self.columns.items()}
        return [dict(zip(plain, row, strict=True)) for row in zip(*plain.values(), strict=True)]

    def where(self, **values) -> "Study":
        """The rows that have these values, numbers or texts by the names of their columns."""
        keep = np.ones(len(self), dtype=bool)
        for name, value in values.items():
            if not isinstance(value, str) and not is_number(value) and not isinstance(value, bool | np.bool_):
                raise SpecificationError(
                    f"{name}={repr(value)[:150]} was given.", "A row has a number or a text.", name=name, value=value
                )
            keep &= self.column(name) == value
        return self.take(np.flatnonzero(keep))

    def take(self, rows) -> "Study":
        """The rows with these indices (sequence of int), in this order, as a Study."""
        index = as_numbers(rows)
        if index.ndim != 1 or not np.all((index == np.round(index)) & (np.abs(index + 0.5) < len(self))):
            raise SpecificationError(
                f"rows={repr(rows)[:150]} was given.",
                f"They are indices of the {len(self)} rows: whole numbers in a list or an array.",
                do="Write study.take([0, 2]).",
                rows=rows,
                count=len(self),
            )
        return replace(self, columns={name: values[index.astype(int)] for name, values in self.columns.items()})

    def csv(self, path):
        """Write the table as CSV: a line of names with units, then one line for each row; a missing number is NaN.

        A text that spreadsheets would take for a formula, as it begins with =, +, - or @, has a ' before it.

        Parameters
        ----------
        path : str or Path

        Returns
        -------
        Path

        Raises
        ------
        ServoError
            If the file cannot be written.
        """
        return archive.table(path, "study", self.columns, self._units_of_names())

    @property
    def units(self) -> dict[str, str]:
        """Units of signals and parameters by name, where they are known."""
        return self.meta.get("units", {})

    def unit(self, name: str) -> str:
        """The unit of a column, "" if it is not known.

        Parameters
        ----------
        name : str
            Of a parameter, a signal, or a signal's least, greatest or last value: "trolley_max".
        """
        return unit_of_column(name, self.units)

    def _units_of_names(self):
        return {name: self.unit(name) for name in self.columns}

    def to_pandas(self):
        """The study as a pandas.DataFrame; `attrs["units"]` has the known units by name.

        Raises
        ------
        ServoError
            If pandas is not installed.
        """
        return archive.frame(self.columns, self._units_of_names())

    def save(self, path):
        """Save the study as npz, without pickle; `load` reads it.

        Parameters
        ----------
        path : str or Path
            The suffix .npz is added if it is missing.

        Returns
        -------
        Path

        Raises
        ------
        ServoError
            If the file cannot be written.
        """
        facts = {"kind": self.kind, "names": list(self.columns), "meta": self.meta}
        return archive.save(path, "study", facts, {f"column_{i}": c for i, c in enumerate(self.columns.values())})

    def to_xarray(self):
        """The study as an xarray.Dataset over its rows; its method `to_netcdf(path)` writes netCDF.

        Returns
        -------
        xarray.Dataset
            Its attributes are the entries of `meta`, with lists and dicts as JSON.

        Raises
        ------
        ServoError
            If xarray is not installed.
        """
        units = self._units_of_names()
        columns = {name: ("row", v, {"units": units[name]} if units[name] else {}) for name, v in self.columns.items()}
        return archive.dataset(columns, {}, {"kind": self.kind, **self.meta})

    def _tables(self):
        names = list(self.columns)[:MOST_COLUMNS]
        columns = ([_short(value) for value in self[name][:SHOWN].tolist()] for name in names)
        lines = [line for line in repr(self).splitlines()[1:] if line.startswith("  ... ")]
        head = [with_unit(name, self.unit(name)) for name in names]
        return [(head, zip(*columns, strict=True))] if names else [], lines

    def __repr__(self):
        lines = [f"Study: {self.kind}, {len(self)} rows", "  " + ", ".join(self.columns)]
        lines += [f"  {self.meta['message']}"] if self.meta.get("message") else []
        return "\n".join([*map(_clipped, lines), *table(self, list(self.columns)[:MOST_COLUMNS])])


def table(study, names, most=SHOWN):
    """Lines of at most 120 characters for some columns and the first rows of a study."""
    texts = [[name, *(_short(value) for value in study[name][:most].tolist())] for name in names]
    widths = [max(map(len, column)) for column in texts]
    rows = (zip(row, widths, strict=True) for row in zip(*texts, strict=True))
    lines = [_clipped("  " + "  ".join(f"{text:{width}}" for text, width in row).rstrip()) for row in rows]
    return [*lines, f"  ... {len(study) - most} more rows"] if len(study) > most else lines


def _clipped(line):
    return line if len(line) <= 120 else f"{line[:117]}..."


def machine():
    """The machine that computes: processor, cores, system, compiler and versions, as a dict of plain values."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "system": f"{platform.system()} {platform.machine()}",
        "compiler": compiler() or "none: loops are interpreted",
        "versions": dict(_versions()),
    }


@functools.cache
def _versions():
    others = {name: metadata.version(name) for name in ("casadi", "numpy", "scipy")}
    return {"servoctl": __version__, "python": platform.python_version()} | others


def _array(name, values):
    """An array of numbers, None as NaN, or of texts, None as an empty one."""
    array = values if isinstance(values, np.ndarray) else None
    known = isinstance(values, (list, tuple, range)) or array is not None and array.ndim == 1
    if not known or not (
        array is not None
        and array.dtype.kind in "biufU"
        or all(value is None or isinstance(value, ENTRIES) for value in values)
    ):
        raise SpecificationError(
            f"The column {name!r} is {repr(values)[:150]}.",
            "A column is a list or an array of numbers or texts, None where one is missing.",
            name=name,
            type=type(values).__name__,
        )
    if array is not None and array.dtype != object:
        return array
    values = list(values)
    if any(isinstance(value, str) for value in values):
        return np.array(["" if value is None else str(value) for value in values])
    array = np.array([np.nan if value is None else value for value in values])
    return array.astype(float) if array.dtype == object else array  # whole numbers beyond 64 bits


def _short(value):
    return f"{value:.3g}" if isinstance(value, float) else str(value)
