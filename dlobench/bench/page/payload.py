"""Gathers what the page shows of records, bounded: domains by material, curves thinned, long texts cut."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dlobench.bench.record import Record
from dlobench.bench.scores import with_all

TEXT, SEEDS, CURVES, POINTS, FAILURES = 2000, 10, 4, 30, 10  # at most: characters, records and fits of a row, …
SWEEP = ["trajectories", "horizon", "K"]
GROUP = ["task", "task_version", "scale", "data", "split"]
ROW = [*GROUP, "cell", "model", "config"]
NUMBERS = [
    "place", "seeds", "skill", "skill_low", "skill_high", "mse_m2", "mse_low", "mse_high", "euclidean_m", "energy_m",
    "spacing", "overlap", "coverage90", "fit_s", "adapt_s", "predict_s", "skill_equal_time", "parameters", "domains",
    "rank", "rank_low", "rank_high", *SWEEP,
]  # fmt: skip
Key = tuple[Any, ...]


def payload(records: Sequence[Record], frame: pd.DataFrame, tidy: pd.DataFrame) -> dict[str, Any]:
    """Returns what the page holds as plain JSON, in one order: rows of the table, and the runs behind them.

    `frame` is the `leaderboard.table` of the records, `tidy` are their `scores`.
    """
    runs: dict[Key, list[Record]] = {}
    for record in sorted(records, key=lambda record: record.path(Path())):
        runs.setdefault((*_group(record), record.model, record.config), []).append(record)
    number = {key: i for i, key in enumerate(sorted(runs))}
    tidy = tidy.assign(data=tidy["data"].str[:8], split=tidy["split"].str[:8]) if len(tidy) else tidy
    materials, sweeps, calibrated = by_material(tidy), by_sweep(tidy), calibration(runs)
    labels = task_labels(frame)
    rows = []
    for one in frame.to_dict("records"):
        key: Key = tuple(one[name] for name in ROW)
        row: dict[str, Any] = {name: _number(one[name]) for name in NUMBERS}
        row |= {name: one[name] for name in ("scale", "cell", "model", "config", "settings", "tie", "without")}
        row |= {"task": labels[tuple(one[name] for name in GROUP)], "run": number[*key[:5], *key[6:]]}
        rows.append(
            row | {"materials": materials.get(key, {}), "sweeps": sweeps.get(key, {}), **calibrated.get(key, {})}
        )
    return {"rows": rows, "runs": [_run(runs[key]) for key in sorted(runs)]}


def task_labels(frame: pd.DataFrame) -> dict[Key, str]:
    """Returns a name for each task, version, data and split: the task's, and more where that is not enough."""
    keys = sorted({tuple(row) for row in frame[GROUP].itertuples(index=False)})
    out = {}
    for key in keys:
        task, version, scale, data, split = key
        others = [other for other in keys if other[0] == task and other[2] == scale]
        out[key] = task if len(others) == 1 else f"{task} v{version}, data {data}, split {split}"
    return out


def by_material(tidy: pd.DataFrame) -> dict[Key, dict[str, list[float | None]]]:
    """Returns, for each row and material, skill by MSE, MSE (m²), Euclidean error (m) and the number of domains."""
    if tidy.empty:
        return {}
    names = ["mse", "persistence_mse", "euclidean"]
    means = tidy.groupby([*ROW, "material"], sort=True)[names].mean()
    count = tidy.groupby([*ROW, "material"], sort=True)["domain"].nunique()
    out: dict[Key, dict[str, list[float | None]]] = {}
    for key, (mse, still, euclidean), domains in zip(means.index, means.to_numpy(), count, strict=True):
        skill = 1 - mse / still if still > 0 else math.nan
        found = [_number(skill), _number(mse), _number(euclidean), int(domains)]
        out.setdefault(key[:-1], {})[str(key[-1])] = found
    return out


def by_sweep(tidy: pd.DataFrame) -> dict[Key, dict[str, dict[str, float | None]]]:
    """Returns, for each row, swept column and material ("" for all), the MSE (m²) over domains with all its values.

    A model that lacks a value of the column at some other setting has no point there, so that it does not take the
    domains of all others away.
    """
    out: dict[Key, dict[str, dict[str, float | None]]] = {}
    if tidy.empty:
        return out
    for _, group in tidy.groupby(GROUP, sort=True):
        for column in SWEEP:
            values = group[column].nunique()
            if values < 2:
                continue
            others = [name for name in ["model", "config", "seed", *SWEEP] if name != column]
            full = group[group.groupby(others)[column].transform("nunique") == values]
            fair = with_all(full, column) if len(full) else full
            parts = [(fair.groupby(ROW)["mse"].mean(), False), (fair.groupby([*ROW, "material"])["mse"].mean(), True)]
            for means, split in parts:
                for key, mse in means.items():
                    row, material = (key[:-1], key[-1]) if split else (key, "")  # type: ignore[index]
                    out.setdefault(row, {}).setdefault(column, {})[str(material)] = _number(mse)  # type: ignore[arg-type]
    return out


