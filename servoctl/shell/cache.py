"""`servoctl cache`: where the cache on disk is, what it holds, and to clear it."""

from servoctl.codegen.cache import clear, entries, folders


def add_cache(cache):
    """Add the arguments of the command."""
    cache.add_argument("--clear", action="store_true", help="delete all of it; it is made again where it is needed")
    cache.set_defaults(command=_cache)


def _cache(args):
    if args.clear:
        clear()
    sizes = {"libraries": [], "derivations": [], "temporary": []}
    for kind, folder in zip(sizes, folders(), strict=False):
        for _, size, path in entries(folder):
            sizes["temporary" if path.endswith(".tmp") else kind].append(size)
    print(folders()[0])
    for kind, group in sizes.items():
        print(f"  {kind:11}  {len(group):6}  {sum(group) / 1e6:8.1f} MB")
    return 0
