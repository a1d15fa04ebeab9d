"""Write the gallery: docs/gallery.md, and for each scene docs/gallery/NAME.md and its pictures in docs/figures.

python docs/figures/gallery.py              all of it, some seconds for each scene
python docs/figures/gallery.py NAME ...     docs/gallery.md, and these scenes
"""

import ast
import contextlib
import inspect
import io
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np

import servoctl as sv
from servoctl.gallery import builder, gallery
from servoctl.gallery.scenes import SINGULAR_PROGRAMS
from servoctl.inversion.verdict import HYPERBOLIC_ZEROS, verdict
from servoctl.shell.listing import subjects

DOCS = Path(__file__).parents[1]
PICTURES, SIGNALS = DOCS / "figures" / "gallery", DOCS / "figures" / "signals"
SIZE, DPI, COLOURS = (4.8, 3.0), 110, 64  # inches; of a picture; colours of a palette
POSES, RESTS = 7, 0.01  # of a picture; part of the way before and after them, which mostly is rest
SIGNALS_DPI = 72  # of figures that are 10 inches wide
WIDTH = 118  # characters of a line
INERTIAS = ("m", "j", "density")  # how names of parameters begin that a machine may have otherwise than its plan
IMPORTS = (ast.Import, ast.ImportFrom)
HEAD = """# Gallery

Each scene has a page with what it teaches, its output, figures, code, and commands to try. It quotes one result, which
is tested against a closed form or the cited source. `servoctl list` prints the names, `servoctl run NAME` runs a scene.
"""
FACTS = """| orders of the residuals | hidden constraints | index | free initial values |
|---|---|---|---|
"""
LEGEND = """
Orders of material constraints follow a plus sign; above order 2 no index is defined ([glossary](../glossary.md)).
"""
CODE = "```{{literalinclude}} ../../servoctl/gallery/{file}\n{part}\n```\n"
BEGIN = """import servoctl as sv
from servoctl.gallery import {function}

model = sv.derive(*{function}({arguments}))
start = model.start({start})
"""
GOES_ON = """run = sv.simulate(model, start, {how})
print(model, run, sv.verify(run), sep="\\n")
"""
ENDS = """try:
    sv.simulate(model, start, {how})
except sv.errors.SingularProgram as error:
    print(model, error, sep="\\n")
    run = error.run
"""


# --- the page of all scenes


def page():
    """The text of docs/gallery.md: scenes by subject, each with its picture, its name and one line."""
    return "\n".join([HEAD, *(_group(group, members) for group, members in subjects()), _contents()])


def _group(group, members):
    shown = (
        f"- [![{scene.description}](figures/gallery/{name}.png)](gallery/{name}.md)\n"
        f"  [{name}](gallery/{name}.md): {scene.description}\n"
        for name, scene in members.items()
    )
    return f"## {group.capitalize()}\n\n:::{{container}} cards\n{''.join(shown)}:::\n"


def _contents():
    return "\n".join(["```{toctree}", ":hidden:", "", *(f"gallery/{name}" for name in gallery), "```\n"])


# --- the page of a scene


def scene_page(name):
    """The text of docs/gallery/NAME.md, and the run that it prints."""
    scene, (written, printed, run) = gallery[name], executed(name)
    parts = [
        f"# {name}\n\n{scene.description}\n",
        f"![{scene.description}](../figures/gallery/{name}.png)\n",
        textwrap.fill(f"{scene.teaches} {scene.number} Source: {scene.source}.", WIDTH) + "\n",
        f"{FACTS}| {' | '.join(facts(run.model))} |\n{LEGEND}",
        f"## Output\n\n```python\n{written}```\n\n```text\n{printed}```\n",
        f"![Coordinates and forces over time](../figures/signals/{name}.png)\n",
        f"## Code\n\n{code(scene)}",
        f"## Try it\n\n{commands(name, run)}",
    ]
    return "\n".join(parts), run


def facts(model):
    """Orders of the residuals as given, hidden constraints, the index, free initial values: as text."""
    given = model.reduction.original.values()
    orders = [", ".join(str(row.order) for row in given if row.kind == kind) for kind in ("program", "material")]
    index = model.structure().index or "-"
    return [" + ".join(filter(None, orders)), *map(str, (len(model.reduction.hidden), index, model.free))]


def executed(name):
    """Python that runs a scene by its row of the table, what it prints, and the run."""
    scene, printed, names = gallery[name], io.StringIO(), {}
    (function, *given), options = scene.build.args, scene.build.keywords
    arguments = _listed(map(repr, given), options)
    begin = BEGIN.format(function=function, arguments=arguments, start=_listed((), scene.start, scene.guess))
    with contextlib.redirect_stdout(printed):
        exec(compile(begin, name, "exec"), names)
        end = (ENDS if scene.group == SINGULAR_PROGRAMS else GOES_ON).format(how=_how(scene, names))
        exec(compile(end, name, "exec"), names)
    return begin + end, printed.getvalue(), names["run"]


def _listed(given, options, guess=()):
    guess = [f"guess={guess}"] if guess else []
    return ", ".join([*given, *(f"{name}={value!r}" for name, value in options.items()), *guess]).replace("'", '"')


def _how(scene, names):
    """The time span; the bounded motion, up to the end of the path, where the internal dynamics are unstable."""
    if verdict(names["model"], names["start"]).dynamics != HYPERBOLIC_ZEROS:
        return scene.t_span
    ends = (path.breaks[-1] for path in names["model"].paths.values())
    return f'{(scene.t_span[0], max(scene.t_span[1], *map(float, ends)))}, "bounded"'


