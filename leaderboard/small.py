"""Makes the records of the board at scale `small`, a run on every core, and goes on where it was stopped.

Without options it runs what is missing; `--plan` only tells what that is and how long it takes; `--task meta` does one
task; `--table` writes docs/runs.md. A record in `leaderboard/results` is not made again, whichever code made it.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dlobench.bench.plugins import hyperparameters, load_model, load_task
from dlobench.bench.results import read_all
from dlobench.errors import RunError

RESULTS = Path(__file__).parent / "results"
PAGE = Path(__file__).parent.parent / "docs" / "runs.md"
BEGIN, END = "<!-- plan -->\n", "<!-- end of plan -->\n"
SCORING = 0.15  # of the time of a fit, at most, goes to loading and scoring


@dataclass(frozen=True)
class Run:
    """Names a run of `dlobench run`: a task, a model, its seeds, hyperparameters, and how long a fit may last."""

    task: str
    model: str
    seeds: Sequence[int] = (0, 1, 2)
    settings: dict[str, Any] = field(default_factory=dict)
    steps: int | None = None  # None: the model stops by its own patience, or by its own number of steps
    minutes: float | None = None  # None: no clock ends a fit
    expected: float = 0.5  # minutes that a fit takes where no clock ends it

    @property
    def name(self) -> str:
        """Returns what it is called: the model and what is set of it."""
        return "-".join([self.model, *(f"{name}={value}" for name, value in self.settings.items())])


ADAPTING = ("finetune", "maml", "neural_process", "gnn_context")
FLOORS = ("persistence", "ridge")
# Minutes of a fit on one of two busy cores, where it serves all domains
META = {
    "multitask": 1.2, "mlp": 1.0, "gnn": 6.5, "finetune": 2.5, "maml": 10.0, "neural_process": 3.0, "gnn_context": 8.0
}  # fmt: skip
# Where every domain is fitted apart, steps end a fit and not the clock, so that a record does not depend on what else
# the machine had to do; a network of segments takes longer for 800 than one of all coordinates for 20,000.
FIXED: dict[str, Any] = {"steps": 20_000, "expected": 0.25}
APART: tuple[dict[str, Any], ...] = (
    {"model": "mlp", **FIXED},
    {"model": "gnn", "steps": 800, "expected": 0.6},
)
# Where a task fits ten times: half of what a graph network asks for, and less than others would take
REGIONS: dict[str, dict[str, Any]] = {
    "multitask": {"steps": 60_000, "expected": 0.8},
    "maml": {"steps": 8_000, "expected": 1.0},
    "gnn": {"steps": 2_000, "expected": 1.3},
    "gnn_context": {"steps": 2_000, "expected": 1.6},
}
OTHERWISE: tuple[dict[str, Any], ...] = ({"target": "absolute"}, {"frame": "push"})  # other representations
# The race of decision 22: nothing but the clock ends these fits
UNTIRING: dict[str, Any] = {"steps": 10**9, "patience": 10**6}
EQUAL = 4.0  # minutes
PLAN = (
    *(Run("meta", model, seeds=(0,), expected=0.1) for model in FLOORS),
    *(Run("meta", model, expected=minutes) for model, minutes in META.items()),
    *(Run("meta", model, settings=UNTIRING, minutes=EQUAL) for model in ("multitask", "finetune", "maml")),
    Run("meta", "oracle_parameters", seeds=(0,), expected=6.5),
    *(Run("horizon_sweep", model, seeds=(0,), expected=0.05) for model in FLOORS),
    *(Run("horizon_sweep", **limits, seeds=(0,)) for limits in APART),
    *(Run("horizon_sweep", "mlp", seeds=(0,), settings=settings, **FIXED) for settings in OTHERWISE),
    Run("length_sweep", "ridge", seeds=(0,), expected=0.05),
    *(Run("length_sweep", **limits, seeds=(0,)) for limits in APART),
    *(Run("length_sweep", "mlp", seeds=(0,), settings=settings, **FIXED) for settings in OTHERWISE),
    *(Run(task, "persistence", seeds=(0,), expected=0.1) for task in ("meta_noisy", "meta_objects", "ood")),
    *(Run("meta_noisy", model, expected=META[model]) for model in ("multitask", *ADAPTING)),
    *(Run("meta_objects", model, seeds=(0,), expected=5) for model in ("multitask", "gnn", *ADAPTING)),
    *(Run("ood", model, seeds=(0,), **limit) for model, limit in REGIONS.items()),
    Run("rollout", "persistence", seeds=(0,), expected=0.05),
    *(Run("rollout", **limits, seeds=(0,)) for limits in APART),
    *(Run("rollout", "mlp", seeds=(0,), settings=settings, **FIXED) for settings in OTHERWISE),
    Run("distribution", "persistence", seeds=(0,), expected=0.05),
    Run("distribution", "mlp_gaussian", seeds=(0,), steps=20_000, expected=0.2),
    *(Run("distribution", model, seeds=(0,), steps=800, expected=0.9) for model in ("gnn_noise", "flow", "cvae")),
)


def fits(task: str) -> int:
    """Returns how many fits a run of a task takes at scale small."""
    return len(load_task(task).fits("small"))


def pending(plan: Sequence[Run]) -> Iterator[tuple[Run, int]]:
    """Yields the runs and seeds of which no record stands in the results.

    A hyperparameter that a record does not name came later, and its default is what had been before.
    """
    there = [
        (r.task, r.model, r.seed, r.provenance.hyperparameters, r.provenance.budget)
        for r in (read_all(RESULTS) if RESULTS.exists() else [])
        if r.scale == "small" and not r.failures
    ]
    for run in plan:
        defaults = hyperparameters(load_model(run.model).model)
        wanted = defaults | run.settings, {"steps": run.steps, "minutes": run.minutes}
        found = [
            seed
            for task, model, seed, hyper, budget in there
            if (task, model) == (run.task, run.model) and (defaults | hyper, budget) == wanted
        ]
        yield from ((run, seed) for seed in run.seeds if seed not in found)


def hours(run: Run) -> float:
    """Returns the core-hours that one seed of a run is expected to take."""
    return fits(run.task) * (run.minutes or run.expected) * (1 + SCORING) / 60


def table(plan: Sequence[Run]) -> str:
    """Returns which model runs on which task, as Markdown: seeds, what ends a fit, core-hours, records there are."""
    rows = ["| task | model | seeds | recorded | a fit stops | fits a seed | core-hours |", "| --- " * 7 + "|"]
    lacking = [(run.task, run.name) for run, _ in pending(plan)]
    for run in plan:
        there = len(run.seeds) - lacking.count((run.task, run.name))
        model = f"`{run.model}`" + "".join(f", `{name}={value}`" for name, value in run.settings.items())
        limits = [f"after {run.steps:,} steps"] if run.steps is not None else []
        limits += [f"after {run.minutes:g} minutes"] if run.minutes is not None else []
        limit = " or ".join(limits) or "by itself"
        cost = hours(run) * len(run.seeds)
        rows.append(
            f"| `{run.task}` | {model} | {len(run.seeds)} | {there or '–'} | {limit} | {fits(run.task)} | {cost:.2f} |"
        )
    return "\n".join(rows) + "\n"


def written(page: str) -> str:
    """Returns docs/runs.md with the table of the plan between its two marks; raises `RunError` where one is missing."""
    before, begin, rest = page.partition(BEGIN)
    _, end, after = rest.partition(END)
    if not (begin and end):
        raise RunError(f"docs/runs.md lacks the mark {(END if begin else BEGIN).strip()}")
    return before + BEGIN + table(PLAN) + END + after


def command(run: Run, seed: int) -> list[str]:
    """Returns the command line of one seed."""
    settings = [part for name, value in run.settings.items() for part in ("--set", f"{name}={value}")]
    limit = [] if run.steps is None else ["--max-steps", str(run.steps)]
    limit += [] if run.minutes is None else ["--max-minutes", f"{run.minutes:g}"]
    what = ["--task", run.task, "--scale", "small", "--model", run.model, "--seed", str(seed)]
    return [str(Path(sys.executable).with_name("dlobench")), "run", *what, *settings, *limit, "--out", str(RESULTS)]


def make(run: Run, seed: int) -> bool:
    """Runs one command, its output into a log beside the records, and tells whether it made its record."""
    name = f"{run.task}-{run.name}-{seed}"
    log = RESULTS.parent / "logs" / f"{name}.log"
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("w") as out:
        done = subprocess.run(command(run, seed), stdout=out, stderr=subprocess.STDOUT, check=False).returncode == 0
    print(f"{name}: {'recorded' if done else f'failed, see {log}'}", flush=True)
    return done


def jobs(text: str) -> int:
    """Reads a number of runs at a time; raises `ValueError` unless it is 1 or more."""
    if int(text) < 1:
        raise ValueError(text)
    return int(text)


def main() -> int:
    """Tells what will run and how long it takes, then runs it; or says in a sentence why it cannot."""
    try:
        return asked()
    except RunError as error:
        print(f"small.py: {error}", file=sys.stderr)
        return error.exit_code


def asked() -> int:
    """Does what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--plan", action="store_true", help="only tell what would run")
    parser.add_argument("--table", action="store_true", help="write the table into docs/runs.md")
    parser.add_argument("--task", choices=sorted({run.task for run in PLAN}), help="one task alone")
    parser.add_argument("--jobs", type=jobs, default=os.cpu_count(), help="runs at a time; default: one a core")
    chosen = parser.parse_args()
    plan = [run for run in PLAN if chosen.task in (None, run.task)]
    if chosen.table:
        PAGE.write_text(written(PAGE.read_text()))
        return 0
    wanted = sorted(pending(plan), key=lambda one: one[1])  # a first seed of everything comes first
    for run, seed in wanted:
        print(f"{run.task:14} {run.name:20} seed {seed}  {60 * hours(run):6.0f} min")
    total = sum(hours(run) for run, _ in wanted)
    print(f"{len(wanted)} runs are missing: {total:.1f} core-hours, about {total / chosen.jobs:.1f} hours here")
    if chosen.plan:
        return 0
    with ThreadPoolExecutor(chosen.jobs) as pool:
        done = list(pool.map(lambda one: make(*one), wanted))
    return 0 if all(done) else 1


if __name__ == "__main__":
    sys.exit(main())
