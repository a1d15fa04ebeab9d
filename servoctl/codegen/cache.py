"""Files that one process leaves to the next: compiled libraries and derivations.

Their content is loaded and run. Therefore a file is read only if this user or the administrator wrote it, in a folder
where nobody else can replace it, and only with the digest of its name and content at its end.
"""

import contextlib
import hashlib
import itertools
import os
import re
import stat
import sys
import time
from pathlib import Path

_DIGEST = hashlib.sha256().digest_size
_ENTRY = re.compile(r"[0-9a-f]{64}(\.so)?|tmp\w+\.tmp")  # names of the files that are written here
MOST_BYTES_READ = 2**30  # of one file: libraries of 100,000 operations take some megabytes
MOST_BYTES = 2**28  # of a folder: beyond it the least recently used entries are deleted until half is left
OLDEST = 180 * 86400.0  # s since an entry was used, after which it is deleted
ABANDONED = 3600.0  # s after which a temporary file belongs to no living process
WRITES = 50  # writes of a process from one look for entries to delete to the next
_writes = itertools.count()


def cache_directory():
    """Directory of compiled libraries and derivations; it need not exist.

    It is ``SERVOCTL_CACHE`` if set, else ``servoctl`` under the user's cache directory, else a folder of this user
    under the temporary directory.
    """
    try:
        return _chosen_directory()
    except RuntimeError:  # no home directory, or none of the user that ~name means
        import tempfile

        return Path(tempfile.gettempdir()) / f"servoctl-{os.getuid() if hasattr(os, 'getuid') else 'cache'}"


def _chosen_directory():
    if chosen := os.environ.get("SERVOCTL_CACHE"):
        return Path(chosen).expanduser().absolute()
    if base := os.environ.get("XDG_CACHE_HOME"):
        return Path(base).absolute() / "servoctl"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "servoctl"
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", Path.home())) / "servoctl" / "Cache"
    return Path.home() / ".cache" / "servoctl"


def read_cached(path):
    """Content (bytes) of a file that `replacing` wrote.

    Raises OSError if the file is missing, is damaged or was written for another name, or if another user wrote it or
    can replace it.
    """
    _require_private(path.parent)
    with open(path, "rb", opener=_at_once) as file:
        status = os.fstat(file.fileno())
        if not stat.S_ISREG(status.st_mode) or status.st_size > MOST_BYTES_READ:
            raise OSError(f"{path} is no file that was written here")
        if hasattr(os, "geteuid") and status.st_uid not in (os.geteuid(), 0):
            raise PermissionError(f"{path} belongs to another user")
        content = file.read()
    with contextlib.suppress(OSError):
        os.utime(path)
    if _digest(path, content[:-_DIGEST]) != content[-_DIGEST:]:
        raise OSError(f"{path} is damaged, or was written for another name")
    return content[:-_DIGEST]


def _at_once(path, flags):
    """A descriptor; without O_NONBLOCK opening a pipe would wait for its writer."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def _digest(path, content):
    """Of the name, too: a file under another's name would be whole, and wrong."""
    return hashlib.sha256(Path(path).name.encode() + b"\0" + content).digest()


def _require_private(directory):
    """Refuse a folder in which another user could replace files between their check and their use."""
    status = os.stat(directory)
    shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH) and not status.st_mode & stat.S_ISVTX
    if hasattr(os, "geteuid") and (shared or status.st_uid not in (os.geteuid(), 0)):
        raise PermissionError(f"other users may write to {directory}")


def _make_private(directory):
    """Make a folder and its missing parents for this user alone, whatever the umask."""
    if not directory.is_dir():
        _make_private(directory.parent)
        directory.mkdir(mode=0o700, exist_ok=True)


@contextlib.contextmanager
def replacing(path):
    """The name of a temporary file, which replaces the one at `path` in one step, with its digest appended.

    Raises OSError if the file cannot be written.
    """
    import tempfile

    _make_private(path.parent)
    _require_private(path.parent)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    os.close(handle)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            file.write(_digest(path, file.read()))
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)
    if next(_writes) % WRITES == 0:
        prune(path.parent)


def entries(directory):
    """(time of the last use, bytes, path) of each file in a folder of the cache, the least recently used first."""
    found = []
    with contextlib.suppress(OSError), os.scandir(directory) as files:
        for file in files:
            with contextlib.suppress(OSError):  # another process removed it
                if _ENTRY.fullmatch(file.name) and file.is_file(follow_symlinks=False):
                    found.append((file.stat().st_mtime, file.stat().st_size, file.path))
    return sorted(found)


def prune(directory):
    """Delete what nobody uses: abandoned temporary files, old entries, and the oldest where they are too many."""
    found, now = entries(directory), time.time()
    total = sum(size for _, size, _ in found)
    least = MOST_BYTES / 2 if total > MOST_BYTES else MOST_BYTES
    for used, size, path in found:
        if now - used > (ABANDONED if path.endswith(".tmp") else OLDEST) or (total > least and path[-4:] != ".tmp"):
            with contextlib.suppress(OSError):
                os.unlink(path)
            total -= size


def clear():
    """Delete all entries of the cache, and nothing else; what could not be deleted stays."""
    for directory in folders():
        for _, _, path in entries(directory):
            with contextlib.suppress(OSError):
                os.unlink(path)


def folders():
    """The folders of the cache: of libraries, and of derivations."""
    return cache_directory(), cache_directory() / "derived"
