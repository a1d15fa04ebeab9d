"""Files that one process leaves to the next: compiled libraries and derivations.

Their content is loaded and run. Therefore a file is read only if this user or the administrator wrote it, and only with
the digest at its end.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path

_DIGEST = hashlib.sha256().digest_size


def cache_directory():
    """Directory of compiled libraries and derivations.

    Returns
    -------
    pathlib.Path
        ``SERVOCTL_CACHE`` if set, else ``servoctl`` under the user's cache directory; it need not exist.
    """
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

    Raises
    ------
    OSError
        If the file is missing, is damaged, or belongs to another user.
    """
    with open(path, "rb") as file:
        if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid not in (os.geteuid(), 0):
            raise PermissionError(f"{path} belongs to another user")
        content = file.read()
    if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
        raise OSError(f"{path} is damaged")
    return content[:-_DIGEST]


@contextlib.contextmanager
def replacing(path):
    """The name of a temporary file, which replaces the one at `path` in one step, with its digest appended.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    os.close(handle)
    try:
        yield temporary
        with open(temporary, "r+b") as file:
            file.write(hashlib.sha256(file.read()).digest())
        os.replace(temporary, path)
    finally:
        Path(temporary).unlink(missing_ok=True)
