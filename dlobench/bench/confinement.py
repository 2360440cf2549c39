"""Confines the process of a plugin before any of the plugin runs: memory, tasks, privileges, files, network.

What a machine does not permit is not in what `confine` returns, so that nobody takes it for granted.
"""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from pathlib import Path

from dlobench.bench import landlock
from dlobench.bench.landlock import checked, libc

_NEW_MOUNTS, _NEW_USER = 0x00020000, 0x10000000  # of unshare(2)
_RECURSIVE, _PRIVATE = 0x4000, 0x40000  # of mount(2)
_DROP_BOUNDING, _LAST_CAPABILITY = 24, 40
_STRANGER = 2**30  # a real user that nobody has, plus the process's id
_THREADS = 8  # tasks per processor that libraries of linear algebra may start, above those of the limit

_SYSTEM = ["/usr", "/lib", "/lib32", "/lib64", "/bin", "/sbin", "/opt", "/proc", "/sys", "/nix", "/gnu"]
_SETTINGS = [
    "ld.so.cache", "ld.so.conf", "ld.so.conf.d", "localtime", "passwd", "group", "nsswitch.conf", "hosts",
    "resolv.conf", "ssl", "fonts", "mime.types", "alternatives", "OpenCL", "vulkan",
]  # fmt: skip
_DEVICES = ["/dev/null", "/dev/zero", "/dev/full", "/dev/random", "/dev/urandom", "/dev/kfd", "/dev/dri", "/dev/dxg"]


def confine(*, hidden: Sequence[Path], needed: Sequence[Path], folder: Path, memory: int, tasks: int) -> list[str]:
    """Confines this process and what it starts, for good, and returns what is in force, a phrase each.

    `hidden` are the folders that it must never see, `needed` what it reads beside Python and the system, `folder` where
    it may write; `memory` (bytes) holds for each process, `tasks` for all of them together (threads count).
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_DATA, (memory, memory))
    force = [f"at most {memory / 1e9:.3g} GB a process"]
    hidden = [path.resolve() for path in hidden]
    root, private = os.geteuid() == 0, False
    with contextlib.suppress(OSError, AttributeError):  # a libc without the call
        _unshare(user=not root)
        _mount(Path("/dev/shm"), f"size={memory}")  # noqa: S108  semaphores need one, and it is no way to others
        private = True
    wanted = [path.resolve() for path in (*_python(), *needed)]
    if private and (covered := [path for path in hidden if path.is_dir() and _beside(path, [*wanted, folder])]):
        with contextlib.suppress(OSError):
            for path in covered:
                _mount(path, "size=4k,mode=000")
            force.append(
                "data and results under empty mounts" if covered == hidden else "some folders under empty mounts"
            )
    if bound := _bound(tasks, root=root, private=private):
        force.append(f"at most {bound} tasks")
    with contextlib.suppress(OSError):
        devices = [*map(Path, _DEVICES), *sorted(Path("/dev").glob("nv[ihm]*"))]
        system = [*map(Path, _SYSTEM), *(Path("/etc", name) for name in _SETTINGS)]
        allowed = [part for path in (*system, *wanted) for part in without(path, hidden)]
        shared = [Path("/dev/shm")] if private else []  # noqa: S108  ours alone by then
        force.append(landlock.restrict(readable=allowed, writable=[folder, *shared, *devices]))
    with contextlib.suppress(OSError, AttributeError):
        _drop_privileges()
        force.append("no privileges")
    if not any("Landlock" in phrase or "data and results" in phrase for phrase in force):
        force.append("nothing hides the data and the results: this machine permits neither Landlock nor a mount")
    return force


def without(path: Path, hidden: Sequence[Path]) -> Iterator[Path]:
    """Yields what to allow so that all of a folder is, but for the hidden folders inside of it.

    What is asked for and lies in a hidden folder itself is yielded: there may be a Python in a folder of results.
    """
    path = path.resolve()
    if path in hidden:
        return
    if not any(each.is_relative_to(path) for each in hidden):
        yield path
        return
    with contextlib.suppress(OSError):
        for part in sorted(path.iterdir()):
            yield from without(part, hidden)


def _python() -> Iterator[Path]:
    """Yields where this Python and its packages are, installed as editable ones too."""
    yield from map(Path, {sys.prefix, sys.base_prefix, sys.exec_prefix, *sysconfig.get_paths().values()})
    yield from (Path(entry) for entry in sys.path if entry)
    yield from (Path(entry) for entry in os.environ.get("LD_LIBRARY_PATH", "").split(":") if entry)
    for name, module in list(sys.modules.items()):
        if name.startswith("__editable__"):
            yield from map(Path, getattr(module, "MAPPING", {}).values())


def _beside(path: Path, wanted: Sequence[Path]) -> bool:
    return not any(each == path or each.is_relative_to(path) for each in wanted)


def _unshare(*, user: bool) -> None:
    """Gives this process mounts of its own; who is not root needs a user namespace for it."""
    uid, gid = os.getuid(), os.getgid()
    checked(libc.unshare(_NEW_MOUNTS | (_NEW_USER if user else 0)), "unshare")
    if user:
        Path("/proc/self/setgroups").write_text("deny")
        Path("/proc/self/uid_map").write_text(f"{uid} {uid} 1")
        Path("/proc/self/gid_map").write_text(f"{gid} {gid} 1")
    checked(libc.mount(None, b"/", None, ctypes.c_ulong(_RECURSIVE | _PRIVATE), None), "mount")


def _mount(folder: Path, options: str) -> None:
    """Mounts an empty folder over one."""
    checked(libc.mount(b"none", os.fsencode(folder), b"tmpfs", ctypes.c_ulong(0), options.encode()), str(folder))


def _bound(tasks: int, *, root: bool, private: bool) -> int:
    """Bounds the number of tasks and returns it; 0 where the count would hold others too, so that none is set.

    The kernel exempts root, so that root goes on under a real user that nobody has; its files stay in reach.
    """
    if root:
        try:
            os.setresuid(_STRANGER + os.getpid(), -1, -1)
        except OSError:
            return 0
    elif not private:
        return 0
    tasks += _THREADS * (os.cpu_count() or 1)
    resource.setrlimit(resource.RLIMIT_NPROC, (tasks, tasks))
    return tasks


def _drop_privileges() -> None:
    """Gives up every capability, for what it starts too."""
    for capability in range(_LAST_CAPABILITY + 1):
        libc.prctl(_DROP_BOUNDING, capability, 0, 0, 0)
    header = (ctypes.c_uint32 * 2)(0x20080522, 0)
    checked(libc.capset(header, (ctypes.c_uint32 * 6)()), "capset")
