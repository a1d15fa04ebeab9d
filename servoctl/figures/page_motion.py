"""A mechanism in motion as a part of an HTML page: a drawing of lines that a script moves, without any other file."""

import json
import math
from html import escape
from pathlib import Path

import numpy as np

from servoctl.figures.style import COLOURS

SCRIPT = Path(__file__).with_name("motion.js")
WIDEST, HIGHEST = 640, 520  # px, at most
FINE = 10  # units of the drawing in a pixel
MOST_POINTS = 60_000  # of all frames: about half a megabyte
BAR = 0.25  # longest scale bar, relative to the width
GROUND = f'fill="none" stroke="#9A9A9A" stroke-width="{2.5 * FINE}"'
PROGRAMMED = f'fill="none" stroke="#C4C4C4" stroke-width="{4 * FINE}" stroke-linecap="round"'
TRAIL = f'class="trail" fill="none" stroke="{COLOURS[1]}" stroke-width="{2 * FINE}"'
DRAWN_AS = {
    "body": f'fill="{COLOURS[0]}" fill-opacity="0.55" stroke="#404040" stroke-width="{FINE}"',
    "line": f'fill="none" stroke="#404040" stroke-width="{2.5 * FINE}" stroke-linejoin="round" stroke-linecap="round"',
    "dot": f'fill="none" stroke="{COLOURS[1]}" stroke-width="{9 * FINE}" stroke-linecap="round"',
}


def moving_drawing(picture, low, high, kinds):
    """HTML of a picture in motion, bodies below lines below dots; without scripts its first frame is shown.

    Parameters
    ----------
    picture : Animation
    low, high : (2,) array
        Corners of what is shown [m].
    kinds : dict of str to str
        "ground", "body", "line" or "dot" of each shape.

    Returns
    -------
    str
    """
    scale = FINE * min(WIDEST / (high - low)[0], HIGHEST / (high - low)[1])
    across, up = (scale * (high - low)).round().astype(int)

    def placed(points):
        """Points (2, n) of the picture as text."""
        x, y = scale * (points[0] - low[0]), scale * (high[1] - points[1])
        return " ".join(f"{a:.0f},{b:.0f}" for a, b in zip(x, y, strict=True) if math.isfinite(a + b))

    def frames(points):
        points = points if points.ndim == 3 else np.stack([points, points], axis=1)  # a dot is a line without length
        return [placed(points[..., i]) for i in range(0, points.shape[-1], every)]

    points = sum(lines[0].size for lines in (*picture.shapes.values(), *picture.trails.values()))
    every = -(-points // MOST_POINTS)  # frames from one that is shown to the next
    moving = {name: frames(picture.shapes[name]) for kind in DRAWN_AS for name in kinds if kinds[name] == kind}
    trails = [placed(points[:, ::every]).split(" ") for points in picture.trails.values()]
    lines = [_drawn(GROUND, frames(points)[0]) for name, points in picture.shapes.items() if kinds[name] == "ground"]
    lines += [_drawn(PROGRAMMED, placed(points)) for points in picture.programmed.values()]
    lines += [_drawn(TRAIL, "") for _ in trails]
    lines += [_drawn(f'class="moving" {DRAWN_AS[kinds[name]]}', frames[0]) for name, frames in moving.items()]
    lines += [] if picture.space else _scale_bar(across, up, scale)
    t = np.round(picture.t[::every], 6).tolist()
    data = {"t": t, "fps": picture.fps / every, "speed": picture.speed}
    data |= {"shapes": list(moving.values()), "trails": trails}
    last, width = len(t) - 1, across / FINE
    return f"""<figure class="motion">
<svg viewBox="0 0 {across} {up}" width="{width:.0f}" style="max-width: 100%" role="img">
<title>the mechanism in motion</title>
{chr(10).join(lines)}
</svg>
<div>
<button type="button">Play</button>
<input type="range" min="0" max="{last}" value="0" aria-label="instant">
<output></output>
</div>
<script type="application/json">{json.dumps(data, separators=(",", ":"))}</script>
<script>{SCRIPT.read_text(encoding="utf-8")}</script>
</figure>
"""


def _drawn(look, points):
    return f'<polyline {look} points="{points}"/>'


def _scale_bar(across, up, scale):
    """A bar of 1, 2 or 5 times a power of ten metres, and its length."""
    longest = BAR * across / scale
    power = 10.0 ** math.floor(math.log10(longest))
    length = max(step * power for step in (1, 2, 5) if step * power <= longest)
    x, y = 10 * FINE, up - 8 * FINE
    text = f'<text x="{x}" y="{y - 6 * FINE}" font-size="{13 * FINE}" fill="#555555">{escape(f"{length:g} m")}</text>'
    return [_drawn(GROUND, f"{x},{y} {x + length * scale:.0f},{y}"), text]
