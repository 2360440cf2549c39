"""Runs work as an array of SLURM jobs, which submitit writes, submits and collects."""

from __future__ import annotations

import contextlib
import io
import re
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from dlobench.errors import RunError, UsageError

Work = TypeVar("Work")
Result = TypeVar("Result")

TASKS = 1000  # of an array, at most: SLURM takes 1,001 unless it is told otherwise
CHUNK = 10  # pieces a task, at least: a task takes seconds to start
MINUTES = 30  # that a task may take, at least
WORKERS = 64  # tasks at a time
POLL = 1.0  # s between two looks for results
ASK = 20.0  # s between two questions to the queue
OURS = frozenset({"array", "error", "nodes", "open_mode", "output", "signal"})  # options that are not the user's


def parse_options(settings: Sequence[str]) -> dict[str, str]:
    """Reads options of sbatch given as KEY=VALUE; raises `UsageError` for what is none."""
    options = {}
    for setting in settings:
        key, equals, value = setting.partition("=")
        name = key.removeprefix("--").replace("-", "_")
        if not (equals and re.fullmatch("[a-z][a-z_]*", name) and value and value.isprintable()):
            raise UsageError(f"--slurm {setting!r} is not KEY=VALUE, a long option of sbatch, as in partition=batch")
        if name in OURS:
            raise UsageError(f"--slurm {setting!r}: dlobench itself decides on {', '.join(sorted(OURS))}")
        options[name] = value
    if "time" in options:
        minutes(options["time"])
    return options


