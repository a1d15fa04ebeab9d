"""The page of a run: one file that holds what its folder says, with all pictures inside."""

import base64
import shlex
from html import escape

from servoctl.markup import EXTREMA, digits, rows_of
from servoctl.units import unit_of
from servoctl.verification.result import CHECK

NAME = "index.html"
VERSIONS = ("", "version")
PICTURES = {  # file: what it shows
    "motion.png": "The mechanism at instants from the start (light) to the end (dark), over the programmed path;"
    " side by side where it turns in place.",
    "sheet.png": "Coordinates, required actuation with its extrema, residuals of the constraints and their derivatives,"
    " and the closed loop.",
}
STYLE = """
body { font: 16px/1.45 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #222; }
img { max-width: max(100%, 44rem); } figure { margin: 1.2rem 0; overflow-x: auto; } figcaption { color: #555; }
table { border-collapse: collapse; margin: .6rem 0 1.2rem; display: block; overflow-x: auto; }
th, td { padding: .2rem .9rem .2rem 0; text-align: left; }
td.n, th.n { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
tr { border-bottom: 1px solid #ddd; }
pre { background: #f5f5f5; padding: .8rem; overflow-x: auto; font-size: 13px; } .verdict { font-weight: 600; }
"""


def write_page(folder, facts, units, verification, report, motion):
    """Write index.html from the facts of summary.json, the report and the pictures in the folder.

    `verification` may be None; `report` is a text, `motion` HTML of the mechanism in motion, or "".
    """
    scene, command = facts["scene"], shlex.join(["servoctl", *facts["command"]])
    parts = [
        f"<h1>{escape(scene['name'])}</h1>",
        f"<p>{escape(scene['description'])}</p>",
        f'<p class="verdict">{escape(_outcome(facts, verification))}</p>',
        motion,
        *_pictures(folder),
        _chapter("What was computed", rows_of(("", "value"), _asked(facts, units))),
        _chapter("Extrema", rows_of(EXTREMA, _ends(facts, units))),
        *_of_loop(facts, units),
        *_checks(verification),
        _chapter("Report", f"<pre>{escape(report)}</pre>"),
        _chapter("To repeat it", f"<pre>{escape(command)}</pre>" + rows_of(VERSIONS, facts["versions"].items())),
    ]
    body, title = "\n".join(parts), escape(scene["name"])
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{title}</title>'
    head = f'<!DOCTYPE html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>'
    text = f"{head}\n<body>\n{body}\n</body></html>\n"
    (folder / NAME).write_text(text, encoding="utf-8")


def _outcome(facts, verification):
    verified = "not verified" if verification is None else f"verification {verification.verdict}"
    remark = "".join(f" {said[:1].upper()}{said[1:]}." for said in facts["remarks"][:1])
    return f"{facts['verdict'][:1].upper()}{facts['verdict'][1:]}; {facts['message']}; {verified}.{remark}"


def _pictures(folder):
    """Figures with their pictures inside."""
    present = {name: words for name, words in PICTURES.items() if (folder / name).exists()}
    for name, words in present.items():
        content = base64.b64encode((folder / name).read_bytes()).decode()
        source = f"data:image/{name.rpartition('.')[2]};base64,{content}"
        yield f'<figure><img alt="{name}" src="{source}"><figcaption>{escape(words)}</figcaption></figure>'


def _asked(facts, units):
    parameters, start = (
        ", ".join(f"{name} = {digits(value)} {unit_of(name, units)}".strip() for name, value in values.items())
        for values in (facts["parameters"], facts["start"]["values"])
    )
    yield "time span [s]", " to ".join(map(digits, facts["t_span"]))
    yield "parameters, SI", parameters
    yield "start, SI", start
    yield "method", facts["method"] + (f", drift: {facts['drift']}" if facts["drift"] else "")
    yield "samples", str(facts["samples"])
    if facts["structure"]["index"] is not None:
        yield "index", str(facts["structure"]["index"])


def _ends(facts, units):
    for name, ends in facts["extrema"].items():
        low, high = ends["min"], ends["max"]
        yield name, *map(digits, (low["value"], low["t"], high["value"], high["t"])), unit_of(name, units) or "SI"


def _of_loop(facts, units):
    loop = facts["closed_loop"]
    if loop is None:
        return
    other = [f"{n} = {digits(v)}" for n, v in loop["machine"].items() if facts["parameters"].get(n) != v]
    noise = [f"{n} {digits(v)}" for n, v in (loop["noise"] or {}).items()]
    said = [f"{loop['law']} at {digits(loop['rate'])} Hz", loop["message"]]
    said += [f"on a machine with {', '.join(other)}"] * bool(other) + [f"noise {', '.join(noise)}"] * bool(noise)
    errors = ((name, digits(e["worst"]), digits(e["end"])) for name, e in loop["residuals"].items())
    inputs = ((n, digits(v["min"]), digits(v["max"]), unit_of(n, units) or "SI") for n, v in loop["inputs"].items())
    content = f"<p>{escape('; '.join(said))}.</p>" + rows_of(("residual, SI", "worst", "at the end"), errors)
    yield _chapter("Closed loop", content + rows_of(("input", "least", "greatest", "unit"), inputs))


def _checks(verification):
    """Each number of the verification with its limit, and what was not checked."""
    if verification is None:
        return
    notes = "".join(f"<p>{escape(note)}</p>" for note in (*verification.doubts, *verification.notes))
    content = rows_of(CHECK, verification.rows()) + notes
    yield _chapter(f"Verification: {verification.verdict}", content)


def _chapter(title, content):
    return f"<h2>{escape(title)}</h2>\n{content}"
