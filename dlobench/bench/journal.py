"""Keeps what a run has finished, fit by fit, so that a killed run goes on with the next one."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from pydantic import BaseModel, ConfigDict, ValidationError

from dlobench.bench.results import DomainScore, FitReport
from dlobench.errors import RunError


class Finished(BaseModel):
    """Holds one fit and the scores of every K and domain that it was scored on."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    fit: FitReport
    parameters: int
    seconds: float  # wall time of fit and scoring
    scores: dict[int, list[DomainScore]]  # by K

    @property
    def key(self) -> tuple[int, int, str | None]:
        """Returns what tells fits of a run apart: trajectories, horizon, and the domain where it is about one."""
        return self.fit.trajectories, self.fit.horizon, self.fit.domain


@dataclass(frozen=True)
class Journal:
    """Appends finished fits to a hidden file beside the record, a line each, synced."""

    path: Path

    @staticmethod
    def beside(record: Path) -> Journal:
        """Returns the journal of the run that will leave a record at this path."""
        return Journal(record.with_name(f".{record.stem}.jsonl"))

    def read(self) -> dict[tuple[int, int, str | None], Finished]:
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

    def append(self, finished: Finished) -> None:
        """Adds a line; raises `RunError` when the disk refuses."""
        content = finished.model_dump_json().encode() + b"\n"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
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
        self.path.unlink(missing_ok=True)
