"""Tests the confinement of a plugin's process, on machines that permit all of it, some, or nothing."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from dlobench.bench import landlock
from dlobench.bench.confinement import without

SCRIPT = """
import json, os, sys, sysconfig
from pathlib import Path
from dlobench.bench import confinement, landlock
asked = json.loads(sys.argv[1])

def forbidden(*_, **__):
    raise OSError(1, "not permitted")

sysconfig.get_paths()  # while Python is still in reach, should it be root's own
if asked["user"]:
    os.setgroups([])
    os.setresgid(65534, 65534, 65534)
    os.setresuid(65534, 65534, 65534)
    landlock.libc.prctl(4, 1, 0, 0, 0)  # who has changed its user does not own its /proc before
for module, name in asked["forbidden"]:
    setattr({"confinement": confinement, "landlock": landlock}[module], name, forbidden)
hidden, folder = Path(asked["hidden"]), Path(asked["folder"])
force = confinement.confine(hidden=[hidden], needed=[], folder=folder, memory=10**9, tasks=10)
os.chdir(folder)

def tries(function):
    try:
        function()
    except OSError as error:
        return type(error).__name__
    except MemoryError as error:
        return "MemoryError"
    return "done"

def forks():
    started = []
    try:
        for _ in range(60):
            pid = os.fork()
            if not pid:
                import time
                time.sleep(30)
                os._exit(0)
            started.append(pid)
    except OSError:
        pass
    for pid in started:
        os.kill(pid, 9)
        os.waitpid(pid, 0)
    return len(started)

print(json.dumps({
    "force": force,
    "reads": tries(lambda: (hidden / "secret").read_text()),
    "writes": tries(lambda: (hidden / "new").write_text("x")),
    "own": tries(lambda: Path("notes").write_text("x")),
    "memory": tries(lambda: bytearray(2 * 10**9)),
    "mounts": tries(lambda: landlock.checked(landlock.libc.mount(b"none", b"/mnt", b"tmpfs", 0, None), "mount")),
    "forks": forks(),
}))
"""
MOUNTS, LANDLOCK = ("confinement", "_unshare"), ("landlock", "restrict")


@pytest.fixture
def folders() -> Iterator[tuple[Path, Path]]:
    """Returns a folder to hide and one to work in, open to every user, outside of what only root may enter."""
    root = Path(tempfile.mkdtemp())
    hidden, own = root / "hidden", root / "own"
    for path in (hidden, own):
        path.mkdir()
        path.chmod(0o777)
    root.chmod(0o755)
    (hidden / "secret").write_text("secret")
    (hidden / "secret").chmod(0o666)
    yield hidden, own
    shutil.rmtree(root)


def confined(folders: tuple[Path, Path], *forbidden: tuple[str, str], user: bool) -> dict[str, object]:
    """Confines a process on a machine that forbids some functions, as another user or as this one."""
    if user and os.geteuid() != 0:
        pytest.skip("only root can become another user, and who is not root is one already")
    asked = {"hidden": str(folders[0]), "folder": str(folders[1]), "forbidden": forbidden, "user": user}
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, json.dumps(asked)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, object] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("user", [False, True], ids=["as ourselves", "as nobody"])
@pytest.mark.parametrize("forbidden", [(), (MOUNTS,), (LANDLOCK,)], ids=["nothing", "mounts", "Landlock"])
def test_what_is_hidden_is_out_of_reach_by_either_means(
    user: bool, forbidden: tuple[tuple[str, str], ...], folders: tuple[Path, Path]
) -> None:
    found = confined(folders, *forbidden, user=user)
    said = "; ".join(str(phrase) for phrase in found["force"])  # type: ignore[attr-defined]
    if "nothing hides" in said:
        pytest.skip(f"this machine permits too little: {said}")
    assert found["reads"] in ("PermissionError", "FileNotFoundError")
    assert (folders[0] / "secret").read_text() == "secret"
    assert not (folders[0] / "new").exists()
    assert (found["own"], found["memory"]) == ("done", "MemoryError")
    assert found["mounts"] == "PermissionError"
    assert ("Landlock" in said) == (landlock.version() > 0 and LANDLOCK not in forbidden)
    if "tasks" in said:
        assert 0 < int(str(found["forks"])) <= 10 + 8 * (os.cpu_count() or 1)


def test_where_nothing_is_permitted_it_is_said(folders: tuple[Path, Path]) -> None:
    found = confined(folders, MOUNTS, LANDLOCK, user=False)
    assert found["reads"] == "done"
    assert "nothing hides the data and the results" in str(found["force"])
    assert "Landlock" not in str(found["force"]).replace("neither Landlock", "")


def test_a_folder_is_allowed_but_for_what_is_hidden_in_it(tmp_path: Path) -> None:
    for name in ("a/b/c", "a/b/d", "a/e"):
        (tmp_path / name).mkdir(parents=True)
    a = tmp_path / "a"
    assert list(without(a, [])) == [a]
    assert list(without(a, [a / "b" / "c"])) == [a / "b" / "d", a / "e"]
    assert list(without(a, [a / "b", a / "e"])) == []
    assert list(without(a, [a])) == []
    assert list(without(a / "e", [a])) == [a / "e"], "what is needed stays in reach, wherever it lies"
    (tmp_path / "link").symlink_to(a)
    assert list(without(tmp_path / "link", [a / "b"])) == [a / "e"]
