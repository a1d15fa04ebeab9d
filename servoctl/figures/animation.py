"""A mechanism in motion: by its shapes, with the programmed path beneath and the path of the motion."""

import base64
import io
import math
import shutil
import subprocess
from dataclasses import replace

import numpy as np

from servoctl.archive import writing
from servoctl.checks import as_path, named, require_kind, text, texts, whole, within
from servoctl.errors import ServoError, SpecificationError
from servoctl.figures import style
from servoctl.figures.names import planes_of
from servoctl.figures.page_motion import moving_drawing
from servoctl.run import Run
from servoctl.spec.shapes import heights, moved
from servoctl.values import Value, frozen

MOST_FRAMES = 500  # of an animation: longer motions are shown faster
SLOWED = 2.0  # s that an animation lasts at least: shorter motions are shown slower
PATH_POINTS = 400  # of a drawn path
STILL = 1e-9  # change of a shape over the motion below which it is the ground, relative to the picture
LETTER = 0.1  # inches: of a title, which the picture is no narrower than
BORDER = 0.06  # around the motion, of the picture's larger side
ACROSS, UP = 6.4, 5.6  # inches, of the picture's plane
TRIAD, ARROW = (0.32, 0.15), 0.33  # place and length of the directions of space [inches]
FOR_DIRECTIONS = 0.75  # width of the directions of space, which poses side by side leave free [inches]
SLIM = 0.12  # ratio of the sides below which poses would hide each other
COVERED = 0.5  # part of two poses together that both cover, above which they hide each other
GAP = 0.35  # between poses side by side, of the larger side of a pose
SLIMMEST = 0.3  # least ratio of its sides
VIEW = np.array([[0.866, -0.5, 0.0], [0.25, 0.433, 0.866]])  # parallel projection of space, from 30° above
GREY, LINE, BODY, POINT = "#9A9A9A", "#404040", style.COLOURS[0], style.COLOURS[1]
SUFFIXES = (".gif", ".html", ".mp4")


