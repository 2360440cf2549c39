"""Tests fits that are spread over a real Ray: the same numbers as here, failures by their name, nothing made twice."""

from __future__ import annotations

from pathlib import Path

import pytest
from test_journal import TASK as TOY
from test_journal import Quiet, data  # noqa: F401  # the latter is a fixture

from dlobench.bench import results
from dlobench.bench import run as bench
from dlobench.bench.limits import Limits
from dlobench.bench.order import Order, order
from dlobench.bench.record import CellScore, Record
from dlobench.bench.run import Fitting, one_by_one
from dlobench.bench.sandbox import Sandbox
from dlobench.bench.spread import spread
from dlobench.data.executors import find_executor
from dlobench.data.store import Store
from dlobench.errors import RunError

PLUGIN = '''
"""Moves everything by a number that it draws, prints, and fails or dies where it is told to."""
from dataclasses import dataclass
import os
import numpy as np
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Drawn(Model):
    raises_at: int = 0
    dies_at: int = 0

    def fit(self, train, valid, setting):
        print("fitting", setting.horizon)
        if setting.horizon == self.raises_at:
            raise ValueError("as told")
        if setting.horizon == self.dies_at:
            os._exit(3)
        self.offset = np.random.default_rng([self.seed, len(train[0])]).normal(scale=0.001, size=2)

    def predict(self, query, samples):
        return Prediction(dlo=(query.dlo[..., :2] + self.offset)[None])
'''


def run(store: Store, folder: Path, out: str, fitting: Fitting, *, keep_going: bool = False, **settings: int) -> Record:
    """Runs the plugin on the toy task."""
    path = folder / "drawn.py"
    path.write_text(PLUGIN)
    with Sandbox() as sandbox:
        wanted: Order = order(TOY, "mini", sandbox.load(str(path)), None, None, settings=settings, seed=5)
        return bench.run(
            wanted,
            store,
            folder / out,
            command="dlobench run",
            executor=find_executor("local", workers=1),
            reporter=Quiet(),
            fitting=fitting,
            keep_going=keep_going,
        )


@pytest.fixture
def over_ray(ray_address: str) -> Fitting:
    """Returns what makes fits on the tests' Ray."""
    return spread(find_executor("ray", address=ray_address), Limits(), threads=1)


def untimed(record: Record) -> list[CellScore]:
    """Returns the cells without what clocks say."""
    return [
        cell.model_copy(
            update={
                "domains": [d.model_copy(update={"adapt_seconds": 0, "predict_seconds": 0}) for d in cell.domains],
            }
        )
        for cell in record.cells
    ]


def test_ray_makes_the_same_numbers(data: Store, over_ray: Fitting, tmp_path: Path) -> None:  # noqa: F811
    here, there = (run(data, tmp_path, name, how) for name, how in (("here", one_by_one), ("there", over_ray)))
    assert untimed(here) == untimed(there)
    assert here.config == there.config
    files = [
        {path.relative_to(tmp_path / name): path.read_bytes() for path in (tmp_path / name).rglob("*.safetensors")}
        for name in ("here", "there")
    ]
    assert files[0] == files[1], "predictions and weights, to the last bit"
    assert len(files[0]) == 1 + len(here.fits)


@pytest.mark.parametrize(("settings", "why"), [({"raises_at": 3}, "as told"), ({"dies_at": 3}, "exit code 3")])
def test_a_fit_that_fails_there_is_named_and_the_others_go_on(
    data: Store,  # noqa: F811
    over_ray: Fitting,
    tmp_path: Path,
    settings: dict[str, int],
    why: str,
) -> None:
    record = run(data, tmp_path, "out", over_ray, keep_going=True, **settings)
    assert {failure.horizon for failure in record.failures} == {3}
    assert all(why in failure.error for failure in record.failures)
    assert {cell.horizon for cell in record.cells} == {1}
    with pytest.raises(RunError, match=why):
        run(data, tmp_path, "other", over_ray, keep_going=False, **settings)


def test_what_is_finished_is_not_made_again(data: Store, over_ray: Fitting, tmp_path: Path) -> None:  # noqa: F811
    first = run(data, tmp_path, "out", over_ray, keep_going=True, raises_at=3)
    (path,) = results.paths(tmp_path / "out")
    made = {(fit.trajectories, fit.horizon, fit.domain): fit.seconds for fit in first.fits}
    again = run(data, tmp_path, "out", one_by_one, keep_going=True, raises_at=3)
    assert {(fit.trajectories, fit.horizon, fit.domain): fit.seconds for fit in again.fits} == made
    assert results.read(path, tmp_path / "out") == again
