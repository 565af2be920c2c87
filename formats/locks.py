"""Locks of files between processes; the system releases them when a process ends."""

from __future__ import annotations


def lock_file(descriptor: int, *, wait: bool = False) -> bool | None:
    """Lock an open file until it is closed.

    Returns
    -------
    bool or None
        True if it is locked, False if another process has the lock. None if there are no locks: on
        Windows, where an open file cannot be removed anyway, and on some network file systems.
    """
    try:
        import fcntl
    except ImportError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
