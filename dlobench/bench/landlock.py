"""Restricts this process by Landlock, which needs no privilege: what it and its children may open, and nothing else.

Follows Linux's Documentation/userspace-api/landlock.rst, up to version 6 of its interface.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterable
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446  # system calls, the same on every architecture
_NO_NEW_PRIVILEGES = 38
_EXECUTE, _WRITE, _READ, _LIST = 1 << 0, 1 << 1, 1 << 2, 1 << 3
_TRUNCATE = 1 << 14
_OF_FILES = _EXECUTE | _WRITE | _READ | _TRUNCATE
_DEVICES = (1 << 6) | (1 << 11)  # making character and block devices

libc = ctypes.CDLL(None, use_errno=True)


class _Ruleset(ctypes.Structure):
    _fields_ = (("files", ctypes.c_uint64), ("net", ctypes.c_uint64), ("scoped", ctypes.c_uint64))


class _Beneath(ctypes.Structure):
    _pack_ = 1
    _fields_ = (("allowed", ctypes.c_uint64), ("parent", ctypes.c_int32))


def version() -> int:
    """Returns the version of the kernel's interface, 0 where there is none."""
    if sys.platform != "linux":
        return 0
    return max(0, int(libc.syscall(_CREATE, None, ctypes.c_size_t(0), ctypes.c_uint32(1))))


def checked(result: int, what: str) -> int:
    """Returns what a call into libc returned; raises `OSError` with its errno when that is −1."""
    if result == -1:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number), what)
    return result


def restrict(*, readable: Iterable[Path], writable: Iterable[Path]) -> str:
    """Forbids to open anything but what lies in these folders (or is one of these files), for good.

    Also forbids, as far as the kernel knows how, TCP (version 4) and signals to outside (6). Returns what is in force.
    Raises `OSError` where the kernel has no Landlock.
    """
    known = version()
    if not known:
        raise OSError("this kernel has no Landlock")
    handled = (1 << {1: 13, 2: 14}.get(known, 15)) - 1  # all on files but control of devices, which CUDA needs
    rules = _Ruleset(handled, 3 if known >= 4 else 0, 3 if known >= 6 else 0)
    size = 8 if known < 4 else 16 if known < 6 else 24
    ruleset = checked(libc.syscall(_CREATE, ctypes.byref(rules), ctypes.c_size_t(size), ctypes.c_uint32(0)), "ruleset")
    try:
        for path in readable:
            _allow(ruleset, path, (_EXECUTE | _READ | _LIST) & handled)
        for path in writable:
            _allow(ruleset, path, handled & ~_DEVICES)
        checked(libc.prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0), "prctl")
        checked(libc.syscall(_RESTRICT, ruleset, ctypes.c_uint32(0)), "landlock_restrict_self")
    finally:
        os.close(ruleset)
    more = (", no TCP" if known >= 4 else "") + (", no signals to outside" if known >= 6 else "")
    return f"Landlock {known}: opens only Python, its packages, the plugin and a folder of its own{more}"


def _allow(ruleset: int, path: Path, rights: int) -> None:
    try:
        file = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return  # not there, or not for us: nothing to allow
    try:
        rule = _Beneath(rights if path.is_dir() else rights & _OF_FILES, file)
        checked(libc.syscall(_ADD, ruleset, 1, ctypes.byref(rule), ctypes.c_uint32(0)), str(path))
    finally:
        os.close(file)