@frozen(eq=False)
class Animation(Value):
    """A mechanism in motion; made by `animate`. A notebook shows it.

    Attributes
    ----------
    t : (N,) array
        Instants of the frames [s].
    shapes : dict of str to (2, n, N) array
        Points of each shape in the picture [m].
    trails : dict of str to (2, N) array
        Paths of points of the motion.
    programmed : dict of str to (2, M) array
        Their paths in the whole plan.
    fps : float
        Frames per second.
    pace : float
        Seconds of the motion in a second of the animation: 1, more for long motions, less for short ones.
    space : bool
        Whether the picture is a projection of three dimensions.
    """

    t: np.ndarray
    shapes: dict
    trails: dict
    programmed: dict
    fps: float
    pace: float
    space: bool

    def __repr__(self):
        lasts = f"{len(self.t)} frames, {len(self.t) / self.fps:.3g} s"
        return f"Animation: {lasts}{self.speed}\n  shapes {'; '.join(self.shapes)}"

    @property
    def speed(self) -> str:
        """How much faster or slower than the motion the animation is, in words; "" if it is neither."""
        if self.pace == 1:
            return ""
        return f", {self.pace:.3g} times as fast" if self.pace > 1 else f", slowed down {1 / self.pace:.3g} times"

    def _repr_html_(self):
        content = base64.b64encode(self.gif()).decode()
        return f'<img alt="the mechanism in motion" src="data:image/gif;base64,{content}">'

    def gif(self) -> bytes:
        """The animation as the content of a GIF file, which repeats itself."""
        from PIL import Image

        pictures = [Image.fromarray(pixels) for pixels in self._frames()]
        colours = pictures[len(pictures) // 2].quantize(64)  # one palette, so that a frame holds what changed
        frames = [picture.quantize(palette=colours, dither=Image.Dither.NONE) for picture in pictures]
        file, milliseconds = io.BytesIO(), max(20, round(1000 / self.fps))
        frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0)
        return file.getvalue()

    def html(self) -> str:
        """The animation as a part of an HTML page: lines that a script moves, with a slider for the time."""
        low, high = _corners(self)
        kinds = {name: "ground" if _still(points, self) else _kind(points) for name, points in self.shapes.items()}
        return moving_drawing(self, low, high, kinds)

    def save(self, path):
        """Write the animation to a file.

        Parameters
        ----------
        path : str or Path
            It ends in .gif, which is added if there is no suffix, in .html, a page with a slider for the time, or in
            .mp4, which needs ffmpeg.

        Returns
        -------
        Path

        Raises
        ------
        SpecificationError
            For another suffix.
        ServoError
            If the file cannot be written, or ffmpeg is missing or fails.
        """
        path = as_path(path, "The path of the animation")
        path = path.with_name(path.name + SUFFIXES[0]) if not path.suffix else path
        if path.suffix.lower() not in SUFFIXES:
            raise SpecificationError(
                f"The animation was given the file {path.name!r}.",
                f"It is written as {' or '.join(SUFFIXES)}.",
                nearest=f"{path.with_suffix('.gif').name!r}.",
                suffix=path.suffix,
            )
        with writing(path, "animation"):
            if path.suffix.lower() == ".gif":
                path.write_bytes(self.gif())
            elif path.suffix.lower() == ".html":
                path.write_text(f'<!DOCTYPE html>\n<meta charset="utf-8">\n{self.html()}', encoding="utf-8")
            else:
                self._film(path)
        return path

    def _film(self, path):
        """Write MP4 by ffmpeg, whose frames have even sides."""
        program = shutil.which("ffmpeg")
        if program is None:
            raise ServoError(
                "The animation cannot be written as MP4: there is no ffmpeg.",
                do=f"Install ffmpeg, or write {path.with_suffix('.gif').name!r}.",
                path=str(path),
            )
        frames = [pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2] for pixels in self._frames()]
        size = f"{frames[0].shape[1]}x{frames[0].shape[0]}"
        read = f"-y -loglevel error -f rawvideo -pix_fmt rgb24 -s {size} -r {self.fps:g} -i -"
        command = [program, *read.split(), "-pix_fmt", "yuv420p", str(path)]
        content = b"".join(np.ascontiguousarray(pixels).tobytes() for pixels in frames)
        done = subprocess.run(command, input=content, capture_output=True)
        if done.returncode:
            said = done.stderr.decode(errors="replace").strip()[-300:]
            raise ServoError(f"ffmpeg failed: {said}", do="Write a GIF instead.", path=str(path))

    def _frames(self):
        """Pixels (height, width, 3) of each frame: what stands still is drawn once."""
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        ax = _axes(replace(self, trails={}), None)
        canvas = FigureCanvasAgg(ax.figure)
        artists = [_Moving(ax, points) for points in self.shapes.values() if not _still(points, self)]
        trails = [ax.plot([], [], color=POINT, linewidth=1.6, zorder=3)[0] for _ in self.trails]
        clock = ax.text(0.01, 0.99, "", transform=ax.transAxes, va="top", fontsize=10)
        changing = [*trails, *(moving.artist for moving in artists), clock]
        for artist in changing:
            artist.set_animated(True)
        canvas.draw()
        background = canvas.copy_from_bbox(ax.figure.bbox)
        for i, t in enumerate(self.t):
            canvas.restore_region(background)
            for trail, points in zip(trails, self.trails.values(), strict=True):
                trail.set_data(points[:, : i + 1])
            for moving in artists:
                moving.show(i)
            clock.set_text(f"t = {t:.2f} s{self.speed}")
            for artist in changing:
                ax.draw_artist(artist)
            yield np.array(canvas.buffer_rgba())[..., :3]


def animate(run, fps=25, trail=None):
    """Show the mechanism of a run in motion, with the programmed path beneath and the path of the motion.

    The mechanism is drawn by its `shapes`; one without by dots at those outputs and coordinates that are positions,
    such as X and Z. Scales are equal and up is up. Of a closed loop the path of its plan is drawn beneath.

    Parameters
    ----------
    run : Run or Closed
    fps : float
        Frames per second, from 1 to 50.
    trail : str or sequence of str, optional
        Shapes whose last point (of a body: whose middle) leaves its path; default: the last shape. () for none.

    Returns
    -------
    Animation
        `save("crane.gif")` and `save("crane.mp4")` write it; a notebook shows it.

    Raises
    ------
    SpecificationError
        If the run has no model, or the mechanism neither shapes nor positions; if fps is out of range.
    NameUnknown
        If there is no such shape.

    Examples
    --------
    >>> sv.figures.animate(run).save("crane.gif")
    """
    fps = within("fps", fps, 1, 50)  # which common viewers show
    _require_drawable(run)
    span = float(abs(run.t[-1] - run.t[0]))
    pace = max(min(1.0, span / SLOWED), span * fps / (MOST_FRAMES - 1)) or 1.0
    return _pictured(run, _spread(run, math.floor(span * fps / pace + 1e-9) + 1), trail, fps, pace)


