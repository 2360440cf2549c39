"""Tests the board's page in headless Chromium: sorting, filters, records, hostile texts, no request, no message."""

from __future__ import annotations

import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_results import record
from typer.testing import CliRunner

from dlobench.bench import leaderboard
from dlobench.bench.page import build
from dlobench.bench.page.payload import payload, thinned
from dlobench.bench.page.rollout import Windows, rollout
from dlobench.bench.record import Failure, Record
from dlobench.bench.results import write
from dlobench.bench.scores import scores
from dlobench.cli import app
from dlobench.errors import UsageError

pytest.importorskip("itables", reason="itables is not installed: pip install 'dlobench[page]'")
pytest.importorskip("vl_convert", reason="vl-convert is not installed: pip install 'dlobench[page]'")

MATERIALS = ["soft", "flexible", "elastoplastic"]
EVIL = "dlobench run </script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>"


def swept(model: str, share: float, *, seed: int = 0, task: str = "meta", scale: str = "mini") -> Record:
    """Makes a record of two sizes, two horizons and three K, on six domains of three materials, with samples."""
    rng = np.random.default_rng(int(100 * share) + seed)
    base = record(model=model, seed=seed)
    like, cells = base.cells[0].domains[0], []
    for size, horizon, K in [(s, h, k) for s in (20, 60) for h in (1, 4) for k in (0, 1, 10)]:
        errors = 4e-4 * share * horizon**0.5 * (1 + 1 / (1 + K)) * np.exp(0.1 * rng.normal(size=6))
        domains = [
            like.model_copy(
                update={
                    "domain": f"meta-learning/{i:05d}", "cell": f"{MATERIALS[i % 3]}-none-16cm-0", "mse": float(e),
                    "coverage50": 0.4, "coverage90": 0.8, "ranks": [10, 12, 9, 11],
                }
            )
            for i, e in enumerate(errors)
        ]  # fmt: skip
        cell = {"id": f"{task}/trajectories{size}-h{horizon}-k{K}", "trajectories": size, "horizon": horizon, "K": K}
        cells.append(base.cells[0].model_copy(update=cell | {"domains": domains}))
    curve = [{"step": float(i), "train": 1 / (1 + i)} for i in range(100)]
    fits = [
        base.fits[0].model_copy(update={"trajectories": s, "horizon": h, "curve": curve})
        for s in (20, 60)
        for h in (1, 4)
    ]
    return base.model_copy(update={"task": task, "scale": scale, "cells": cells, "fits": fits})


def told(one: Record, command: str) -> Record:
    """Returns a record with another command."""
    return one.model_copy(update={"provenance": one.provenance.model_copy(update={"command": command})})


def some() -> list[Record]:
    """Makes records of three models, two tasks and two scales."""
    out = [swept(model, share) for model, share in (("maml", 0.2), ("mlp", 0.5), ("persistence", 1.0))]
    out += [swept("maml", 0.4, task="rollout"), swept("mlp", 0.6, scale="small")]
    out[0] = told(out[0], "dlobench run --task meta --model maml --seed 0")
    return out


def page_of(records: list[Record], **more: Any) -> bytes:
    return build(records, leaderboard.table(records), **more)


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Starts the system's Chromium."""
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install 'dlobench[test]'")
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        pytest.skip("there is no chromium on the path: apt-get install chromium")
    with api.sync_playwright() as play:
        found = play.chromium.launch(executable_path=path, args=["--no-sandbox"])
        yield found
        found.close()


