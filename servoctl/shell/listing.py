"""`servoctl list`: the gallery's scenes, without importing their mechanisms."""

from itertools import groupby, starmap
from textwrap import fill

from servoctl.gallery import gallery

COLUMNS_PRINTED = 100  # characters of a line of the long list


def add_list(listing):
    """Add the arguments."""
    listing.add_argument(
        "--long", action="store_true", help="by subject, with what each scene teaches, its source and a number"
    )
    listing.set_defaults(command=_list)


def _list(args):
    if args.long:
        print(*starmap(_of_subject, subjects()), sep="\n\n")
        return 0
    width = max(map(len, gallery))
    for name, scene in gallery.items():
        print(f"{name:{width}}  {scene.description}")
    return 0


def subjects():
    """Pairs of a subject and its scenes by name, in the order of the gallery."""
    for group, members in groupby(gallery.items(), lambda item: item[1].group):
        yield group, dict(members)


def _of_subject(group, members):
    return "\n".join([group.capitalize(), *(f"\n  {name}\n{_details(scene)}" for name, scene in members.items())])


def _details(scene):
    lines = (scene.description, scene.teaches, scene.number, f"Source: {scene.source}.")
    return "\n".join(fill(line, COLUMNS_PRINTED, initial_indent="    ", subsequent_indent="      ") for line in lines)