def calibration(runs: Mapping[Key, Sequence[Record]]) -> dict[Key, dict[str, Any]]:
    """Returns coverage at 50 and 90 %, means over domains and seeds, and summed ranks of rows that have samples."""
    levels: dict[Key, list[tuple[float, float]]] = {}
    ranks: dict[Key, list[list[int]]] = {}
    for key, of in runs.items():
        for record in of:
            for cell in record.cells:
                row = (*key[:5], cell.id, *key[5:])
                for score in cell.domains:
                    if score.coverage50 is not None and score.coverage90 is not None:
                        levels.setdefault(row, []).append((score.coverage50, score.coverage90))
                    if score.ranks:
                        ranks.setdefault(row, []).append(score.ranks)
    out: dict[Key, dict[str, Any]] = {
        row: {"coverage": [_number(each) for each in np.mean(found, axis=0)]} for row, found in levels.items()
    }
    for row, histograms in ranks.items():
        if len({len(each) for each in histograms}) == 1:
            out.setdefault(row, {})["ranks"] = np.sum(histograms, axis=0).tolist()
    return out


def _group(record: Record) -> Key:
    about = record.provenance
    return (record.task, record.task_version, record.scale, about.data_sha256[:8], about.split_sha256[:8])


def _run(records: Sequence[Record]) -> dict[str, Any]:
    """Returns what the records of one configuration, its seeds, say of themselves."""
    first = records[0].provenance
    failures = [(record.seed, failure) for record in records for failure in record.failures]
    fits = [(record.seed, fit) for record in records[:SEEDS] for fit in record.fits if fit.curve][:CURVES]
    changed = {True: ", with changes", False: "", None: ""}[first.dirty]
    about = {
        "Created": first.created,
        "Commit": f"{first.commit or 'unknown'}{changed}",
        "Device": first.device,
        "Processor": first.cpu.get("model", "unknown"),
        "Data set": first.set,
        "Data digest": first.data_sha256,
        "Split digest": first.split_sha256,
        "Plugin digest": first.plugin_sha256,
        "Versions": ", ".join(f"{name} {value}" for name, value in sorted(first.versions.items())),
        "Budget": ", ".join(f"{name} {value}" for name, value in first.budget.items() if value is not None)
        or "the task's",
        "Protection": ", ".join(first.protection) or "not recorded",
        "Run time (s)": ", ".join(f"{record.seconds:.4g}" for record in records[:SEEDS]),
    }
    return {
        "commands": [[record.seed, _cut(record.provenance.command)] for record in records[:SEEDS]],
        "records": len(records),
        "about": [[name, _cut(str(value))] for name, value in about.items()],
        "hyperparameters": [
            [_cut(name), _cut(json.dumps(value, sort_keys=True, ensure_ascii=False))]
            for name, value in sorted(first.hyperparameters.items())[:100]
        ],
        "failed": len(failures),
        "failures": [[seed, _place(each), _cut(each.error)] for seed, each in failures[:FAILURES]],
        "curves": [[f"seed {seed}, {_place(fit)}", thinned(fit.curve)] for seed, fit in fits],
    }


def _place(fit: Any) -> str:
    where = f", {fit.domain}" if fit.domain else ""
    return f"{fit.trajectories} trajectories, horizon {fit.horizon}{where}"


def thinned(curve: Sequence[Mapping[str, float]]) -> dict[str, list[list[float | None]]]:
    """Returns at most 30 points of a curve, first and last among them, as [step, value] by what was logged."""
    out: dict[str, list[list[float | None]]] = {}
    for i in _spread(len(curve)):
        for name, value in sorted(curve[i].items()):
            if name != "step" and (name in out or len(out) < 6):
                out.setdefault(_cut(name), []).append([_number(curve[i].get("step", i)), _number(value)])
    return out


def _spread(count: int) -> Iterable[int]:
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, POINTS)).round()})


def _cut(text: str) -> str:
    return text if len(text) <= TEXT else f"{text[:TEXT]} … ({len(text) - TEXT} more characters)"


def _number(value: Any) -> float | int | None:
    """Returns a number of six digits, None of one that is not finite: JSON knows none."""
    if value is None or not math.isfinite(value):
        return None
    return int(value) if float(value).is_integer() else float(f"{value:.6g}")
