"""The gallery: mechanisms with programs, ready to derive and simulate.

::

    from servoctl.gallery import gallery
    scene = gallery["overhead-crane"]
    model = sv.derive(*scene.build())
    run = sv.simulate(model, model.start(**scene.start, guess=scene.guess), scene.t_span)

A user's file serves as a scene if it defines `scene()`, which returns (Mechanism, Program), and optionally START,
GUESS, T_SPAN and UNITS with the meanings of `start`, `guess`, `t_span` and `units` below.
"""

from servoctl.gallery.scenes import BUILDERS, Scene, builder, gallery

__all__ = ["Scene", "gallery", *BUILDERS]


def __getattr__(name):
    if name not in BUILDERS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return builder(name)


def __dir__():
    return sorted({*globals(), *BUILDERS})
