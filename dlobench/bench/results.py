"""Keeps records: one sealed JSON file a run, read back only if it is whole, ours and in its place."""

from __future__ import annotations

import gc
import hashlib
import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from pydantic import ValidationError
from pydantic_core import from_json

import dlobench
from dlobench.bench.record import Record
from dlobench.data.store import atomic_write
from dlobench.errors import RunError

_FILE = re.compile(r"^seed\d+\.json$")
_BESIDE = re.compile(r"^(plugin\.py|seed\d+(\.safetensors|/[^/]+\.safetensors))$")  # plugin, predictions, weights
_SEAL = b',"seal":"%s"}\n'  # SHA-256 of all that stands before it


def config_digest(**parts: Any) -> str:
    """Returns 8 hexadecimal digits that tell configurations apart: plugin, hyperparameters, task, data, split."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()[:8]


def code_digest() -> str:
    """Returns the SHA-256 of dlobench's own sources, so that a record is never taken for one of other code."""
    root = Path(dlobench.__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        if path.relative_to(root).parts[0] not in ("models", "tasks"):  # plugins answer for themselves
            digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def write(record: Record, results: Path) -> Path:
    """Writes a record under a results folder, whole or not at all, and returns its path."""
    path = record.path(results)
    before = record.model_dump_json().removesuffix("}").encode()
    atomic_write(path, before + _SEAL % hashlib.sha256(before).hexdigest().encode())
    return path


def check_writable(results: Path) -> None:
    """Makes the results folder where there is none; raises `RunError` when nothing can be written there."""
    try:
        results.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=results):
            pass
    except OSError as error:
        raise RunError(f"cannot write into {results}: {error.strerror}") from error


def read(path: Path, results: Path) -> Record:
    """Reads a record; raises `RunError` for what is foreign, half-written or not in its place."""
    try:
        content = path.read_bytes()
        data = from_json(content)
        if isinstance(data, dict):
            data.pop("seal", None)
        record = Record.model_validate(data)
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RunError(f"{path} is not a record of ours: {where}: {first['msg']}; move it away") from error
    except ValueError as error:
        raise RunError(f"{path} is not a record of ours: the file: {error}; move it away") from error
    if record.path(results) != path:
        raise RunError(f"{path} holds the record that belongs to {record.path(results)}; move it there")
    before = content[: content.rfind(_SEAL[:8])]
    if content != before + _SEAL % hashlib.sha256(before).hexdigest().encode():
        raise RunError(f"{path} was changed after it was written: its seal is not that of its content; run it again")
    return record


def read_all(results: Path) -> list[Record]:
    """Reads every record under a results folder, in the order of their paths; raises `RunError` as `paths` does."""
    found, collecting = paths(results), gc.isenabled()
    gc.disable()  # of a thousand records nothing is garbage, and looking for it takes a third of the time
    try:
        return [read(path, results) for path in found]
    finally:
        if collecting:
            gc.enable()


def paths(results: Path) -> list[Path]:
    """Returns the path of every record under a results folder, in order.

    Raises `RunError` for a missing folder and for any file that is not a record, since to skip it would be silent.
    Hidden files and folders, of runs that go on or were killed, and tables and the page at the top are no records;
    the plugin, predictions and weights stand beside theirs.
    """
    if not results.is_dir():
        raise RunError(f"no results folder at {results}")
    out = []
    for path in sorted(results.rglob("*")):
        inside = path.relative_to(results)
        if path.is_dir() or any(part.startswith(".") for part in inside.parts):
            continue
        if len(inside.parts) == 1 and path.suffix in (".csv", ".md", ".html"):
            continue
        if _BESIDE.match("/".join(inside.parts[3:])):
            continue
        if not _FILE.match(path.name) or not path.is_file():
            raise RunError(f"{path} is not a record of ours (task/scale/model@config/seed<k>.json); move it away")
        out.append(path)
    return out


def checkout() -> tuple[str | None, bool | None]:
    """Returns the git commit of the checkout that dlobench runs from and whether it has changes, or None twice.

    Records are none: the one that a run has just made is not yet committed when the next begins.
    """
    root = Path(dlobench.__file__).parents[1]
    if not (root / ".git").exists():
        return None, None

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout

    try:
        return git("rev-parse", "HEAD").strip(), bool(git("status", "--porcelain", "--", ".", ":!leaderboard").strip())
    except (OSError, subprocess.CalledProcessError):
        return None, None
