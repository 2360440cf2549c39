"""Decides the paper's five findings from records: each statistic, its interval and what follows, as a table."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pandas as pd
from drawing import main
from recorded import Recorded, choose, everything, log_errors, markdown, read, scored

from dlobench.bench.matrix import difference
from dlobench.bench.statistics import Interval
from dlobench.errors import RunError, UsageError

SWEPT = ("mlp", "gnn")  # models that the first three findings are asked of
ADAPT = ("maml", "finetune", "neural_process", "gnn_context")


@dataclass(frozen=True)
class Answer:
    """Holds one statistic of a finding, and whether it is above 0, or 1, as the paper has it."""

    finding: str
    statistic: str
    found: Interval
    unit: str  # "×" for a ratio, which is held against 1
    decides: bool = True  # whether it is what the paper says, or only what our scale can say of it

    @property
    def verdict(self) -> str:
        """Returns confirmed, contradicted or undecided."""
        low, high, level = self.found.low, self.found.high, 1.0 if self.unit == "×" else 0.0
        if low is None or high is None or low <= level <= high or not self.decides:
            return "undecided"
        return "confirmed" if low > level else "contradicted"


def ratio(a: pd.DataFrame, b: pd.DataFrame) -> Interval:
    """Returns how many times the error of b that of a is: the geometric mean over domains, paired."""
    one, other = (log_errors(frame) for frame in (a, b))
    found = (one - other).interval()
    low, high = (None if end is None else float(np.exp(end)) for end in (found.low, found.high))
    return Interval(float(np.exp(found.estimate)), low, high, found.domains, found.seeds)


def of_horizon(sweep: Recorded) -> Iterator[Answer]:
    """Yields how the error grows from the shortest to the longest horizon, at the size that all domains have."""
    for name in (name for name in SWEPT if name in sweep.names):
        rows = sweep.where(name=name, trajectories=shared_size(sweep)).frame
        near, far = rows["horizon"].min(), rows["horizon"].max()
        found = ratio(rows[rows["horizon"] == far], rows[rows["horizon"] == near])
        yield Answer("1. The error grows with the horizon", f"{name}: error at n = {far} ÷ at n = {near}", found, "×")


def of_data(sweep: Recorded) -> Iterator[Answer]:
    """Yields what each tenfold of training pushes brings at n = 1; the paper's step from 10⁵ to 10⁶ decides."""
    for name in (name for name in SWEPT if name in sweep.names):
        rows = sweep.where(name=name, horizon=1).frame
        sizes = sorted(rows["pushes"].unique())
        for few, many in pairwise(sizes):
            both = set(rows[rows["pushes"] == many]["domain"])
            there = rows[rows["domain"].isin(both)]
            found = ratio(there[there["pushes"] == few], there[there["pushes"] == many])
            text = f"{name}, n = 1: error at {few:,} pushes ÷ at {many:,}"
            yield Answer("2. From 10⁵ to 10⁶ pushes still helps", text, found, "×", decides=many >= 1_000_000)


def of_material(sweep: Recorded) -> Iterator[Answer]:
    """Yields how much harder flexible is than the others, and by how much more its error varies within a domain.

    Both over attachments, bodies and horizons.
    """
    for name in (name for name in SWEPT if name in sweep.names):
        rows = sweep.where(name=name, trajectories=shared_size(sweep)).frame
        spreads = rows.assign(euclidean=spread(rows))
        whats = ("error", rows), ("standard deviation of the error", spreads)
        for (what, scores), other in product(whats, ("soft", "elastoplastic")):
            found = ratio(*(typical(scores[rows["material"] == material]) for material in ("flexible", other)))
            text = f"{name}: {what} of flexible ÷ of {other}, mean over horizons"
            if uneven := not even(sweep, rows, "flexible", other):
                text += ", fitted with unequal steps"
            yield Answer("3. Flexible is the hardest material", text, found, "×", decides=not uneven)


def spread(rows: pd.DataFrame) -> pd.Series[float]:
    """Returns the standard deviation, m, of the distance by which segments are missed, over segments and windows.

    The mean squared error is per coordinate, so twice that is the mean square of the distance.
    """
    out: pd.Series[float] = (2 * rows["mse"] - rows["euclidean"] ** 2) ** 0.5
    return out


def even(sweep: Recorded, rows: pd.DataFrame, *materials: str) -> bool:
    """Tells whether fits that the clock may have ended took as many steps in these materials, within a quarter.

    Rows are of one model and size. Where a machine had other work meanwhile they did not, and errors tell of that.
    """
    domains = {material: set(rows[rows["material"] == material]["domain"]) for material in materials}
    sizes, configs = set(rows["trajectories"]), set(rows["config"])
    medians: list[float] = []
    for material in materials:
        steps = [
            fit.curve[-1]["step"]
            for record in sweep.records
            if record.config in configs and record.provenance.budget["minutes"] is not None
            for fit in record.fits
            if fit.domain in domains[material] and fit.trajectories in sizes and fit.curve
        ]
        medians += [float(np.median(steps))] if steps else []
    return not medians or max(medians) <= 1.25 * min(medians)


