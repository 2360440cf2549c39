"""Tests the plan of `make small`: it names what exists, says what it costs, and makes nothing twice."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

from dlobench.bench.plugins import find, load_model, load_task, parse_settings
from dlobench.bench.results import read_all
from dlobench.errors import RunError

FILE = Path(__file__).parent.parent / "leaderboard" / "small.py"


def load() -> Any:
    """Returns the script as a module: `leaderboard` is no package."""
    spec = importlib.util.spec_from_file_location("small", FILE)
    assert spec is not None and spec.loader is not None
    module = sys.modules["small"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


small = load()


def test_every_run_is_one_that_can_be_made() -> None:
    for run in small.PLAN:
        assert run.model in find("models") and run.task in find("tasks")
        settings = [f"{name}={value}" for name, value in run.settings.items()]
        assert parse_settings(load_model(run.model).model, settings) == run.settings
        assert load_task(run.task).small is not None
        assert len(set(run.seeds)) == len(run.seeds) >= 1


def test_nothing_adapts_where_every_domain_is_fitted_apart() -> None:
    apart = {run.model for run in small.PLAN if load_task(run.task).apart}
    assert apart and not apart & set(small.ADAPTING)


def test_all_of_it_takes_ten_hours_on_two_cores() -> None:
    assert sum(small.hours(run) * len(run.seeds) for run in small.PLAN) / 2 < 10


def test_the_page_tells_the_plan() -> None:
    page = small.PAGE.read_text()
    assert small.written(page) == page, "python leaderboard/small.py --table"


@pytest.mark.parametrize("mark", ["BEGIN", "END"])
def test_a_page_that_lost_a_mark_is_not_written(mark: str) -> None:
    broken = small.PAGE.read_text().replace(getattr(small, mark), "")
    with pytest.raises(RunError, match="lacks the mark"):
        small.written(broken)


def test_what_is_recorded_is_not_made_again(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [r for r in read_all(small.RESULTS) if r.task == "meta" and r.model == "gnn" and r.scale == "mini"]
    told: list[Any] = [r.model_copy(update={"scale": "small"}) for r in found]
    monkeypatch.setattr(small, "read_all", lambda results: told)
    wanted = [(run.model, seed) for run, seed in small.pending([small.Run("meta", "gnn", seeds=(0, 1, 2, 7))])]
    assert wanted == [("gnn", 7)]
    other = small.Run("meta", "gnn", seeds=(0,), settings={"width": 64})
    assert list(small.pending([other])) == [(other, 0)], "another hyperparameter is another run"
    earlier = [r.provenance.model_copy(update={"hyperparameters": {"width": 32}}) for r in told]
    told[:] = [r.model_copy(update={"provenance": about}) for r, about in zip(told, earlier, strict=True)]
    assert not list(small.pending([small.Run("meta", "gnn", seeds=(0,))])), "the others came later"
    assert list(small.pending([other])) == [(other, 0)]
    limited = small.Run("meta", "gnn", seeds=(0,), minutes=1.0)
    assert list(small.pending([limited])) == [(limited, 0)], "another budget is another run"
    cut = small.Run("meta", "gnn", seeds=(0,), steps=800)
    assert list(small.pending([cut])) == [(cut, 0)]
    budget = {"steps": 800, "minutes": None}
    told[:] = [r.model_copy(update={"provenance": r.provenance.model_copy(update={"budget": budget})}) for r in told]
    assert not list(small.pending([cut]))


def test_the_limits_of_a_run_are_those_of_its_command() -> None:
    cut = small.command(small.Run("rollout", "gnn", steps=800), 0)
    assert cut[cut.index("--max-steps") + 1] == "800" and "--max-minutes" not in cut
    timed = small.command(small.Run("rollout", "gnn", minutes=0.5), 0)
    assert timed[timed.index("--max-minutes") + 1] == "0.5" and "--max-steps" not in timed


def test_a_run_that_fails_is_told_and_fails_the_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(small, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(small, "PLAN", (small.Run("meta", "maml", seeds=(0,), settings={"width": -1}),))
    monkeypatch.setattr(small, "command", lambda run, seed: ["false"])
    monkeypatch.setattr("sys.argv", ["small.py", "--jobs", "1"])
    assert small.main() == 1
    said = capsys.readouterr().out
    assert "1 runs are missing" in said and "failed, see" in said


def test_runs_that_differ_in_their_settings_have_logs_of_their_own() -> None:
    names = [(run.task, run.name) for run in small.PLAN]
    assert len(set(names)) == len(names)
