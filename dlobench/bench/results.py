"""Records runs: one JSON file a run, joining scores with everything that they came from."""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import tempfile
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

import dlobench
from dlobench.data.store import atomic_write
from dlobench.errors import RunError

_NAME = r"^[A-Za-z0-9_.-]+$"
_SHA256 = r"^[0-9a-f]{64}$"
_FILE = re.compile(r"^seed\d+\.json$")


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DomainScore(_Part):
    """Holds the scores of one unseen domain, averaged over its supports."""

    domain: str  # set/index
    cell: str  # of the set: material-attachment-length-objects
    supports: int = Field(ge=1)
    windows: int = Field(ge=1)  # queries
    moving: int = Field(ge=0)  # of them move the DLO by more than 1 mm
    mse: float = Field(ge=0)  # m², per coordinate
    euclidean: float = Field(ge=0)  # m, per segment
    shape: float = Field(ge=0)  # m, root mean square over the segments of a window
    persistence_mse: float = Field(ge=0)  # m²
    persistence_euclidean: float = Field(ge=0)  # m
    adapt_seconds: float = Field(ge=0)  # of one adaptation
    predict_seconds: float = Field(ge=0)  # of one query
    euclidean_moving: float | None = Field(default=None, ge=0)  # m, over the windows that move; None where none does
    body_position: float | None = Field(default=None, ge=0)  # m, per rigid body; None where none is, or is predicted
    body_yaw: float | None = Field(default=None, ge=0)  # rad
    # Of models applied to their own predictions: whether what they predict could be a DLO at all.
    spacing: float | None = Field(default=None, ge=0)  # mean |distance of neighbours / segment length − 1|
    overlap: float | None = Field(default=None, ge=0, le=1)  # share of windows in which the DLO lies in itself
    # Of samples, against re-executions of the same commands. Fair scores may be negative.
    energy: float | None = None  # m, of whole shapes
    energy_floor: float | None = None  # m, of re-executions against others
    persistence_energy: float | None = Field(default=None, ge=0)  # m
    segment_energy: float | None = None  # m, of single segments
    variogram: float | None = None  # m
    crps: float | None = None  # m
    mmd2: float | None = None  # None of a single sample, as what follows
    coverage50: float | None = Field(default=None, ge=0, le=1)  # of what moves, by the central intervals
    coverage90: float | None = Field(default=None, ge=0, le=1)
    unmoved: float | None = Field(default=None, ge=0, le=1)  # share of segments that rest in truth and samples
    ranks: list[int] | None = None  # how often the truth has its rank among the samples, in bins of equal width
    shape_ranks: list[int] | None = None  # the same of whole shapes


class Sample(_Part):
    """Holds the scores of just those predictions that are kept beside the record."""

    windows: int = Field(ge=1)
    mse: float = Field(ge=0)  # m²
    euclidean: float = Field(ge=0)  # m
    energy: float | None = None  # m, where samples are scored


class CellScore(_Part):
    """Holds the scores of one point of a task's sweep."""

    id: str
    trajectories: int  # a training domain
    horizon: int
    K: int
    without: str | None = None  # what training lacked and is tested on, where the task leaves something out
    mse: float = Field(ge=0)  # m², mean over domains
    euclidean: float = Field(ge=0)  # m, mean over domains
    energy: float | None = None  # m, mean over domains, where samples are scored
    skill: float  # 1 − Σ mse / Σ persistence_mse, or the same of the energy score where samples are scored
    domains: list[DomainScore]
    sample: Sample | None = None


class FitReport(_Part):
    """Tells what a fit took and how it went."""

    trajectories: int
    horizon: int
    domain: str | None = None  # set/index, where every domain is fitted apart
    seconds: float
    curve: list[dict[str, float]]  # step and what the model logged


class Failure(_Part):
    """Names a fit that failed, and why."""

    trajectories: int
    horizon: int
    domain: str | None = None
    error: str


class Provenance(_Part):
    """Says where a record comes from, well enough to make it again."""

    command: str
    created: str  # UTC, ISO 8601
    commit: str | None  # of the checkout, where there is one
    dirty: bool | None
    versions: dict[str, str]
    cpu: dict[str, Any]
    device: str
    set: str  # key of the set: name, versions of set, world and engine
    data_sha256: str = Field(pattern=_SHA256)  # definition digest of the data that was used
    split_sha256: str = Field(pattern=_SHA256)
    plugin_sha256: str = Field(pattern=_SHA256)
    hyperparameters: dict[str, Any]
    K: list[int]
    budget: dict[str, float | None]
    protection: list[str] = Field(default_factory=list)  # from the plugin, what was in force; once it was not recorded


class Record(_Part):
    """Holds the record of a run: one task, scale, model configuration and seed."""

    schema_version: Literal[1] = 1
    task: str = Field(pattern=_NAME)
    task_version: int
    scale: Literal["mini", "small", "paper"]
    model: str = Field(pattern=_NAME)
    config: str = Field(pattern=r"^[0-9a-f]{8}$")
    seed: int = Field(ge=0)
    parameters: int = Field(ge=0, lt=2**63)  # learned ones
    seconds: float  # wall time of the whole run, data aside
    fits: list[FitReport]
    cells: list[CellScore]
    failures: list[Failure] = []  # fits that failed; their cells are missing
    provenance: Provenance

    @model_validator(mode="after")
    def _every_cell_has_a_fit(self) -> Record:
        fits = {(fit.trajectories, fit.horizon) for fit in self.fits}
        for cell in self.cells:
            if (cell.trajectories, cell.horizon) not in fits:
                raise ValueError(f"cell {cell.id} has no fit")
        return self

    def path(self, results: Path) -> Path:
        """Returns where the record is kept: no two configurations share a place."""
        return results / self.task / self.scale / f"{self.model}@{self.config}" / f"seed{self.seed}.json"


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
    atomic_write(path, (record.model_dump_json(indent=1) + "\n").encode())
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
        record = Record.model_validate_json(path.read_bytes())
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "the file"
        raise RunError(f"{path} is not a record of ours: {where}: {first['msg']}; move it away") from error
    if record.path(results) != path:
        raise RunError(f"{path} holds the record that belongs to {record.path(results)}; move it there")
    return record


def read_all(results: Path) -> list[Record]:
    """Reads every record under a results folder, in the order of their paths.

    Raises `RunError` for a missing folder and for any file that is not a record, since to skip it would be silent.
    Hidden files, left by a run that was killed while writing, and tables at the top are no records.
    """
    if not results.is_dir():
        raise RunError(f"no results folder at {results}")
    out = []
    for path in sorted(results.rglob("*")):
        if path.is_dir() or path.name.startswith(".") or (path.parent == results and path.suffix in (".csv", ".md")):
            continue
        if not _FILE.match(path.name) or not path.is_file():
            raise RunError(f"{path} is not a record of ours (task/scale/model@config/seed<k>.json); move it away")
        out.append(read(path, results))
    return out


def checkout() -> tuple[str | None, bool | None]:
    """Returns the git commit of the checkout that dlobench runs from and whether it has changes, or None twice."""
    root = Path(dlobench.__file__).parents[1]
    if not (root / ".git").exists():
        return None, None

    def git(*arguments: str) -> str:
        return subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True).stdout

    try:
        return git("rev-parse", "HEAD").strip(), bool(git("status", "--porcelain").strip())
    except (OSError, subprocess.CalledProcessError):
        return None, None
