"""Files that are kept from one process to the next: libraries and derivations.

They are loaded and run as they are: only what this user, or the administrator, wrote is read, and only what is whole.
"""

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path

_DIGEST = hashlib.sha256().digest_size


def cache_directory():
    """Directory where compiled libraries and derivations are kept.

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


def kept(path):
    """Content of a file that `keeping` wrote.

    Parameters
    ----------
    path : pathlib.Path

    Returns
    -------
    bytes

    Raises
    ------
    OSError
        If there is none, it is damaged, or another user wrote it.
    """
    with open(path, "rb") as file:
        if hasattr(os, "geteuid") and os.fstat(file.fileno()).st_uid not in (os.geteuid(), 0):
            raise PermissionError(f"{path} belongs to another user")
        content = file.read()
    if hashlib.sha256(content[:-_DIGEST]).digest() != content[-_DIGEST:]:
        raise OSError(f"{path} is damaged")
    return content[:-_DIGEST]


@contextlib.contextmanager
def keeping(path):
    """A temporary file to write, which with a digest at its end takes its place at a path: no reader meets half of it.

    Parameters
    ----------
    path : pathlib.Path

    Yields
    ------
    str
        The temporary file's name.

    Raises
    ------
    OSError
        If it cannot be written.
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
