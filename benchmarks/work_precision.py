"""Work-precision figures of gallery scenes and the page that shows them: python benchmarks/work_precision.py.

Writes docs/work_precision.md and docs/figures/wp_NAME.png; the names of scenes may be given to redraw only these
figures.
"""

import sys
from pathlib import Path

import numpy as np

import servoctl as sv
from servoctl.gallery import gallery

DOCS = Path(__file__).parents[1] / "docs"
SCENES = ("appell-hamel", "two-cars-ideal", "mass-on-car", "passive-arm", "wheeled-robot", "overhead-crane", "vtol")
METHODS = ("Taylor", "RK4", "RK8", "RadauIIA", "RK45", "DOP853", "Radau", "LSODA")
DRIFTS = (None, "project")
ERRORS = (1e-4, 1e-6, 1e-9)

TEXT = """# Speed against accuracy, measured

Each figure is `sv.tradeoff(model, start, t_span).plot()` for a scene of the gallery, made by
`python benchmarks/work_precision.py`; `servoctl tradeoff NAME` measures one on your machine, and your own scene, and
[levels of modelling](levels.md) are compared in the same way. A point is one setting of one method: the error of the
whole motion (the largest deviation of a component of the state, relative to its size, at 402 instants that are the same
for all methods, between their steps too) over the shortest of three calls after a warm-up. The reference is the Taylor
method at 1e-15, Radau IIA where series take longer, or Newton's method at each instant where nothing is integrated;
another method verifies it, and the grey band at the bottom is how far the two agree. Seconds depend on the machine and
on what else it does; evaluations do not.

The rows take at most 30 s of processor time, or `budget=`, and those that need least come first: every method has a row
before any has its finest setting. The reference is apart, and what it took is printed. What a method cannot do on a
scene, or not in the time that is left, is one row with the reasons. One sentence above the table says what to take,
such as "RadauIIA at rtol 1e-07: 4e-09 for 11 ms; of these rows, below 2e-10 only RK8", and the figure names the methods
on the front.

Measured on {processor}, {cores} cores, {system}, compiler {compiler}, with other work on the machine;
{versions}; {measured}.

## What it says

- The Taylor method needs the fewest evaluations at every accuracy; one of its evaluations is a whole series, and
  counted in operations it is still the cheapest at 1e-9 (`tests/test_ordering.py`: Taylor, then DOP853, RK45, RK4).
- In seconds, the compiled Runge-Kutta methods of order 8 and 4 and the Taylor method are the fastest on these scenes: a
  call takes about a millisecond. Runge-Kutta methods of fixed length do not find their steps themselves, and between
  their steps the interpolation decides: for 1e-9 they need steps four times as short as at the steps alone. The Taylor
  method finds its steps, and takes about the same time at every accuracy.
- scipy's methods step in Python, at ten to a hundred times the time of compiled ones.
- Projection costs the compiled methods little and keeps residuals at rounding at each step; in scipy's methods it is
  the greater part of the time.
- Where the program leaves nothing to integrate (overhead-crane, vtol), solving each instant is exact to rounding. An
  integration of the same program drifts, unless projection solves it again after each step.

`sv.simulate` follows from this: each instant solved where nothing is integrated; else the Taylor method. DOP853, which
needs no compiler, takes its place with poles, which series exclude, and where the rates have more than 300 operations,
as making a series takes seconds. Both give way to Radau IIA where stability limits their steps, and where more than
400 steps are to come that are not compiled, which the run's message then says; not where its own code has so many
operations that compiling it would take longer. `accuracy=1e-6` adds projection and a tolerance that is lowered until
two motions agree to the accuracy.

## The fastest setting for an error

| scene | error | fastest setting | measured error | ms | fewest evaluations |
|---|---|---|---|---|---|
{table}

## Figures
"""


def study(name):
    """The measured trade of a scene."""
    scene = gallery[name]
    model = sv.derive(*scene.build())
    start = model.start(t=scene.t_span[0], guess=scene.guess, **scene.start)
    methods = ("algebraic", *METHODS) if model.flat else METHODS
    return sv.tradeoff(model, start, scene.t_span, methods, DRIFTS)


def figure(name, trade):
    """Draw one study; returns the path of the figure."""
    path = DOCS / "figures" / f"wp_{name}.png"
    path.parent.mkdir(exist_ok=True)
    trade.plot(title=name).figure.savefig(path, dpi=90)
    return path


def lines(name, trade):
    """Rows of the table for one scene."""
    for error in ERRORS:
        row = trade.recommend(error=error).row
        drift = "" if row["drift"] == "none" else f", drift={row['drift']!r}"
        setting = f"{row['method']}, {row['setting']}={row['value']:.3g}{drift}"
        few = trade.pareto("evaluations")
        first = few.rows()[int(np.argmax(np.maximum(few["error"], few.uncertainty) <= error))]
        fewest = f"{first['method']}, {first['evaluations']:.0f}"
        yield f"| {name} | {error:.0e} | {setting} | {row['error']:.1e} | {1e3 * row['seconds']:.2f} | {fewest} |"


def main(names=()):
    """Measure, draw, and write the page where all scenes were measured."""
    trades = {}
    for name in names or SCENES:
        trades[name] = study(name)
        print(trades[name])
        print(figure(name, trades[name]), flush=True)
    if names:
        return
    meta = next(iter(trades.values())).meta
    versions = ", ".join(f"{name} {number}" for name, number in meta["machine"]["versions"].items())
    told = meta["machine"] | {"versions": versions, "measured": meta["measured"]}
    told["compiler"] = Path(told["compiler"]).name
    table = "\n".join(line for name, trade in trades.items() for line in lines(name, trade))
    figures = "\n".join(
        f"\n### {name}\n\n{gallery[name].description}\n\n![{name}](figures/wp_{name}.png)" for name in trades
    )
    (DOCS / "work_precision.md").write_text(TEXT.format(table=table, **told) + figures + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
