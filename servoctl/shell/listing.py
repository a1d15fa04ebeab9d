"""`servoctl list`: the gallery's scenes, without importing their mechanisms."""

from servoctl.gallery import gallery


def add_list(listing):
    """Add the command, which has no arguments."""
    listing.set_defaults(command=_list)


def _list(args):
    width = max(map(len, gallery))
    for name, scene in gallery.items():
        print(f"{name:{width}}  {scene.description}")
    return 0