def typical(rows: pd.DataFrame) -> pd.DataFrame:
    """Returns a row a seed and a pair of attachment and bodies, named by it: the geometric mean over horizons."""
    rows = rows.assign(domain=rows["attachment"] + "-" + rows["objects"], euclidean=np.log(rows["euclidean"]))
    mean = rows.groupby(["seed", "domain"], as_index=False)["euclidean"].mean()
    out: pd.DataFrame = mean.assign(euclidean=np.exp(mean["euclidean"]), cell="horizons")
    return out


def of_learning(meta: Recorded, *, raced: str = "") -> Iterator[Answer]:
    """Yields what MAML is better by than the model that never adapts, at every K from 1.

    What was `raced` decides nothing: no clock ended the paper's fits.
    """
    for other in ("multitask", "finetune"):
        if not {"maml", other} <= set(meta.names):
            continue
        for K in sorted(set(meta.frame["K"]) - {0}):
            of = meta.where(K=K)
            found = difference(of.where(name=other).frame, of.where(name="maml").frame, "mse")
            text = f"MSE of {other} less that of maml, K = {K}, 10⁻⁴ m²{raced}"
            decides = other == "multitask" and not raced
            yield Answer("4. MAML beats multi-task on unseen domains", text, found, "10⁻⁴ m²", decides=decides)


def of_race(results: Path) -> Iterator[Answer]:
    """Yields the same of fits that nothing but the clock ended, so that each model had the same wall time."""
    timed = [one for one in everything(results) if one.provenance.budget["minutes"] is not None and one.task == "meta"]
    if timed:
        meta = scored(choose(timed, "meta"))
        minutes = " or ".join(sorted({f"{one.provenance.budget['minutes']:g}" for one in meta.records}))
        yield from of_learning(meta, raced=f", fits of {minutes} minutes")


def of_support(meta: Recorded) -> Iterator[Answer]:
    """Yields what more support trajectories bring, from one K to the next."""
    for name in (name for name in ADAPT if name in meta.names):
        rows = meta.where(name=name).frame
        sizes = sorted(rows["K"].unique())
        for few, many in pairwise(sizes):
            found = difference(rows[rows["K"] == few], rows[rows["K"] == many], "mse")
            text = f"{name}: MSE at K = {few} less that at K = {many}, 10⁻⁴ m²"
            yield Answer("5. More support helps", text, found, "10⁻⁴ m²", decides=few > 0)


def shared_size(sweep: Recorded) -> int:
    """Returns the largest number of training trajectories that every domain has."""
    counts = sweep.frame.groupby("trajectories")["domain"].nunique()
    return int(counts.index[counts == counts.max()].max())


def told(answer: Answer) -> str:
    """Returns an estimate and its interval as text."""
    unit = 1.0 if answer.unit == "×" else 1e4
    found = answer.found
    text = f"{unit * found.estimate:.2f}"
    if found.low is None or found.high is None:
        return text
    return f"{text} ({unit * found.low:.2f} to {unit * found.high:.2f})"


def answers(results: Path) -> tuple[list[Answer], list[str]]:
    """Returns all answers that records give, and the footnotes of the tasks that they come from.

    Raises `RunError` that says what to run where there is neither a sweep nor a task of adaptation.
    """
    found: list[Answer] = []
    notes: list[str] = []
    missing: list[RunError] = []
    for task, questions in {
        "horizon_sweep": (of_horizon, of_data, of_material),
        "meta": (of_learning, of_support),
    }.items():
        try:
            of = read(results, task)
        except RunError as error:
            missing.append(error)
            continue
        of = of if task == "horizon_sweep" else of.where(trajectories=of.frame["trajectories"].max())
        found += [answer for question in questions for answer in question(of)]
        notes.append(of.footnote())
    found = sorted([*found, *of_race(results)], key=lambda answer: answer.finding)
    if not found:
        raise missing[0] if missing else UsageError("the records hold none of the models that the findings are about")
    return found, notes


def draw(results: Path, out: Path) -> None:
    """Writes findings.md."""
    found, notes = answers(results)
    rows = [["finding", "statistic", "estimate (95 %)", "domains", "seeds", "verdict"]]
    for one in found:
        verdict = one.verdict if one.decides else "(decides nothing)"
        many = [str(one.found.domains), str(one.found.seeds)]
        rows.append([one.finding, one.statistic, told(one), *many, verdict])
    markdown(out / "findings.md", rows, "; ".join(notes) + ".")


if __name__ == "__main__":
    sys.exit(main(draw))