def minutes(text: str) -> int:
    """Returns the whole minutes of a time limit in any of SLURM's ways to write it; raises `UsageError`."""
    days, dash, rest = text.rpartition("-")
    parts = rest.split(":")
    if not all(part.isascii() and part.isdigit() for part in [*parts, *([days] if dash else [])]) or len(parts) > 3:
        raise UsageError(f"--slurm time={text!r} is no time limit of SLURM, as in 90, 1:30:00 or 1-12")
    unit = (3600, 60, 1) if dash or len(parts) == 3 else (60, 1)  # s
    seconds = sum(int(part) * size for part, size in zip(parts, unit, strict=False)) + int(days or 0) * 86400
    if not seconds:
        raise UsageError(f"--slurm time={text!r} leaves no time to work")
    return -(-seconds // 60)


@dataclass(frozen=True)
class Slurm:
    """Applies a function to pieces of work on the nodes of a SLURM cluster."""

    folder: Path  # for scripts, logs and results; every node must see it
    options: Mapping[str, str] = field(default_factory=dict)  # of sbatch
    workers: int = WORKERS
    chunk: int = CHUNK  # pieces a task, at least

    def __call__(self, function: Callable[[Work], Result], work: Iterable[Work]) -> Iterator[Result]:
        """Yields the results, task by task. When one fails, and on Ctrl-C, what is queued or running is cancelled.

        Scripts, logs and results are kept in a folder of this call's own, which goes when all has succeeded.
        """
        chunks = self._chunks(list(work))
        if not chunks:
            return
        folder = self._folder()
        waiting = {str(job.job_id): job for job in self._submit(folder, partial(_each, function), chunks)}
        try:
            for job in _arrivals(folder, waiting):
                yield from _result(job)
        finally:
            if waiting:
                subprocess.run(["scancel", *{name.partition("_")[0] for name in waiting}], check=False)
        shutil.rmtree(folder, ignore_errors=True)

    def script(self, pieces: int) -> tuple[Path, int]:
        """Writes the script that would be submitted for so many pieces; returns where it is, and its tasks."""
        from submitit.slurm.slurm import SlurmExecutor, _make_sbatch_string

        tasks = len(self._chunks(range(pieces)))

        class Absent(SlurmExecutor):  # type: ignore[misc]
            """Writes commands where there is no SLURM."""

            @classmethod
            def affinity(cls) -> int:
                return 1

        command = Absent(self.folder)._submitit_command_str
        text = _make_sbatch_string(command, self.folder, map_count=tasks, **self._parameters(pieces))
        path = self.folder / "dry-run.sh"
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        except OSError as error:
            raise RunError(f"cannot write {path}: {error.strerror}") from error
        return path, tasks

    def _chunks(self, pieces: Sequence[Work]) -> list[Sequence[Work]]:
        size = max(self.chunk, -(-len(pieces) // TASKS))
        return [pieces[first : first + size] for first in range(0, len(pieces), size)]

    def _parameters(self, pieces: int) -> dict[str, Any]:
        """Returns submitit's parameters. A piece has a minute, some ten times what it takes."""
        extra = {"job_name": "dlobench", "wckey": "dlobench", "cpus_per_task": "1"} | dict(self.options)
        limit = extra.pop("time", str(max(MINUTES, len(self._chunks(range(pieces))[0]))))
        return {"time": minutes(limit), "array_parallelism": self.workers, "additional_parameters": extra}

    def _folder(self) -> Path:
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            return Path(tempfile.mkdtemp(prefix=time.strftime("%Y-%m-%dT%H%M%S-"), dir=self.folder))
        except OSError as error:
            raise RunError(f"cannot write {self.folder}: {error.strerror}") from error

    def _submit(self, folder: Path, function: Callable[..., Any], chunks: Sequence[Sequence[Any]]) -> list[Any]:
        """Submits an array of a task a chunk."""
        from submitit import SlurmExecutor
        from submitit.core.utils import FailedJobError

        try:
            executor = SlurmExecutor(folder)
            executor.update_parameters(**self._parameters(sum(map(len, chunks))))
            with contextlib.redirect_stderr(io.StringIO()):  # what sbatch says is in the error, too
                jobs: list[Any] = executor.map_array(function, chunks)
        except FailedJobError as error:  # what sbatch said
            raise RunError(f"sbatch refuses: {' '.join(str(error).split())}") from error
        except OSError as error:
            raise RunError(f"cannot submit from {folder}: {error.strerror}") from error
        return jobs


def check_sbatch() -> None:
    """Raises `UsageError` where jobs cannot be submitted."""
    missing = [name for name in ("sbatch", "srun", "squeue", "scancel") if shutil.which(name) is None]
    if missing:
        raise UsageError(
            f"--executor slurm finds no {missing[0]} on the PATH; call it where jobs are submitted, or with --dry-run"
        )


def _arrivals(folder: Path, waiting: dict[str, Any]) -> Iterator[Any]:
    """Yields jobs whose results are there; takes them out of `waiting`."""
    suspects: set[str] = set()
    asked = time.monotonic()
    while waiting:
        there = {path.name for path in folder.glob("*_result.pkl")}
        for name in [name for name, job in waiting.items() if job.paths.result_pickle.name in there]:
            yield waiting.pop(name)
        if waiting and time.monotonic() - asked > ASK:
            # No job leaves the queue without a result, but a file may be seen a while after it was written.
            queued = _queued()
            gone = set(waiting) - (set(waiting) if queued is None else queued)
            for name in sorted(gone & suspects):
                raise RunError(_failure(waiting[name], "it left the queue without a result"))
            suspects, asked = gone, time.monotonic()
        time.sleep(POLL if waiting else 0)


def _each(function: Callable[[Work], Result], pieces: Sequence[Work]) -> list[Result]:
    return [function(piece) for piece in pieces]


def _result(job: Any) -> list[Any]:
    error = job.exception()
    if error is not None:
        trace = [line for line in str(error).split("-" * 22)[1:2] for line in line.strip().splitlines()]
        raise RunError(_failure(job, trace[-1] if trace else str(error))) from error
    found: list[Any] = job.result()
    return found


def _failure(job: Any, why: str) -> str:
    return f"SLURM job {job.job_id} failed ({why}); its log is {job.paths.stderr}"


def _queued() -> set[str] | None:
    """Returns the ids of this user's jobs that are waiting or running, or None where the queue cannot be asked."""
    asked = subprocess.run(
        ["squeue", "--me", "--noheader", "--array", "--format=%i"], capture_output=True, text=True, check=False
    )
    return set(asked.stdout.split()) if asked.returncode == 0 else None