def code(scene):
    """Directives that include the function of a scene and what it uses of its module, after the imports."""
    function = builder(scene.build.args[0])
    path = Path(inspect.getsourcefile(function))
    text = path.read_text(encoding="utf-8")
    body = ast.parse(text).body
    own = {name: statement for statement in body for name in _names(statement)}
    used = [function.__name__]
    for name in used:  # it grows
        within = {node.id for node in ast.walk(own[name]) if isinstance(node, ast.Name)}
        used += [other for other in own if other in within and other not in used]
    statements = dict.fromkeys(statement for name, statement in own.items() if name in used)
    imports = "\n".join(ast.unparse(statement) for statement in statements if isinstance(statement, IMPORTS))
    shown = [statement for statement in statements if not isinstance(statement, IMPORTS)]
    shown.sort(key=lambda statement: statement is not own[function.__name__])
    parts = [f"`{path.name}` ([the file](../../servoctl/gallery/{path.name})):\n", f"```python\n{imports}\n```\n"]
    following = dict(zip(body, [*body[1:], None], strict=True))
    included = (_included(path.name, statement, following[statement], text.splitlines()) for statement in shown)
    return "\n".join([*parts, *included])


def _names(statement):
    """Names that a statement of a module defines."""
    if isinstance(statement, IMPORTS):
        return [alias.asname or alias.name for alias in statement.names]
    if isinstance(statement, ast.FunctionDef):
        return [statement.name]
    targets = (node for target in getattr(statement, "targets", ()) for node in ast.walk(target))
    return [node.id for node in targets if isinstance(node, ast.Name)]


def _included(file, statement, following, lines):
    """The directive for a function, by its name, or for a value, by its first line and its last or what follows."""
    if isinstance(statement, ast.FunctionDef):
        return CODE.format(file=file, part=f":pyobject: {statement.name}")
    first, after = (lines[each.lineno - 1].split("  #")[0] for each in (statement, following))
    end = f":end-at: {first}" if statement.end_lineno == statement.lineno else f":end-before: {after}"
    return CODE.format(file=file, part=f":start-at: {first}\n{end}")


def commands(name, run):
    """Commands of the shell for a scene: the motion, the derivation, another machine."""
    values = run.model.reduction.mechanism.parameters.defaults
    lines = [f"servoctl run {name} --animate", f"servoctl report {name}"]
    said = "The first command writes a page with the machine in motion, the second prints the verdict on the program"
    if values:
        changed = min(values, key=lambda key: (key != "m_load", not key.lower().startswith(INERTIAS)))
        planned = run.model.reduction.ideal or not run.success
        lines.append(f"servoctl run {name} {'--set' if planned else '--machine'} {changed}={1.2 * values[changed]:g}")
        said += ", the third " + ("moves" if planned else "lets a controller follow the plan on") + " another machine"
    return textwrap.fill(f"{said}.", WIDTH) + "\n\n" + "".join(f"    {line}\n" for line in lines)


# --- pictures


def draw(name, run, pictures=PICTURES, signals=SIGNALS):
    """Draw the machine of a run at several instants, and its coordinates and forces over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    sv.figures.stroboscope(moving(run), ax=figure.subplots(), poses=POSES)
    _write([figure], pictures / f"{name}.png")
    shown = [sv.figures.signals(run)] + ([sv.figures.actuation(run)] if sv.figures.efforts(run) else [])
    figures = [np.ravel(axes)[0].figure for axes in shown]
    for figure in figures:
        figure.set_dpi(SIGNALS_DPI)
    _write(figures, signals / f"{name}.png")


def moving(run):
    """The run without the rests at its ends, so that poses at equal times show the motion."""
    shown = sv.figures.animate(run, fps=50)
    points = [np.reshape(shape, (2, -1, len(shown.t))) for shape in shown.shapes.values()]
    way = sum(np.linalg.norm(np.diff(shape), axis=0).mean(axis=0) for shape in points).cumsum()
    begin, end = np.interp([RESTS, 1 - RESTS], np.append(0.0, way) / way[-1], shown.t)
    rows = (run.t >= begin) & (run.t <= end)
    return replace(run, t=run.t[rows], jets=run.jets[:, rows], variants=())


def _write(figures, path):
    """Write figures one below the other into a small file with a palette."""
    from PIL import Image

    pictures = []
    for figure in figures:
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=figure.dpi)
        pictures.append(Image.open(drawn).convert("RGB"))
    whole = Image.new("RGB", (max(p.width for p in pictures), sum(p.height for p in pictures)), "white")
    for i, picture in enumerate(pictures):
        whole.paste(picture, (0, sum(p.height for p in pictures[:i])))
    path.parent.mkdir(exist_ok=True)
    whole.quantize(COLOURS, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(path, optimize=True)


def main(names):
    """Write the page of all scenes, and the pages and pictures of these or of all."""
    (DOCS / "gallery").mkdir(exist_ok=True)
    (DOCS / "gallery.md").write_text(page(), encoding="utf-8")
    for name in names or gallery:
        text, run = scene_page(name)
        (DOCS / "gallery" / f"{name}.md").write_text(text, encoding="utf-8")
        draw(name, run)


if __name__ == "__main__":
    main(sys.argv[1:])
