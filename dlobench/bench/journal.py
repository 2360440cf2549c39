"""Keeps what a run has finished, fit by fit, so that a killed run goes on with the next one."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from dlobench.bench import kept
from dlobench.bench.kept import Kept
from dlobench.bench.record import DomainScore, FitReport
from dlobench.errors import RunError

Key = tuple[int, int, str | None, str | None]  # trajectories, horizon, domain and what is left out


class Scores(BaseModel):
    """Holds the scores of all domains that a fit is tested on, at one point of the sweep."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    horizon: int
    K: int
    domains: list[DomainScore]


class Finished(BaseModel):
    """Holds one fit and all that it was scored on."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    fit: FitReport
    parameters: int
    seconds: float  # wall time of fit and scoring
    scores: list[Scores]

    @property
    def key(self) -> Key:
        """Returns what tells fits of a run apart."""
        return self.fit.trajectories, self.fit.horizon, self.fit.domain, self.fit.without

    def of(self, horizon: int, K: int) -> list[DomainScore]:
        """Returns the scores of all domains at one point of the sweep."""
        return [score for each in self.scores if (each.horizon, each.K) == (horizon, K) for score in each.domains]


@dataclass(frozen=True)
class Journal:
    """Appends finished fits to a hidden folder beside the record, a synced line each, with what they predicted."""

    folder: Path

    @staticmethod
    def beside(record: Path) -> Journal:
        """Returns the journal of the run that will leave a record at this path."""
        return Journal(record.with_name(f".{record.stem}"))

    @property
    def path(self) -> Path:
        """Returns the file of finished fits."""
        return self.folder / "fits.jsonl"

    def read(self) -> dict[Key, Finished]:
        """Returns what was finished; a last line that a kill cut off was not. Raises `RunError` on other odd lines."""
        try:
            lines = self.path.read_bytes().splitlines(keepends=True)
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise RunError(f"cannot read {self.path}: {error.strerror}") from error
        out = {}
        for number, line in enumerate(lines):
            if number == len(lines) - 1 and not line.endswith(b"\n"):
                break
            try:
                finished = Finished.model_validate_json(line)
            except ValidationError as error:
                raise RunError(f"line {number + 1} of {self.path} is no finished fit; remove the file") from error
            out[finished.key] = finished
        return out

    def kept(self, name: str) -> list[Kept]:
        """Returns what was kept of the predictions of a fit; raises `RunError` where it cannot be read."""
        return kept.read(self.folder / f"{name}.safetensors")

    def append(self, finished: Finished, name: str, some: list[Kept]) -> None:
        """Adds a fit, under the name that its files have; raises `RunError` when the disk refuses."""
        kept.write(self.folder / f"{name}.safetensors", some)
        content = finished.model_dump_json(exclude_none=True).encode() + b"\n"
        try:
            whole = self.path.read_bytes() if self.path.exists() else b""
            with self.path.open("r+b" if whole else "wb") as file:
                file.seek(whole.rfind(b"\n") + 1)  # over what a kill has cut off
                file.write(content)
                file.truncate()
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise RunError(f"cannot write {self.path}: {error.strerror}") from error

    def remove(self) -> None:
        """Forgets everything."""
        shutil.rmtree(self.folder, ignore_errors=True)
