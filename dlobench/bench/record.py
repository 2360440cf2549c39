"""Defines what a record of a run holds: its scores, joined with everything that they came from."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, field_serializer, field_validator, model_validator

_NAME = r"^[A-Za-z0-9_.-]+$"
_SHA256 = r"^[0-9a-f]{64}$"


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

    @field_validator("domains", mode="before")
    @classmethod
    def _rows(cls, value: object) -> object:
        """Makes rows of columns: files hold a list a score, in the order of the domains."""
        if not isinstance(value, dict):
            return value
        names = list(value)
        return [
            {name: cell for name, cell in zip(names, row, strict=True) if cell is not None}
            for row in zip(*value.values(), strict=True)
        ]

    @field_serializer("domains")
    def _columns(self, domains: list[DomainScore]) -> dict[str, list[Any]]:
        names = [name for name in DomainScore.model_fields if any(getattr(d, name) is not None for d in domains)]
        return {name: [getattr(domain, name) for domain in domains] for name in names}


class FitReport(_Part):
    """Tells what a fit took and how it went."""

    trajectories: int
    horizon: int
    domain: str | None = None  # set/index, where every domain is fitted apart
    without: str | None = None  # what it did not train on
    seconds: float
    curve: list[dict[str, float]]  # step and what the model logged


class Failure(_Part):
    """Names a fit that failed, and why."""

    trajectories: int
    horizon: int
    domain: str | None = None
    without: str | None = None
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
    privileged: bool = False  # whether the model saw the parameters of domains, and has no place
    seconds: float  # wall time of the whole run, data aside
    fits: list[FitReport]
    cells: list[CellScore]
    failures: list[Failure] = []  # fits that failed; their cells are missing
    predictions_sha256: str | None = Field(default=None, pattern=_SHA256)  # of the file of predictions beside it
    provenance: Provenance

    @model_validator(mode="after")
    def _every_cell_has_a_fit(self) -> Record:
        fits = {(fit.trajectories, fit.without) for fit in self.fits}
        for cell in self.cells:
            if (cell.trajectories, cell.without) not in fits:
                raise ValueError(f"cell {cell.id} has no fit")
        return self

    def path(self, results: Path) -> Path:
        """Returns where the record is kept: no two configurations share a place."""
        return results / self.task / self.scale / f"{self.model}@{self.config}" / f"seed{self.seed}.json"