def stroboscope(run, poses=9, trail=None, ax=None, title=""):
    """Draw the mechanism of a run at several instants, over the programmed path: an `animate` for print.

    Poses of a motion along one horizontal line are drawn one below the other, and those of bodies that turn in place
    side by side, as they would hide each other.

    Parameters
    ----------
    run : Run or Closed
    poses : int
        Instants, equally spaced from the start to the end, the last the darkest.
    trail : str or sequence of str, optional
        As of `animate`.
    ax : Axes, optional
    title : str, optional

    Returns
    -------
    Axes

    Raises
    ------
    SpecificationError
        As of `animate`.
    NameUnknown
        If there is no such shape.
    """
    _require_drawable(run)
    poses = whole("poses", poses, 1)
    each = max(1, -(-PATH_POINTS // max(1, poses - 1)))
    picture = _pictured(run, _spread(run, (poses - 1) * each + 1), trail, 25.0, 1.0)
    if poses > 1 and _in_place(picture, each):
        return _side_by_side(picture, each, ax, text("title", title))
    rows = _along_a_line(picture) and poses > 1
    picture = _unrolled(picture) if rows else picture
    ax = _axes(picture, ax, text("title", title))
    if rows:
        levels = [float(next(iter(picture.shapes.values()))[1].mean(axis=0)[k * each]) for k in range(poses)]
        ax.set_yticks(levels, [f"{picture.t[k * each]:.4g}" for k in range(poses)])
        ax.set_ylabel("t [s]")
    for k in range(poses):
        for points in picture.shapes.values():
            if not _still(points, picture):
                _Moving(ax, points, 0.25 + 0.75 * (k + 1) / poses).show(k * each)
    return ax


def _along_a_line(picture):
    low, high = _extent(picture)
    return not picture.space and (high - low)[1] < SLIM * (high - low)[0]


def _unrolled(picture):
    """The picture with its poses one below the other."""
    low, high = _extent(picture)
    fall = np.zeros((2, 1)) - [[0.0], [1.0]] * (np.arange(len(picture.t)) * (high - low)[0] / (2 * len(picture.t)))
    shapes = {n: v + (fall if v.ndim == 2 else fall[:, np.newaxis]) for n, v in picture.shapes.items()}
    return replace(picture, shapes=shapes, trails={n: v + fall for n, v in picture.trails.items()}, programmed={})


def _in_place(picture, each):
    """Whether bodies in space, held at one point at most, are drawn over each other at most of the poses."""
    if not picture.space:
        return False
    points = [np.reshape(v, (2, -1, len(picture.t)))[..., ::each] for v in picture.shapes.values()]
    points = np.concatenate(points, axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    small = STILL * (high - low).max()
    held = points[:, np.ptp(points, axis=2).max(axis=0) <= small, 0]
    if (held.max(axis=1, initial=-np.inf) - held.min(axis=1, initial=np.inf)).max() > small:
        return False
    first, second = np.triu_indices(low.shape[1], 1)
    common = np.minimum(high[:, first], high[:, second]) - np.maximum(low[:, first], low[:, second])
    both, sizes = np.clip(common, 0.0, None).prod(axis=0), (high - low).prod(axis=0)
    return bool((both > COVERED * (sizes[first] + sizes[second] - both)).mean() > 0.5)


def _side_by_side(picture, each, ax, title):
    """The poses in rows from left to right, each with its instant and the trails up to it."""
    low, high = _extent(picture)
    at, count = slice(None, None, each), len(picture.t[::each])
    columns = math.ceil(count / math.isqrt(count))
    size = (high - low + GAP * (high - low).max())[:, np.newaxis]
    place = size * [np.arange(count) % columns, -(np.arange(count) // columns)]
    shapes = {n: v[..., at] + (place if v.ndim == 2 else place[:, np.newaxis]) for n, v in picture.shapes.items()}
    parts = {f"{n} {k}": v[:, : k * each + 1] + place[:, [k]] for n, v in picture.trails.items() for k in range(count)}
    ax = _axes(replace(picture, t=picture.t[at], shapes=shapes, trails=parts, programmed={}), ax, title)
    (left, right), inches = ax.get_xlim(), ax.figure.get_size_inches()[0]
    ax.set_xlim(left - (right - left) * FOR_DIRECTIONS / max(inches - FOR_DIRECTIONS, FOR_DIRECTIONS), right)
    for k, t in enumerate(picture.t[at]):
        below = np.array([(low + high)[0] / 2, low[1] - GAP / 4 * (high - low).max()]) + place[:, k]
        ax.text(*below, f"{t:.4g} s", ha="center", va="top", color=LINE)
        for points in shapes.values():
            _Moving(ax, points).show(k)
    return ax


def shows_mechanism(run) -> bool:
    """Whether `animate` and `stroboscope` can draw a run: it has samples, and its mechanism shapes or positions."""
    mechanism, *_ = _mechanism(run)
    return mechanism is not None and len(run.t) > 0 and bool(mechanism.shapes or _positions(mechanism))


def _mechanism(run):
    """The mechanism of a run or a closed loop, its parameters and its paths; None of a run without its model."""
    if hasattr(run, "commands"):
        planned = getattr(run.plan, "model", None)
        return run.plant.mechanism, run.plant.parameters, (planned.paths if planned else {}) | run.plant.paths
    if run.model is None:
        return None, (), {}
    return run.model.reduction.mechanism, run.model.parameters, run.model.paths


def _positions(mechanism):
    """Names of the outputs and coordinates that are positions, by point."""
    outputs = [name for name, e in mechanism.outputs.items() if mechanism.q.order(e) <= 0]
    return [sorted(names, key=str.lower) for names in planes_of([*outputs, *mechanism.q.names])]


def _require_drawable(run):
    """Refuse what is no motion with a mechanism and finite samples."""
    if not hasattr(run, "commands"):
        require_kind(Run, "run", run, "sv.simulate(...) or sv.close(...)")
        run.require_model()
    if not len(run.t):
        raise SpecificationError("The motion has no samples.", do="See run.message.", samples=0)


def _spread(run, count):
    return np.linspace(run.t[0], run.t[-1], count)


def _postures(run, t):
    """The mechanism of a run, its coordinates (nq, N) at some instants, its parameters and its paths."""
    mechanism, p, paths = _mechanism(run)
    if hasattr(run, "commands") or len(run.t) >= PATH_POINTS:  # straight between samples: that cannot be seen
        q = np.array([np.interp(t, *_ascending(run, name)) for name in mechanism.q.names])
    else:
        q = run.at(t)[: mechanism.q.nq]
    return mechanism, q, np.asarray(p)[: len(mechanism.parameters.names)], paths


def _pictured(run, t, trail, fps, pace):
    """The animation of the instants t."""
    shapes = _shapes(run, t)
    trail = list(shapes)[-1:] if trail is None else texts(trail, "The trails")
    for name in trail:
        named(name, shapes, "shape")
    plan, closed = getattr(run, "plan", None), hasattr(run, "commands")
    whole_plan = plan if closed and getattr(plan, "model", None) is not None else None if closed else run
    below = {} if whole_plan is None else _shapes(whole_plan, _spread(whole_plan, PATH_POINTS))
    programmed = {name: _flat(_tip(below[name])) for name in trail if name in below}
    space = any(points.shape[0] == 3 for points in shapes.values())
    trails = {name: _flat(_tip(shapes[name])) for name in trail}
    return Animation(t, {n: _flat(points) for n, points in shapes.items()}, trails, programmed, fps, pace, space)


def _shapes(run, t):
    """Shapes (d, n, N) of a run's mechanism at some instants; without shapes, dots at its positions."""
    mechanism, *posture = _postures(run, t)
    if mechanism.shapes:
        return moved(mechanism, t, *posture)
    shapes = {}
    for names in _positions(mechanism):
        signs = [-1.0 if sign < 0 else 1.0 for sign in heights(mechanism, names, t, *posture)]
        rows = [sign * np.interp(t, *_ascending(run, name)) for name, sign in zip(names, signs, strict=True)]
        shapes.setdefault(", ".join(names), np.array(rows)[:, np.newaxis, :])
    largest = max((points.shape[0] for points in shapes.values()), default=0)
    if not largest:
        raise SpecificationError(
            "The mechanism has no shapes, and no outputs or coordinates that are positions.",
            "It is drawn by its shapes, or by dots at positions such as (X, Z) or (tip_x, tip_y).",
            do='Give shapes to its constructor: sv.Mechanism(..., shapes={"rope": [(x, 0), (X, -Z)]}).',
            coordinates=list(mechanism.q.names),
            outputs=list(mechanism.outputs),
        )
    return {name: points for name, points in shapes.items() if points.shape[0] == largest}


def _ascending(run, name):
    order = np.argsort(run.t)
    return run.t[order], run[name][order]


def _tip(points):
    """The last point of a line, the middle of a body: (d, 1, N)."""
    return points[:, :-1].mean(axis=1, keepdims=True) if _is_body(points) else points[:, -1:]


def _is_body(points):
    size = np.nan_to_num(np.abs(points), posinf=0.0).max(initial=0.0)
    return points.shape[1] > 3 and bool(np.nanmax(np.abs(points[:, 0] - points[:, -1])) <= STILL * size)


def _flat(points):
    """Points (d, n, N), or paths (d, 1, N) as (2, N), in the picture's plane."""
    points = np.einsum("ij,jnt->int", VIEW, points) if points.shape[0] == 3 else points
    return points[:, 0] if points.shape[1] == 1 else points


def _still(points, picture):
    low, high = _extent(picture)
    return bool(np.nanmax(np.ptp(points, axis=-1)) <= STILL * (high - low).max()) and len(picture.t) > 1


def _extent(picture):
    """Corners (2,) of the rectangle that holds the picture."""
    every = [*picture.shapes.values(), *picture.programmed.values()]
    points = np.concatenate([np.reshape(v, (2, -1)) for v in every], axis=1)
    points = points[:, np.isfinite(points).all(axis=0)]
    return (points.min(axis=1), points.max(axis=1)) if points.size else (np.zeros(2), np.ones(2))


def _corners(picture):
    """Corners (2,) of the picture with its border, at least a third as high as wide and the other way round."""
    low, high = _extent(picture)
    side = max(float((high - low).max()), 1e-9)
    low, high = low - BORDER * side, high + BORDER * side
    middle = (low + high) / 2
    return np.minimum(low, middle - SLIMMEST * side / 2), np.maximum(high, middle + SLIMMEST * side / 2)


def _kind(points):
    """How a shape (2, n, N), or a point (2, N), is drawn."""
    return "dot" if points.ndim == 2 else "body" if _is_body(points) else "line"


def _axes(picture, ax, title=""):
    """Axes with equal scales, the ground, the programmed paths and the trails."""
    low, high = _corners(picture)
    across, up = (high - low) * min(ACROSS / (high - low)[0], UP / (high - low)[1])
    if ax is None:
        width = max(across + 0.7, style.LEFT + LETTER * len(title))
        _, ((ax,),) = style.figure(up + 0.6 + 0.35 * bool(title), width=width)
    ax = style.as_single_axes(ax, up)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal")
    if title:
        ax.set_title(title)
    if picture.space:
        _triad(ax)
    else:
        ax.set(xlabel="[m]", ylabel="[m]")
        ax.grid(alpha=0.25)
    for points in picture.shapes.values():
        if _still(points, picture):
            first = np.reshape(points, (2, -1, len(picture.t)))[..., 0]
            ax.plot(*first, color=GREY, linewidth=2.5, marker="s" if first.shape[1] == 1 else None, zorder=1)
    for path in picture.programmed.values():
        ax.plot(*path, color=GREY, linewidth=3.5, alpha=0.6, zorder=2, solid_capstyle="round")
    for path in picture.trails.values():
        ax.plot(*path, color=POINT, linewidth=1.6, zorder=3)
    return ax


def _triad(ax):
    """The directions of space in a corner, instead of scales that a projection does not have."""
    from matplotlib.transforms import ScaledTranslation

    ax.set_axis_off()
    inches = ax.figure.dpi_scale_trans + ScaledTranslation(0, 0, ax.transAxes)  # from the lower left corner
    for direction, name in zip(VIEW.T, "xyz", strict=True):
        start, end = np.array(TRIAD), np.array(TRIAD) + ARROW * direction
        ax.annotate("", end, start, inches, inches, arrowprops={"arrowstyle": "->", "color": GREY})
        ax.text(*(start + 1.35 * (end - start)), name, transform=inches, color=LINE, ha="center", va="center")


class _Moving:
    """The artist of a shape: a dot, a line or a body; `show(i)` moves it to the i-th instant."""

    def __init__(self, ax, points, alpha=1.0):
        kind, self.points = _kind(points), points if points.ndim == 3 else points[:, np.newaxis]
        self.closed = kind == "body"
        if self.closed:
            (self.artist,) = ax.fill([], [], facecolor=BODY, edgecolor=LINE, alpha=0.55 * alpha, zorder=4)
        elif kind == "dot":
            (self.artist,) = ax.plot([], [], "o", color=POINT, markersize=8, alpha=alpha, zorder=6)
        else:
            (self.artist,) = ax.plot([], [], color=LINE, linewidth=2.2, alpha=alpha, zorder=5, solid_joinstyle="round")

    def show(self, i):
        points = self.points[..., i]
        self.artist.set_xy(points.T) if self.closed else self.artist.set_data(points)
