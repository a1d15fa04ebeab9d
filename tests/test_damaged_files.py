"""Files that were damaged, or that others made: each is a ServoError, or reads as what was saved."""

import csv
import json
import zipfile

import numpy as np
import pytest
from refusals import refused

import servoctl as sv
from servoctl.study.table import Study

STUDY = Study("sweep", {"case": [0, 1, 2], "r": [1.5, -2.0, None], "error": ["", "", "odd"]}, {"seed": 1})


@pytest.fixture(scope="module")
def saved(tmp_path_factory, point_plan):
    folder = tmp_path_factory.mktemp("saved")
    return {"run": (point_plan.save(folder / "run"), sv.load), "study": (STUDY.save(folder / "study"), sv.load)}


def loads_or_is_refused(load, path, original):
    """Whether the file still reads as what was saved; anything but that and a ServoError fails."""
    try:
        read = load(path)
    except sv.errors.ServoError as error:
        assert error.details["path"] == str(path)
        return False
    assert repr(read) == repr(original)
    return True


@pytest.mark.parametrize("what", ["run", "study"])
def test_a_file_that_was_cut_is_refused(saved, what, tmp_path):
    path, load = saved[what]
    content, cut = path.read_bytes(), tmp_path / "cut.npz"
    for length in (0, 1, 10, len(content) // 3, len(content) // 2, len(content) - 200, len(content) - 1):
        cut.write_bytes(content[:length])
        with refused(sv.errors.ServoError, path=str(cut)):
            load(cut)


@pytest.mark.parametrize("what", ["run", "study"])
def test_flipped_bits_are_refused_or_without_effect(saved, what, tmp_path):
    path, load = saved[what]
    original, content, rng, flipped = load(path), path.read_bytes(), np.random.default_rng(7), tmp_path / "flipped.npz"
    refusals = 0
    for place in rng.integers(0, len(content), 60):
        damaged = bytearray(content)
        damaged[place] ^= 1 << int(rng.integers(8))
        flipped.write_bytes(damaged)
        refusals += not loads_or_is_refused(load, flipped, original)
    assert refusals > 20  # the others are in parts of the archive that nothing reads


@pytest.mark.parametrize("load", [sv.load])
@pytest.mark.parametrize("content", [b"PK\x03\x04", b"\x93NUMPY\x01\x00v\x00", b"not an archive", b"\x80\x04K\x01."])
def test_files_of_other_kinds_are_refused(load, content, tmp_path):
    path = tmp_path / "other.npz"
    path.write_bytes(content)
    with refused(sv.errors.ServoError, path=str(path)):
        load(path)
    np.save(tmp_path / "array.npy", np.zeros(3))
    with zipfile.ZipFile(tmp_path / "texts.npz", "w") as archive:
        archive.writestr("meta.npy", "not an array")
    for name in ("array.npy", "texts.npz", "missing.npz", "."):
        with refused(sv.errors.ServoError):
            load(tmp_path / name)
    for odd in (None, 3, object()):
        with refused(sv.errors.SpecificationError, path=odd):
            load(odd)


def rewritten(path, to, facts, **arrays):
    """The archive at a path with other facts and arrays, in another file; arrays that are None are left out."""
    with np.load(path) as data:
        content = {name: data[name] for name in data.files} | arrays
    meta = json.loads(str(content["meta"]))
    meta = facts(meta) if callable(facts) else meta | facts
    content["meta"] = np.array(meta if isinstance(meta, str) else json.dumps(meta))
    np.savez(to, **{name: array for name, array in content.items() if array is not None})
    return to


RUN = {
    "another format": ({"format": 99}, {}), "no facts": (lambda meta: "{}", {}), "a list": (lambda meta: "[1]", {}),
    "deep": (lambda meta: "[" * 100_000, {}), "a number": (lambda meta: "3", {}), "no JSON": (lambda meta: "{", {}),
    "complex times": ({}, {"t": np.array([0j, 1j])}), "no times": ({}, {"t": None}), "no jets": ({}, {"jets": None}),
    "times in no order": ({}, {"t": None}), "flat jets": ({}, {"jets": np.zeros(3)}),
    "texts as jets": ({}, {"jets": np.array([["a"]])}), "status of text": ({"status": "0"}, {}),
    "success of number": ({"success": 1}, {}), "names that are none": ({"jet_names": "x"}, {}),
    "a name too many": (lambda meta: meta | {"jet_names": [*meta["jet_names"], "z"]}, {}),
    "a name twice": (lambda meta: meta | {"jet_names": ["x"] * len(meta["jet_names"])}, {}),
    "a name of number": (lambda meta: meta | {"jet_names": [1] * len(meta["jet_names"])}, {}),
    "a signal too many": (lambda meta: meta | {"signals": [*meta["signals"], "w"]}, {}),
    "a short signal": ({}, {"signal_0": np.zeros(3)}), "a residual of one level": ({}, {"residual_0": np.zeros(3)}),
    "knots of text": ({"knots": "soon"}, {}), "counters in a list": ({"counters": []}, {}),
}  # fmt: skip


@pytest.mark.parametrize("what", RUN)
def test_a_run_that_says_something_else_is_refused(saved, what, tmp_path):
    path, load = saved["run"]
    facts, arrays = RUN[what]
    if what == "times in no order":
        arrays = {"t": np.random.default_rng(0).permutation(load(path).t)}
    with refused(sv.errors.ServoError, "cannot be read"):
        load(rewritten(path, tmp_path / "run.npz", facts, **arrays))


TABLE = {
    "another format": ({"format": 2}, {}), "kind of number": ({"kind": 3}, {}), "facts in a list": ({"meta": []}, {}),
    "names of text": ({"names": "case"}, {}), "a name too many": ({"names": ["case", "r", "error", "w"]}, {}),
    "a name twice": ({"names": ["case", "case", "error"]}, {}), "a short column": ({}, {"column_1": np.zeros(2)}),
    "a matrix": ({}, {"column_1": np.zeros((3, 2))}), "a complex column": ({}, {"column_1": np.zeros(3, complex)}),
    "objects": ({}, {"column_1": np.array([1, "a", None], dtype=object)}),
}  # fmt: skip


@pytest.mark.parametrize("what", TABLE)
def test_a_study_that_says_something_else_is_refused(saved, what, tmp_path):
    path, load = saved["study"]
    facts, arrays = TABLE[what]
    with refused(sv.errors.ServoError, "cannot be read"):
        load(rewritten(path, tmp_path / "study.npz", facts, **arrays))


def test_what_was_saved_is_read(saved, point_plan):
    run, study = (load(path) for path, load in saved.values())
    assert np.array_equal(run.jets, point_plan.jets) and run.jet_names == point_plan.jet_names
    assert study.meta == STUDY.meta and study["error"].tolist() == STUDY["error"].tolist()


# odd results ----------------------------------------------------------------------------------------------------------


CASES = sv.grid(m=[1.0, 2.0, 3.0, 4.0])


class Speechless(Exception):
    def __str__(self):
        raise ZeroDivisionError


class Endless(Exception):
    @property
    def details(self):
        raise KeyError


class OddFacts(Exception):
    details = {(1, 2): object()}


@pytest.mark.parametrize("error", [Speechless(), Endless("x"), OddFacts("x"), GeneratorExit(), SystemExit(3),
                                   ValueError("\ud800"), BaseException("base")], ids=lambda error: type(error).__name__)
def test_no_error_of_a_case_ends_a_sweep(error, tmp_path):
    def case(m):
        if m == 2.0:
            raise error
        return {"r": m}

    study = sv.sweep(case, CASES)
    assert study["error"].tolist() == ["", type(error).__name__, "", ""] and study["r"].tolist()[2:] == [3.0, 4.0]
    again = sv.load(study.save(tmp_path / "study"))
    assert again["error"].tolist() == study["error"].tolist()
    study.csv(tmp_path / "study.csv")


@pytest.mark.parametrize("value, error", [(10**400, True), (-(10**5000), True), (2**70, False), (2**63, False)],
                         ids=["400 digits", "5000 digits", "2^70", "2^63"])
def test_whole_numbers_of_any_size_are_saved_without_pickle(value, error, tmp_path):
    study = sv.sweep(lambda m: {"r": value if m == 2.0 else m}, CASES)
    again = sv.load(study.save(tmp_path / "study"))
    assert (study["error"][1] != "") == error and again["r"].dtype.kind == "f"
    assert np.isnan(again["r"][1]) if error else again["r"][1] == float(value)


def test_texts_of_a_csv_are_no_formulas(tmp_path):
    texts = ["=1+2", "+1", "-1+2", "@SUM(A1)", "\t=1", "\r=1", "plain", "1-2", "\ud800"]
    study = Study("sweep", {"=cmd|' /C calc'!A0": texts, "number": [-1.5] * len(texts)})
    with open(study.csv(tmp_path / "study.csv"), newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    assert header == ["'=cmd|' /C calc'!A0", "number"]
    assert [row[0] for row in rows] == [f"'{text}" for text in texts[:5]] + ["'\n=1", "plain", "1-2", "\\ud800"]
    assert [float(row[1]) for row in rows] == [-1.5] * len(texts)


def test_paths_that_no_file_can_have_are_refused(tmp_path, point_plan):
    for name in ("a\0b", "n" * 300, "\ud800"):
        for write in (STUDY.csv, STUDY.save, point_plan.save):
            with refused(sv.errors.SpecificationError, path=tmp_path / name):
                write(tmp_path / name)


@pytest.mark.parametrize("cases", [3, None, 1.5, object()])
def test_cases_that_are_no_sequence_are_refused(cases):
    with refused(sv.errors.SpecificationError, type=type(cases).__name__):
        sv.sweep(lambda m: {"r": m * m}, cases)
