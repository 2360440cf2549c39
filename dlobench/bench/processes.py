"""Watches a process and its descendants by /proc: how many there are, what they hold, and how to end them all."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from pathlib import Path


def descendants(pid: int) -> list[int]:
    """Returns the processes that descend from one, zombies aside; none where there is no /proc."""
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc") if Path("/proc").is_dir() else []:  # noqa: PTH208  ten times as fast as iterdir
        if name.isdigit():
            with contextlib.suppress(OSError), open(f"/proc/{name}/stat", "rb") as file:  # noqa: PTH123
                state, parent = file.read().rpartition(b")")[2].split()[:2]
                children.setdefault(int(parent), []).append(int(name) if state != b"Z" else -int(name))
    found, new = list[int](), [pid]
    while new:
        new = [child for parent in new for child in children.get(parent, [])]
        found += new
    return [child for child in found if child > 0]


def resident(pids: list[int]) -> int:
    """Returns the memory, bytes, that processes hold and do not share with others by a file."""
    pages = 0
    for pid in pids:
        with contextlib.suppress(OSError):
            _, held, shared, *_ = Path(f"/proc/{pid}/statm").read_text().split()
            pages += int(held) - int(shared)
    return pages * os.sysconf("SC_PAGE_SIZE")


def end_descendants(pid: int, seconds: float = 5.0) -> None:
    """Kills all that descends from a process: first it stops them, so that none can start another meanwhile."""
    until = time.monotonic() + seconds
    while (found := descendants(pid)) and time.monotonic() < until:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            for each in found:
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.kill(each, number)
        time.sleep(0.01)
