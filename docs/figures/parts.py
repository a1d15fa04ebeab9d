"""Draw the parts of the package and what each imports, from the sources: docs/figures/parts.png."""

import ast
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt  # noqa: E402

from servoctl import HOMES  # noqa: E402

PACKAGE = Path(__file__).parents[2] / "servoctl"
WIDTH, HEIGHT = 1.62, 0.5  # of a box; floors are 1 apart
STEP, TRIES = 2.0, 6000  # distance of columns; moves of the search
TOOLS = ("errors", "checks", "tolerances", "values", "archive", "progress", "version")  # of which any part may import
EDGE, FILL = "#4a6785", "#eef3f8"
ARROW = {"arrowstyle": "-|>", "color": "#9db2c6", "lw": 1.1, "shrinkA": 0, "shrinkB": 0}


def parts():
    """Lines and imported parts of every part: a folder or a file of the package."""
    lines, imports = {}, {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        if name.startswith("__") or name == "types":  # they gather the rest
            continue
        text = path.read_text(encoding="utf-8")
        lines[name] = lines.get(name, 0) + len(text.splitlines())
        nodes = list(ast.walk(ast.parse(text)))
        modules = [n.module for n in nodes if isinstance(n, ast.ImportFrom) and n.module]
        modules += [f"servoctl.{a.name}" for n in nodes if isinstance(n, ast.ImportFrom) and n.module == "servoctl"
                    for a in n.names]  # fmt: skip
        if any(a.name == "servoctl" for n in nodes if isinstance(n, ast.Import) for a in n.names):  # as sv
            names = {n.attr for n in nodes if isinstance(n, ast.Attribute) and getattr(n.value, "id", "") == "sv"}
            modules += [f"servoctl.{HOMES.get(name, name)}" for name in names]
        imported = {m.split(".")[1] for m in modules if m.startswith("servoctl.")}
        imports.setdefault(name, set()).update(imported - {name})
    return lines, {name: imported & set(lines) for name, imported in imports.items()}


def heights(imports):
    """Longest path down to a part that imports nothing; a circle of imports is an error."""
    height = {}
    for name in TopologicalSorter(imports).static_order():  # what a part imports comes before it
        height[name] = max((1 + height[below] for below in imports[name]), default=0)
    return height


def direct(imports):
    """Imports that are not implied by a longer path."""
    reach = {}
    for name in TopologicalSorter(imports).static_order():
        reach[name] = imports[name].union(*(reach[below] for below in imports[name]))
    return {
        name: {b for b in imported if not any(b in reach[other] for other in imported - {b})}
        for name, imported in imports.items()
    }


def hidden(start, end, boxes):
    """Number of boxes that a straight arrow runs behind."""
    s = np.linspace(0.05, 0.95, 30)[:, None]
    points = np.array(start) * (1 - s) + np.array(end) * s
    inside = np.abs(points[:, None] - boxes) < [WIDTH / 2 + 0.04, HEIGHT / 2 + 0.04]
    return int(inside.all(axis=2).any(axis=0).sum())


def placed(floor, arrows):
    """Part -> (x, y): a seeded search for columns with short arrows that run behind no box."""
    rng, names = np.random.default_rng(4), sorted(floor)
    column = {name: 0.0 for name in names}
    for row in {floor[n]: [m for m in names if floor[m] == floor[n]] for n in names}.values():
        column |= {name: i - (len(row) - 1) / 2 for i, name in enumerate(row)}

    def cost(column):
        place = {n: (column[n] * STEP, floor[n]) for n in names}
        boxes = {n: np.array([p for m, p in place.items() if m != n]) for n in names}
        total = 0.0
        for name, imported in arrows.items():
            for below in imported:
                others = np.array([p for m, p in place.items() if m not in (name, below)])
                total += abs(column[name] - column[below]) + 20 * hidden(place[name], place[below], others)
        clash = sum(np.any(np.all(np.abs(boxes[n] - place[n]) < [0.9 * STEP, 0.5], axis=1)) for n in names)
        return total + 100 * clash + 0.3 * sum(abs(c) for c in column.values())

    best = cost(column)
    for _ in range(TRIES):
        name = names[rng.integers(len(names))]
        trial = column | {name: rng.integers(-4, 5) / 2}
        if (value := cost(trial)) <= best:
            column, best = trial, value
    return {n: (column[n] * STEP, float(floor[n])) for n in names}


def draw(path):
    """Draw parts by height above a row of tools; an arrow points at an imported part that no other arrow implies."""
    lines, imports = parts()
    heights(imports)  # of all parts, so that a circle through the tools is an error, too
    imports = {name: imported - set(TOOLS) for name, imported in imports.items() if name not in TOOLS}
    arrows = direct(imports)
    place = placed(heights(imports), arrows)
    middle = np.mean([x for x, _ in place.values()])
    row = {name: (middle + (i - (len(TOOLS) - 1) / 2) * 1.1 * WIDTH, -1.2) for i, name in enumerate(TOOLS)}
    xs, ys = np.array([*place.values(), *row.values()]).T
    figure, ax = plt.subplots(figsize=(np.ptp(xs) + 2.4, 0.8 * np.ptp(ys) + 1.0), layout="constrained")
    for name, imported in arrows.items():
        for below in imported:
            (x, y), (u, v) = place[name], place[below]
            ax.annotate("", (u, v + HEIGHT / 2), (x, y - HEIGHT / 2), zorder=1, arrowprops=ARROW)
    ax.text(xs.min() - WIDTH / 2, -0.8, "tools, which any part may import", size=8, color="#556", va="center")
    for name, (x, y) in (place | row).items():
        box = plt.Rectangle((x - WIDTH / 2, y - HEIGHT / 2), WIDTH, HEIGHT, fc=FILL, ec=EDGE, lw=1.2, zorder=2)
        ax.add_patch(box)
        folder = "/" if (PACKAGE / name).is_dir() else ""
        ax.text(x, y + 0.06, name + folder, ha="center", va="center", size=10, zorder=3)
        ax.text(x, y - 0.15, f"{lines[name]:,} lines", ha="center", va="center", size=7, color="#556", zorder=3)
    ax.set_xlim(xs.min() - 1.2, xs.max() + 1.2)
    ax.set_ylim(ys.min() - 0.5, ys.max() + 0.5)
    ax.axis("off")
    figure.savefig(path, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    draw(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("parts.png"))