class Seen:
    """Holds an open page, and whatever it said or asked for."""

    def __init__(self, browser: Any, path: Path, width: int = 1280) -> None:
        self.page = browser.new_page(viewport={"width": width, "height": 900})
        self.said: list[str] = []
        self.asked: list[str] = []
        self.page.on("console", lambda message: self.said.append(message.text))
        self.page.on("pageerror", lambda error: self.said.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(path.as_uri())
        self.page.wait_for_selector("body[data-ready]", state="attached", timeout=20_000)
        self.own = path.as_uri()

    def column(self, title: str) -> list[str]:
        """Returns the cells of the column of a title, from top to bottom."""
        heads = [head.strip() for head in self.page.locator("#table thead th").all_inner_texts()]
        n = next(i for i, head in enumerate(heads) if head.startswith(title)) + 1
        return [t.strip() for t in self.page.locator(f"#table tbody tr > :nth-child({n})").all_inner_texts()]

    def close(self) -> None:
        """Closes the page, of which nothing was to be heard."""
        self.page.wait_for_timeout(200)
        assert self.said == []
        assert set(self.asked) <= {self.own, "data:,"}
        self.page.close()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "index.html"
    path.write_bytes(page_of(some()))
    return path


def test_a_header_sorts_by_mouse_and_by_keyboard(browser: Any, file: Path) -> None:
    seen = Seen(browser, file)
    head = seen.page.locator("#table thead th", has_text="Error (mm)")
    head.click()
    seen.page.wait_for_selector(
        "#table thead th[aria-sort]:has-text('Error (mm)')", timeout=5000
    )  # sorted a moment later
    assert head.count() == 1
    skill = seen.page.locator("#table thead th", has_text="Skill").first
    skill.locator("[tabindex='0']").first.focus()
    for order in (1, -1):
        seen.page.keyboard.press("Enter")
        name = {1: "ascending", -1: "descending"}[order]
        seen.page.wait_for_selector(f"#table thead th[aria-sort={name}]:has-text('Skill')", timeout=5000)
        values = [float(each.split()[0]) for each in seen.column("Skill")]
        assert len(set(values)) > 5
        assert values == sorted(values, reverse=order < 0)
    seen.close()


def test_filters_by_task_scale_material_and_words(browser: Any, file: Path) -> None:
    seen = Seen(browser, file)
    page = seen.page
    assert len(seen.column("Model")) == 36
    page.select_option("#cell", "meta/trajectories20-h4-k10")
    assert [each.split()[0] for each in seen.column("Model")] == ["maml", "mlp", "persistence"]
    before = seen.column("Skill")
    page.select_option("#material", "soft")
    found = payload(some(), leaderboard.table(some()), scores(some()))["rows"]
    (row,) = [r for r in found if (r["model"], r["cell"], r["scale"]) == ("mlp", "meta/trajectories20-h4-k10", "mini")]
    assert f"{row['materials']['soft'][0]:.3f}" in [each.split()[0] for each in seen.column("Skill")]
    assert not any(" to " in each for each in seen.column("Skill")), "intervals are of all materials"
    page.select_option("#material", "")
    assert seen.column("Skill") == before
    page.select_option("#cell", "")
    page.select_option("#scale", "small")
    assert {each.split()[0] for each in seen.column("Model")} == {"mlp"}
    page.select_option("#scale", "")
    page.select_option("#task", "rollout")
    assert {each.split()[0] for each in seen.column("Model")} == {"maml"}
    page.select_option("#task", "")
    page.fill("#search", "persist h4")
    assert {each.split()[0] for each in seen.column("Model")} == {"persistence"}
    assert len(seen.column("Model")) == 6
    seen.close()


def test_the_page_opens_on_the_task_where_most_models_meet(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "index.html"
    path.write_bytes(page_of([*some(), swept("mlp", 0.5, task="distribution")]))
    seen = Seen(browser, path)
    assert (seen.page.input_value("#task"), seen.page.input_value("#scale")) == ("meta", "mini")
    seen.close()


def test_a_row_opens_its_record_by_keyboard(browser: Any, file: Path) -> None:
    seen = Seen(browser, file)
    button = seen.page.locator("#table button", has_text="maml").first
    button.focus()
    seen.page.keyboard.press("Enter")
    dialog = seen.page.locator("dialog[open]")
    dialog.wait_for()
    assert dialog.locator("pre").inner_text() == "dlobench run --task meta --model maml --seed 0"
    text = dialog.inner_text()
    assert all(each in text for each in ("K_train", "width", "a" * 64, "elastoplastic", "numpy 2.0"))
    curve = dialog.locator(".vega-embed svg")
    curve.wait_for()
    assert curve.bounding_box()["width"] > 300
    seen.page.keyboard.press("Escape")
    assert dialog.count() == 0
    assert seen.page.evaluate("document.activeElement.textContent") == "maml"
    seen.close()


def test_every_chart_is_drawn_with_its_points(browser: Any, file: Path) -> None:
    seen = Seen(browser, file)
    for name, points in {"horizon": 6, "trajectories": 6, "K": 9, "fit": 3, "predict": 3, "coverage": 6}.items():
        marks = seen.page.locator(f"#chart-{name} svg .mark-symbol.role-mark path")
        marks.first.wait_for(state="attached")
        assert marks.count() == points, name
    assert seen.page.locator("#chart-ranks svg .mark-line path").count() >= 3
    seen.close()


@pytest.mark.parametrize("width", [360, 1280])
def test_the_page_itself_never_scrolls_sideways(width: int, browser: Any, file: Path) -> None:
    seen = Seen(browser, file, width)
    seen.page.locator("#chart-ranks svg").wait_for()
    assert seen.page.evaluate("document.documentElement.scrollWidth") <= width
    seen.page.locator("#table button").first.click()
    seen.page.locator("dialog .vega-embed svg").wait_for()
    assert seen.page.evaluate("document.querySelector('dialog').scrollWidth") <= width
    seen.close()


def test_hostile_records_stay_text(browser: Any, tmp_path: Path) -> None:
    failure = Failure(trajectories=20, horizon=4, error=EVIL)
    one = told(swept("mlp", 0.5), EVIL).model_copy(update={"failures": [failure]})
    about = one.provenance.model_copy(update={"hyperparameters": {EVIL: EVIL}, "versions": {EVIL: EVIL}})
    curve = [{"step": float(i), EVIL: 0.5} for i in range(3)]
    fits = [fit.model_copy(update={"curve": curve}) for fit in one.fits]
    cells = [cell.model_copy(update={"id": f"{cell.id}{EVIL}", "without": EVIL}) for cell in one.cells]
    fits = [fit.model_copy(update={"without": EVIL}) for fit in fits]
    one = one.model_copy(update={"provenance": about, "fits": fits, "cells": cells})
    windows = Windows(*(np.zeros((1, 3, 2), np.float32) for _ in range(3)))
    path = tmp_path / "index.html"
    path.write_bytes(page_of([one], rollouts={EVIL: windows}))
    seen = Seen(browser, path)
    seen.page.locator("#table button").first.click()
    assert seen.page.locator("dialog pre").inner_text() == EVIL
    assert EVIL in seen.page.locator("dialog").inner_text()
    seen.page.locator("dialog .vega-embed svg").wait_for()
    assert seen.page.evaluate("window.hacked") is None
    assert seen.page.locator("img").count() == 0
    seen.close()


def test_the_policy_stops_a_script_and_a_request(browser: Any, file: Path) -> None:
    seen = Seen(browser, file)
    seen.page.evaluate(
        "() => document.body.append(Object.assign(document.createElement('script'), {text: 'window.hacked = 1'}))"
    )
    assert seen.page.evaluate("window.hacked") is None
    assert seen.page.evaluate("fetch('http://127.0.0.1:9/').then(() => 'sent', () => 'stopped')") == "stopped"
    assert any("Content Security Policy" in each for each in seen.said)
    assert not [each for each in seen.asked if each.startswith("http")]
    seen.page.close()


def test_an_empty_board_says_how_to_add_the_first_row(browser: Any, tmp_path: Path) -> None:
    path = tmp_path / "index.html"
    path.write_bytes(page_of([]))
    seen = Seen(browser, path)
    assert "dlobench run --task meta" in seen.page.locator("#empty").inner_text()
    assert not seen.page.locator("#full").is_visible()
    seen.close()


def test_the_same_records_give_the_same_bytes() -> None:
    records = [*some(), swept("maml", 0.2, seed=1), swept("maml", 0.2, seed=10)]
    first = page_of(records)
    random.Random(1).shuffle(records)
    assert page_of(records) == first
    assert len(first) < 2_000_000


def test_what_lacks_a_size_takes_no_domain_away_from_others() -> None:
    whole = [swept("maml", 0.2), swept("mlp", 0.5)]
    cells = [cell for cell in whole[1].cells if cell.trajectories == 20]
    fits = [fit for fit in whole[1].fits if fit.trajectories == 20]
    records = [whole[0], whole[1].model_copy(update={"cells": cells, "fits": fits})]
    rows = payload(records, leaderboard.table(records), scores(records))["rows"]
    sweeps = {row["model"]: row["sweeps"] for row in rows}
    assert set(sweeps["maml"]) == {"trajectories", "horizon", "K"}
    assert set(sweeps["mlp"]) == {"horizon", "K"}


def test_curves_keep_their_ends_and_at_most_thirty_points() -> None:
    points = thinned([{"step": float(i), "train": i / 7} for i in range(1000)])["train"]
    assert (len(points), points[0][0], points[-1][0]) == (30, 0, 999)
    assert thinned([]) == {}


def test_a_rollout_draws_each_shape_once() -> None:
    windows = Windows(*(np.random.default_rng(i).normal(size=(6, 5, 2)).astype(np.float32) for i in range(3)))
    assert rollout(windows).count("<polyline") == 4 * 3
    assert rollout(None) == ""
    with pytest.raises(UsageError, match="one shape"):
        rollout(Windows(windows.start, windows.true[:, :4], windows.predicted))
    with pytest.raises(UsageError, match="finite"):
        rollout(Windows(windows.start, windows.true, windows.predicted * np.nan))


def test_build_writes_the_page_unless_told_not_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(record(), tmp_path)
    call = ["leaderboard", "build", "--results", str(tmp_path), "--out", str(tmp_path / "leaderboard.csv")]
    page = tmp_path / "index.html"
    assert CliRunner().invoke(app, [*call, "--no-page"]).exit_code == 0
    assert not page.exists()
    assert CliRunner().invoke(app, call).exit_code == 0
    assert page.read_bytes() == page_of([record()])
    page.unlink()
    monkeypatch.setitem(__import__("sys").modules, "vl_convert", None)
    done = CliRunner().invoke(app, call)
    assert done.exit_code == 0
    assert "pip install 'dlobench[page]'" in done.output
    assert (tmp_path / "leaderboard.csv").exists()
    assert not page.exists()
