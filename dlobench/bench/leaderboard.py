"""Builds the leaderboard: records in, one table out. The same records give the same bytes."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Container
from pathlib import Path
from typing import Any

import pandas as pd

from dlobench.bench.matrix import Key, Matrix, grids, intervals_of
from dlobench.bench.ranking import placed, ranked
from dlobench.bench.record import Record
from dlobench.bench.scores import SKILL, scores
from dlobench.data.store import atomic_write
from dlobench.errors import RunError, UsageError

EQUAL_SECONDS = {"mini": 30, "small": 300, "paper": 3600}  # of each fit: what `--max-minutes` 0.5, 5 and 60 keep to
DIGITS = 12  # of a skill, which may be 0 but for rounding
LATE = 1.1  # times that, which pass: a model looks at the clock between steps, and has data to prepare

GROUP = ["task", "task_version", "scale", "data", "split"]  # only what was scored on the same is ever compared
ROW = [*GROUP, "cell", "model", "config"]
SWEEP = ["trajectories", "horizon", "K", "without"]
MEANS = {
    "euclidean": "euclidean_m",
    "energy": "energy_m",
    "spacing": "spacing",
    "overlap": "overlap",
    "coverage90": "coverage90",
    "adapt_seconds": "adapt_s",
    "predict_seconds": "predict_s",
}
COLUMNS = [
    "task", "task_version", "scale", "cell", "model", "config", "settings", "seeds", "place", "tie",
    "skill", "skill_low", "skill_high", "mse_m2", "mse_low", "mse_high", "euclidean_m", "energy_m",
    "spacing", "overlap", "coverage90", "fit_s", "adapt_s", "predict_s", "skill_equal_time", "parameters",
    "trajectories", "horizon", "K", "without", "domains", "rank", "rank_low", "rank_high", "data", "split",
]  # fmt: skip


def table(records: list[Record], tidy: pd.DataFrame | None = None) -> pd.DataFrame:
    """Returns one row a cell and configuration, best first within a cell; what a row has not is NaN, or "" of a word.

    `tidy` are the `scores` of the records, for those who have them already. A configuration is a competitor, and only
    those over the same data and split meet. Numbers are over the domains that every seed has: skill and MSE with
    intervals at 95 %, places with ties within a cell, ranks over the cells of a task and scale (`ranking.placed` and
    `ranked`), means of the rest. Privileged models come last in a cell and have neither place nor rank. Raises
    `RunError` for two records of the same seed, and for records that cannot be placed together.
    """
    _check(records)
    records = sorted(records, key=lambda record: record.seed)  # so that means add up in one order
    rows = pd.DataFrame([row for record in records for row in _rows(record)], columns=[*ROW, *SWEEP, *_FACTS])
    if rows.empty:
        return pd.DataFrame(columns=COLUMNS)
    out = rows.groupby(ROW).agg(dict.fromkeys(SWEEP, "first") | _FACTS).reset_index()
    privileged = {(r.model, r.config) for r in records if r.privileged}
    found = _statistics(scores(records) if tidy is None else tidy, privileged)
    out = out.merge(found, on=ROW, how="left", validate="one_to_one")
    if not (bare := out[out["skill"].isna()]).empty:
        raise RunError("no domain of {} was scored with every seed of {}@{}".format(*bare[ROW[-3:]].iloc[0]))
    out["skill_equal_time"] = _equal_time(out)
    for _, of in out.groupby([*GROUP, "model"]):
        out.loc[of.index, "settings"] = _apart([json.loads(one) for one in of["settings"]])
    out = out.sort_values([*GROUP, *SWEEP, "cell", "order"], ignore_index=True, kind="stable")
    return out.assign(data=out["data"].str[:8], split=out["split"].str[:8]).reindex(columns=COLUMNS)


def write(frame: pd.DataFrame, path: Path) -> None:
    """Writes the table as CSV, whole or not at all."""
    atomic_write(path, frame.to_csv(index=False, float_format="%.9g", lineterminator="\n").encode())


# How the facts of a record become those of a row, over its seeds
_FACTS = {
    "seeds": "nunique", "fit_s": "mean", "longest": "max", "parameters": "max", "family": "first", "settings": "first"
}  # fmt: skip


def _check(records: list[Record]) -> None:
    for record in records:
        if empty := [cell.id for cell in record.cells if not cell.domains]:
            raise RunError(f"{record.path(Path())} has no domain in {empty[0]}: run it again")
    times = Counter(record.path(Path()) for record in records)
    if twice := sorted(str(path) for path, count in times.items() if count > 1):
        raise RunError(f"there are several records of {twice[0]}: a seed counts once")


def _rows(record: Record) -> list[dict[str, Any]]:
    """Returns what a record says of its cells, scores apart."""
    about = record.provenance
    of_record = {
        "task": record.task,
        "task_version": record.task_version,
        "scale": record.scale,
        "data": about.data_sha256,
        "split": about.split_sha256,
        "model": record.model,
        "config": record.config,
        "seeds": record.seed,
        "parameters": record.parameters,
        "settings": json.dumps(about.hyperparameters | {f"max_{name}": most for name, most in about.budget.items()}),
        "family": json.dumps([about.plugin_sha256, about.hyperparameters, about.K, about.device], sort_keys=True),
    }
    fits: dict[tuple[int, str | None], dict[int, list[float]]] = {}
    for fit in record.fits:
        there = fits.setdefault((fit.trajectories, fit.without), {})
        there.setdefault(fit.horizon, []).append(fit.seconds)
    out = []
    for cell in record.cells:
        of_cell = {name: getattr(cell, name) for name in SWEEP} | {"without": cell.without or "", "cell": cell.id}
        there = fits.get((cell.trajectories, cell.without), {})
        # What is applied to its own predictions looks less far ahead than its cell
        seconds = there.get(cell.horizon) or [each for found in there.values() for each in found]
        out.append(of_record | of_cell | {"fit_s": sum(seconds), "longest": max(seconds, default=0.0)})
    return out


def _apart(settings: list[dict[str, Any]]) -> list[str]:
    """Returns, of the settings of each row of a model, those that are not the same in all of them, as text."""
    names = dict.fromkeys(name for one in settings for name in one)
    some = [name for name in names if any(one.get(name) != settings[0].get(name) for one in settings)]
    return [", ".join(f"{name}={one[name]}" for name in some if one.get(name) is not None) for one in settings]


def _statistics(frame: pd.DataFrame, privileged: Container[tuple[str, str]]) -> pd.DataFrame:
    """Returns the scores of each row, over the domains that all of its seeds have, and its order within its cell."""
    have = frame.groupby([*ROW, "domain"])["seed"].transform("size")
    frame = frame[have == frame.groupby(ROW)["seed"].transform("nunique")]
    cells, groups = dict[Key, dict[Key, Matrix]](), dict[Key, dict[Key, Matrix]]()
    out = dict[Key, dict[Any, Any]]()
    where: Key = ()
    try:
        for (*group, cell, model, config), one in grids(frame, SKILL, ROW).items():
            cells.setdefault((*group, cell), {})[model, config] = one
            groups.setdefault((*group,), {})[model, config, cell] = one
        for where, of in cells.items():
            for apart in (False, True):
                some = {key: one for key, one in of.items() if (key in privileged) is apart}
                for order, row in enumerate(placed(some).to_dict("records")):
                    key = (*where, row.pop("model"), row.pop("config"))
                    out[key] = row | {"order": order + apart * len(of)}
                    if apart:
                        out[key] |= {"place": math.nan, "tie": ""}
        for where, of in groups.items():
            of = {key: one for key, one in of.items() if key[:2] not in privileged}  # noqa: PLW2901
            ranking = ranked(of).set_index(["model", "config"])[["rank", "low", "high"]].to_dict("index")
            for model, config, cell in of:
                found = ranking.get((model, config), {})
                out[*where, cell, model, config] |= {f"rank_{name}": value for name, value in found.items()}
    except UsageError as error:
        raise RunError(f"no board can be made of the records of {' '.join(where[:3])}: {error}") from error
    errors = grids(frame, "mse", ROW)
    for key, each in zip(errors, intervals_of(list(errors.values())), strict=True):
        out[key] |= {"mse_m2": each.estimate, "mse_low": each.low, "mse_high": each.high, "domains": each.domains}
    names = {"estimate": "skill", "low": "skill_low", "high": "skill_high", "rank_rank": "rank"}
    values = pd.DataFrame(list(out.values())).rename(columns=names).astype({"mse_low": float, "mse_high": float})
    skills = ["skill", "skill_low", "skill_high"]
    values[skills] = values[skills].round(DIGITS) + 0.0  # -0.0 is 0
    # Student's intervals of few domains may reach where no score can be
    values["mse_low"], values["skill_high"] = values["mse_low"].clip(lower=0), values["skill_high"].clip(upper=1)
    table = pd.DataFrame(list(out), columns=ROW).astype({"task_version": int}).join(values)
    means = frame.groupby(ROW)[[name for name in MEANS if name in frame]].mean().reset_index()
    return table.merge(means.rename(columns=MEANS), on=ROW, validate="one_to_one")


def _equal_time(rows: pd.DataFrame) -> Any:
    """Returns, for each row, the skill of the same model when none of its fits may take long, NaN where none is there.

    The same model is the same plugin, hyperparameters, K and device, so that its configurations differ in their budget;
    of those all of whose fits, of all seeds, kept within `EQUAL_SECONDS` it is the one that was trained longest.
    """
    kept = rows[rows["longest"] <= LATE * rows["scale"].map(EQUAL_SECONDS)]
    family = [*GROUP, "cell", "model", "family"]
    chosen = kept.sort_values(["fit_s", "config"], kind="stable").groupby(family)["skill"].last()
    return rows[family].join(chosen, on=family)["skill"].to_numpy()
