"""The page of a run: one file that holds what its folder says, with all pictures inside."""

import base64
import shlex
from html import escape

from servoctl.verification.result import WORDS

NAME = "index.html"
VERSIONS = ("", "version")
EXTREMA = ("signal", "least", "at t [s]", "greatest", "at t [s]", "unit")
PICTURES = {  # file: what it shows
    "motion.png": "The mechanism at instants from the start (light) to the end (dark), over the programmed path.",
    "path.png": "The path.",
    "coordinates.png": "Coordinates.",
    "actuation.png": "Required actuation, with its extrema.",
    "closed_loop.png": "The closed loop.",
    "residuals.png": "Residuals of the constraints and their derivatives.",
}
STYLE = """
body { font: 16px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
img { max-width: 100%; } figure { margin: 1.2rem 0; } figcaption { color: #555; }
table { border-collapse: collapse; margin: .6rem 0 1.2rem; } th, td { padding: .2rem .9rem .2rem 0; text-align: left; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; } tr { border-bottom: 1px solid #ddd; }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 13px; } .verdict { font-weight: 600; }
"""


def write_page(folder, facts, units, verification, report, motion):
    """Write index.html from the facts of summary.json, the report and the pictures in the folder.

    Parameters
    ----------
    folder : Path
    facts : dict
    units : dict of str to str
    verification : Verification or None
    report : str
    motion : str
        HTML of the mechanism in motion, or "".
    """
    scene, command = facts["scene"], shlex.join(["servoctl", *facts["command"]])
    parts = [
        f"<h1>{escape(scene['name'])}</h1>",
        f"<p>{escape(scene['description'])}</p>",
        f'<p class="verdict">{escape(_outcome(facts, verification))}</p>',
        motion,
        *_pictures(folder),
        _chapter("What was computed", _rows_of(("", "value"), _asked(facts))),
        _chapter("Extrema", _rows_of(EXTREMA, _ends(facts, units))),
        *_of_loop(facts, units),
        *_checks(verification),
        _chapter("Report", f"<pre>{escape(report)}</pre>"),
        _chapter("To repeat it", f"<pre>{escape(command)}</pre>" + _rows_of(VERSIONS, facts["versions"].items())),
    ]
    body, title = "\n".join(parts), escape(scene["name"])
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    head = f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>'
    text = f"{head}\n<body>\n{body}\n</body></html>\n"
    (folder / NAME).write_text(text, encoding="utf-8")


def _outcome(facts, verification):
    verified = "not verified" if verification is None else f"verification {verification.verdict}"
    return f"{facts['verdict'][:1].upper()}{facts['verdict'][1:]}; {facts['message']}; {verified}."


def _pictures(folder):
    """Figures with their pictures inside."""
    present = {name: words for name, words in PICTURES.items() if (folder / name).exists()}
    for name, words in present.items():
        content = base64.b64encode((folder / name).read_bytes()).decode()
        source = f"data:image/{name.rpartition('.')[2]};base64,{content}"
        yield f'<figure><img alt="{name}" src="{source}"><figcaption>{escape(words)}</figcaption></figure>'


def _asked(facts):
    start = ", ".join(f"{name} = {_digits(value)}" for name, value in facts["start"]["values"].items())
    yield "time span [s]", " to ".join(map(_digits, facts["t_span"]))
    yield "parameters, SI", ", ".join(f"{name} = {_digits(value)}" for name, value in facts["parameters"].items())
    yield "start, SI", start
    yield "method", facts["method"] + (f", drift: {facts['drift']}" if facts["drift"] else "")
    yield "samples", str(facts["samples"])
    yield "index", str(facts["structure"]["index"])


def _ends(facts, units):
    for name, ends in facts["extrema"].items():
        low, high = ends["min"], ends["max"]
        yield name, *map(_digits, (low["value"], low["t"], high["value"], high["t"])), units.get(name, "SI")


def _of_loop(facts, units):
    loop = facts["closed_loop"]
    if loop is None:
        return
    other = [f"{n} = {_digits(v)}" for n, v in loop["machine"].items() if facts["parameters"].get(n) != v]
    noise = [f"{n} {_digits(v)}" for n, v in (loop["noise"] or {}).items()]
    said = [f"{loop['law']} at {_digits(loop['rate'])} Hz", loop["message"]]
    said += [f"on a machine with {', '.join(other)}"] * bool(other) + [f"noise {', '.join(noise)}"] * bool(noise)
    errors = ((name, _digits(e["worst"]), _digits(e["end"])) for name, e in loop["residuals"].items())
    inputs = ((n, _digits(v["min"]), _digits(v["max"]), units.get(n, "SI")) for n, v in loop["inputs"].items())
    content = f"<p>{escape('; '.join(said))}.</p>" + _rows_of(("residual, SI", "worst", "at the end"), errors)
    yield _chapter("Closed loop", content + _rows_of(("input", "least", "greatest", "unit"), inputs))


def _checks(verification):
    """Each number of the verification with its limit, and what was not checked."""
    if verification is None:
        return
    limits = {name: verification.limits.get(name) for name in verification.numbers}
    rows = [
        (name, _digits(value), _digits(limits[name]), _within(value, limits[name]), WORDS.get(name, ""))
        for name, value in verification.numbers.items()
    ]
    notes = "".join(f"<p>{escape(note)}</p>" for note in (*verification.doubts, *verification.notes))
    content = _rows_of(("check, relative", "value", "limit", "", ""), rows) + notes
    yield _chapter(f"Verification: {verification.verdict}", content)


def _within(number, limit):
    return "" if limit is None else "within" if number <= limit else "beyond"


def _chapter(title, content):
    return f"<h2>{escape(title)}</h2>\n{content}"


def _rows_of(head, rows):
    rows = [tuple(map(str, row)) for row in rows]
    if not rows:
        return "<p>none</p>"
    numeric = [all(_is_number(row[i]) for row in rows) for i in range(len(head))]

    def line(tag, cells):
        marked = (f'<{tag}{" class=n" * n}>{escape(c)}</{tag}>' for c, n in zip(cells, numeric, strict=True))
        return f"<tr>{''.join(marked)}</tr>"

    return f"<table>{line('th', head)}{''.join(line('td', row) for row in rows)}</table>"


def _is_number(text):
    try:
        float(text)
    except ValueError:
        return text == "–"
    return True


def _digits(value):
    return "–" if value is None else f"{value:.6g}"
