"""Write docs/numbers.md, the constants of the package that are numbers: `python docs/numbers.py`.

A row has the value, what the comment beside it says, and the tests that fail when it is ten times more or less, which
tests/pinned.txt tells (tests/adversary/constants.py finds them).
"""

import ast
import re
import tokenize
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE, PAGE, PINNED = ROOT / "servoctl", ROOT / "docs" / "numbers.md", ROOT / "tests" / "pinned.txt"
HEAD = """---
nosearch: true
---

# Numbers that decide

Whether an entry is zero, a row depends on others, or a motion has become singular is decided by comparing floating-
point numbers. This page, which `python docs/numbers.py` writes from the sources, lists them by file: the value, what
it is, and the test that fails where it is ten times larger and where it is ten times smaller; in one direction alone
where "(more)" or "(less)" follows. "None" means that the tests of the file's subject passed both times: the number
has room on both sides or the tests have a gap. Where nothing is said, it was not tried; `python
tests/adversary/constants.py FILE NAME --tests ...` tries one.

Two facts set the scale. A double has a relative rounding error of 1.1e-16, a long double on x86 of 5.4e-20; ranks are
decided in long doubles, so that the rounding of their own arithmetic lies far below the rounding of what they are
given. And the numbers are relative: to the size of the terms of an entry, to rows and columns that were equilibrated,
or to the largest value that a quantity takes nearby. A change of units changes no decision.
"""


def numeric(node):
    """Whether an expression contains numbers and no texts: 1e-9, (0.1, 0.3), 64 * EPS."""
    if any(isinstance(each, ast.Dict | ast.Set | ast.Lambda) for each in ast.walk(node)):
        return False
    values = [type(each.value) for each in ast.walk(node) if isinstance(each, ast.Constant)]
    return bool(values) and {*values} <= {int, float}


def comments(path):
    """{line: comment} of a file."""
    with tokenize.open(path) as file:
        tokens = list(tokenize.generate_tokens(file.readline))
    return {t.start[0]: t.string.lstrip("# ") for t in tokens if t.type == tokenize.COMMENT}


def constants(path):
    """(name, value as it is written, comment) of a module's constants that are numbers."""
    text, said = path.read_text(encoding="utf-8"), comments(path)
    for node in ast.parse(text).body:
        if not isinstance(node, ast.Assign):
            continue
        (target,), comment = node.targets, said.get(node.end_lineno, said.get(node.lineno - 1, ""))
        several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
        pairs = zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]
        for name, value in pairs:
            if isinstance(name, ast.Name) and name.id.lstrip("_").isupper() and numeric(value):
                yield name.id, " ".join(ast.get_source_segment(text, value).split()), comment


def pinned():
    """{(file, name): tests} of tests/pinned.txt."""
    lines = PINNED.read_text(encoding="utf-8").splitlines()
    return {tuple(line.split(maxsplit=2)[:2]): line.split(maxsplit=2)[2] for line in lines}


def page():
    """The text of docs/numbers.md."""
    parts, tests = [HEAD], pinned()
    for path in sorted(PACKAGE.rglob("*.py")):
        file = path.relative_to(PACKAGE).as_posix()
        rows = [] if file.startswith("gallery/") else list(constants(path))
        if rows:
            parts += [f"\n## `servoctl/{file}`\n\n| name | value | what it is | pinned by |\n{'| --- ' * 4}|\n"]
        for name, value, comment in rows:
            found = re.sub(r"(test_\w+)", r"`\1`", tests.get((file, name), ""))
            parts += [f"| `{name}` | {value} | {comment.replace('|', chr(92) + '|')} | {found} |\n"]
    return "".join(parts)


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
