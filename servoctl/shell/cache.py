"""`servoctl cache`: where the cache on disk is, what it holds, and to clear it."""

from servoctl.codegen.cache import clear, entries, folders


def add_cache(cache):
    """Add the arguments of the command."""
    cache.add_argument("--clear", action="store_true", help="delete all of it; it is made again where it is needed")
    cache.set_defaults(command=_cache)


def _cache(args):
    if args.clear:
        clear()
    libraries, derived = ([(path, size) for _, size, path in entries(folder)] for folder in folders())
    groups = {"libraries": libraries, "derivations": derived}
    print(folders()[0])
    for name, group in groups.items():
        finished = [size for path, size in group if not path.endswith(".tmp")]
        print(f"  {name:11}  {len(finished):6}  {sum(finished) / 1e6:8.1f} MB")
    temporary = [size for path, size in libraries + derived if path.endswith(".tmp")]
    print(f"  {'temporary':11}  {len(temporary):6}  {sum(temporary) / 1e6:8.1f} MB")
    return 0
