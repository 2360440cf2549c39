"""Tests runs of many fits: each is kept as it finishes, a killed run goes on, a fit that fails is named."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from test_store import write

from dlobench.bench import results
from dlobench.bench import run as bench
from dlobench.bench.journal import Finished, Journal
from dlobench.bench.kept import Kept
from dlobench.bench.order import Order, order
from dlobench.bench.plugins import load_model, load_task
from dlobench.bench.record import FitReport, Record
from dlobench.bench.task import Scale, Task
from dlobench.data.domain_set import PARTS
from dlobench.data.executors import find_executor
from dlobench.data.sets import SETS
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Listener

LARGE = SETS["single-domain-large"]
TASK = Task(
    name="toy", version=1, set=LARGE.name, apart=True, horizon=(1, 3),
    where={"material": ("soft", "flexible"), "attachment": "none", "rigid_objects": 0},
    mini=Scale(trajectories=(7, 50), support=0, query=20, K=(0,)),
    small=Scale(trajectories=(500, 5_000), support=0, query=50, K=(0,)),
    paper=Scale(trajectories=(50,), support=0, query=50, K=(0,)),
)  # fmt: skip
PLUGIN = '''
"""Stands still, counts its fits in a file, and fails where it is told to."""
from dataclasses import dataclass
from pathlib import Path
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Counting(Model):
    log: str = ""
    fail: int = -1

    def fit(self, train, valid, setting):
        with open(self.log, "a") as file:
            file.write(f"{setting.horizon} {len(train)} {len(train[0])} {len(valid[0])}\\n")
        if len(Path(self.log).read_text().splitlines()) == self.fail:
            raise ValueError("as told")

    def predict(self, query, samples):
        return Prediction(dlo=query.dlo[None, ..., :2].copy())
'''


@dataclass
class Quiet:
    """Tells nobody how a run goes, and can be made to end it."""

    said: ClassVar[list[str]] = []

    def say(self, text: str) -> None:
        self.said.append(text)

    @contextmanager
    def bar(self, title: str, unit: str) -> Iterator[Listener]:
        yield lambda done, total, values: None


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """Returns random walks in the two domains of the toy task."""
    store = Store(tmp_path_factory.mktemp("data"))
    spans = TASK.spans("mini")
    for unit in LARGE.units(span for part in PARTS for span in spans[part]):
        write(store, LARGE, unit)
    return store


def ordered(folder: Path, fail: int = -1) -> Order:
    """Orders a run of the counting model."""
    folder.mkdir(exist_ok=True)
    plugin = folder / "counting.py"
    plugin.write_text(PLUGIN)
    settings = {"log": str(folder / "fits"), "fail": fail}
    return order(TASK, "mini", load_model(str(plugin)), None, None, settings=settings)


def run(wanted: Order, store: Store, out: Path, **how: Any) -> Record:
    """Runs an order."""
    executor = find_executor("local", workers=1)
    return bench.run(wanted, store, out, command="dlobench run", executor=executor, reporter=Quiet(), **how)


def fits(folder: Path) -> list[list[int]]:
    """Returns what each call of `fit` was given: horizon, domains, training and validation trajectories."""
    return [[int(word) for word in line.split()] for line in (folder / "fits").read_text().splitlines()]


def test_every_domain_has_fits_of_its_own_and_cells_join_them(data: Store, tmp_path: Path) -> None:
    record = run(ordered(tmp_path), data, tmp_path / "out")
    assert fits(tmp_path) == [[n, 1, size, 10] for _ in range(2) for size in (7, 50) for n in (1, 3)]
    assert [cell.id for cell in record.cells] == [f"toy/trajectories{t}-h{n}" for t in (7, 50) for n in (1, 3)]
    domains = [f"{LARGE.name}/{span.domain:05d}" for span in TASK.spans("mini")["test"]]
    for cell in record.cells:
        assert [score.domain for score in cell.domains] == domains
        assert {score.windows for score in cell.domains} == {20 * (20 - cell.horizon + 1)}
        assert abs(cell.skill) < 1e-12
    assert [fit.domain for fit in record.fits] == [name for name in domains for _ in range(4)]
    assert not list((tmp_path / "out").rglob(".*")), "the journal goes when the record is there"


def test_a_run_that_ended_early_goes_on_with_the_next_fit(data: Store, tmp_path: Path) -> None:
    wanted, out = ordered(tmp_path, fail=4), tmp_path / "out"
    with pytest.raises(RunError, match="ValueError"):
        run(wanted, data, out)
    assert len(fits(tmp_path)) == 4
    assert results.read_all(out) == [], "what is not finished is no record"
    (journal,) = out.rglob("fits.jsonl")
    journal.write_bytes(journal.read_bytes() + b'{"fit": {"trajec')  # as a kill in the middle of a write leaves it
    record = run(wanted, data, out)
    assert len(fits(tmp_path)) == 4 + 5, "three of eight were finished"
    assert len(record.fits) == 8 and len(record.cells) == 4 and not record.failures
    whole = run(ordered(tmp_path / "undisturbed"), data, tmp_path / "other")
    assert [cell.mse for cell in record.cells] == [cell.mse for cell in whole.cells]


def test_going_on_names_what_failed_and_a_second_run_mends_it(data: Store, tmp_path: Path) -> None:
    wanted, out = ordered(tmp_path, fail=4), tmp_path / "out"
    record = run(wanted, data, out, keep_going=True)
    ((failure,), found) = record.failures, [cell.id for cell in record.cells]
    assert (failure.trajectories, failure.horizon, failure.domain) == (50, 3, f"{LARGE.name}/00000")
    assert "as told" in failure.error
    assert found == ["toy/trajectories7-h1", "toy/trajectories7-h3", "toy/trajectories50-h1"], "no cell lacks a domain"
    assert results.read_all(out) == [record]
    again = run(wanted, data, out, keep_going=True)
    assert len(fits(tmp_path)) == 8 + 1
    assert len(again.cells) == 4 and not again.failures


def test_a_run_of_which_all_fails_leaves_no_record(data: Store, tmp_path: Path) -> None:
    wanted = ordered(tmp_path)
    broken = replace(wanted, settings={"log": str(tmp_path / "absent" / "fits")})
    with pytest.raises(RunError, match=r"no cell of toy was finished; the last failure: .*FileNotFoundError"):
        run(broken, data, tmp_path / "out", keep_going=True)
    assert results.read_all(tmp_path / "out") == []


def test_forcing_forgets_what_was_finished(data: Store, tmp_path: Path) -> None:
    wanted, out = ordered(tmp_path, fail=2), tmp_path / "out"
    with pytest.raises(RunError):
        run(wanted, data, out)
    run(wanted, data, out, force=True)
    assert len(fits(tmp_path)) == 2 + 8


def finished(horizon: int) -> Finished:
    """Makes an entry."""
    return Finished(
        fit=FitReport(trajectories=1, horizon=horizon, seconds=1.0, curve=[]), parameters=3, seconds=2.0, scores=[]
    )


def kept(horizon: int) -> Kept:
    """Makes two windows."""
    rng = np.random.default_rng(horizon)
    mask = np.arange(32) < 20
    dlo = np.where(mask[:, None], rng.normal(size=(1, 2, 32, 2)), 0).astype(np.float32)
    return Kept(f"toy/h{horizon}", "toy/00001", np.array([3, 9], np.int32), mask, dlo[0] + mask[:, None], dlo * 2, dlo)


def test_a_cut_line_is_written_over_and_an_odd_one_is_refused(tmp_path: Path) -> None:
    journal = Journal.beside(tmp_path / "new" / "seed7.json")
    assert journal.read() == {}
    for horizon in (1, 2):
        journal.append(finished(horizon), f"h{horizon}", [kept(horizon)])
    assert journal.folder.name == ".seed7"
    whole = journal.path.read_bytes()
    journal.path.write_bytes(whole[:-9])
    assert list(journal.read()) == [(1, 1, None, None)]
    journal.append(finished(2), "h2", [kept(2)])
    assert journal.path.read_bytes() == whole
    journal.path.write_bytes(b"odd\n" + whole)
    with pytest.raises(RunError, match=r"line 1 of .*fits.jsonl is no finished fit; remove the file"):
        journal.read()
    journal.remove()
    journal.remove()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (
            {"set": "meta-learning", "where": {}},
            "apart needs domains that have all parts, those of meta-learning have one",
        ),
        ({"mini": Scale(trajectories=(51,), support=0, query=20, K=(0,))}, "trajectories = 51"),
        ({"mini": Scale(trajectories=(50,), support=0, query=21, K=(0,))}, "query = 21"),
    ],
)
def test_apart_needs_what_its_domains_have(change: dict[str, object], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        replace(TASK, **change).check("mini")  # type: ignore[arg-type]


def test_sizes_that_only_some_domains_have_are_fitted_there() -> None:
    task = replace(TASK, where={"material": "soft", "rigid_objects": 0})
    sizes = [(fit.domain, fit.trajectories) for fit in task.fits("small") if fit.horizon == 1]
    assert sizes == [(0, 500), (0, 5_000), (2, 500), (4, 500)]
    assert [task.cell_id(fit, 0) for fit in task.fits("small")[:2]] == [
        "toy/trajectories500-h1",
        "toy/trajectories500-h3",
    ]


def test_the_sweeps_of_the_paper_are_there() -> None:
    sweep = load_task("horizon_sweep")
    assert (len(sweep.fits("mini")), len(sweep.fits("small"))) == (18 * 4, (18 * 2 + 3) * 4)
    assert {fit.trajectories * 20 for fit in sweep.fits("paper")} == {10**3, 10**4, 10**5, 10**6}
    assert len(load_task("length_sweep").fits("mini")) == 27 * 4
    assert {fit.horizon for fit in load_task("single_domain").fits("paper")} == {1}
