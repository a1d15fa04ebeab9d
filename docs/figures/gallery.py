"""Write docs/gallery.md from the scenes and their models, and draw each scene: docs/figures/gallery/NAME.png.

python docs/figures/gallery.py              the page and all pictures
python docs/figures/gallery.py NAME ...     the page and these pictures
"""

import io
import sys
import textwrap
from pathlib import Path

import servoctl as sv
from servoctl.gallery import gallery
from servoctl.inversion.verdict import HYPERBOLIC_ZEROS, verdict
from servoctl.shell.listing import subjects

PAGE = Path(__file__).parents[1] / "gallery.md"
PICTURES = Path(__file__).parent / "gallery"
SIZE, DPI, COLOURS = (4.8, 3.0), 75, 32  # inches; of a picture; colours of its palette
HEAD = """# Gallery

`servoctl run NAME` runs a scene, `servoctl report NAME` prints how its program is reduced and its verdict, and
`servoctl list --long` prints what follows without the pictures. Orders are those of the residuals as given, with those
of material constraints after a plus sign. A plan without free initial values is computed at each instant, without
integration. The index is not defined for orders above 2. Each number is tested against its source.

This page is written by [figures/gallery.py](figures/gallery.py).
"""
COLUMNS = """| name | what | orders | hidden | index | free initial values |
|---|---|---|---|---|---|
"""


def page(model_of):
    """The text of the page; `model_of` returns the model of a scene by its name."""
    return "\n".join([HEAD, *(_group(group, members, model_of) for group, members in subjects())])


def _group(group, members, model_of):
    rows = "".join(f"| {name} | {' | '.join(facts(model_of(name), scene))} |\n" for name, scene in members.items())
    return f"## {group.capitalize()}\n\n{COLUMNS}{rows}\n" + "\n".join(_shown(*item) for item in members.items())


def facts(model, scene):
    """What a scene is, the orders of its residuals, hidden constraints, the index, free initial values: as text."""
    given = model.reduction.original.values()
    orders = [", ".join(str(row.order) for row in given if row.kind == kind) for kind in ("program", "material")]
    index = model.structure().index or "-"
    numbers = (" + ".join(filter(None, orders)), len(model.reduction.hidden), index, model.free)
    return [scene.description.rstrip("."), *map(str, numbers)]


def _shown(name, scene):
    text = textwrap.fill(f"{scene.teaches} {scene.number} Source: {scene.source}.", 118)
    return f"### {name}\n\n![{scene.description}](figures/gallery/{name}.png)\n\n{text}\n"


def run_of(name):
    """The motion of a scene: bounded where its internal dynamics are unstable, up to its end where it is singular."""
    scene = gallery[name]
    model = sv.derive(*scene.build())
    start = model.start(**scene.start, guess=scene.guess)
    unstable = verdict(model, start).dynamics == HYPERBOLIC_ZEROS
    span = (scene.t_span[0], max(scene.t_span[1], *model.knots)) if unstable else scene.t_span
    try:
        return sv.simulate(model, start, span, "bounded" if unstable else None)
    except sv.SingularProgram as error:
        return error.run


def draw(name, folder):
    """Draw a scene at several instants into a small file with a palette."""
    from matplotlib.figure import Figure
    from PIL import Image

    figure = Figure(figsize=SIZE, dpi=DPI, layout="constrained")
    sv.figures.stroboscope(run_of(name), ax=figure.subplots(), poses=7)
    drawn = io.BytesIO()
    figure.savefig(drawn, format="png")
    Image.open(drawn).convert("RGB").quantize(COLOURS).save(Path(folder) / f"{name}.png", optimize=True)


def main(names):
    """Write the page, and the pictures of these scenes or of all."""
    models = {}

    def model_of(name):
        return models.setdefault(name, sv.derive(*gallery[name].build()))

    PAGE.write_text(page(model_of), encoding="utf-8")
    for name in names or gallery:
        draw(name, PICTURES)


if __name__ == "__main__":
    main(sys.argv[1:])
