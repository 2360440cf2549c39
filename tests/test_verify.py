"""Tests submissions: what is recorded holds, what is edited is rejected, whatever was edited and resealed."""

from __future__ import annotations

import hashlib
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import Call, call, mini  # noqa: F401  # fixtures
from test_journal import Quiet
from test_store import write

from dlobench.bench import kept, results, submission, template, weights
from dlobench.bench.fresh import Fresh, fresh
from dlobench.bench.plugins import load_model, load_task
from dlobench.bench.record import Record
from dlobench.bench.verify import verify
from dlobench.data.executors import find_executor
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the folder of a plugin that `dlobench new model` wrote."""
    folder = tmp_path_factory.mktemp("source")
    template.write("mine", folder)
    return folder


@pytest.fixture
def runs(call: Call, mini: Path, source: Path, tmp_path: Path) -> Path:  # noqa: F811
    """Returns a folder with the records of two models on few data."""
    out = tmp_path / "runs"
    for model in ("persistence", source / "mine.py"):
        assert call("run", "--task", "meta", "--model", model, "--data", mini, "--out", out).code == 0
    return out


def wrong(folder: Path) -> list[str]:
    """Returns all that is wrong with the records of a folder."""
    return [why for found in verify(results.paths(folder), folder) for why in found.wrong]


def mine(folder: Path) -> Path:
    """Returns the record of the model that learns."""
    (path,) = folder.glob("meta/mini/mine@*/seed0.json")
    return path


def resealed(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Edits a record and gives it a seal that fits, as somebody may who reads our code."""
    content = json.loads(path.read_bytes())
    content.pop("seal")
    change(content)
    before = json.dumps(content, separators=(",", ":"), ensure_ascii=False).removesuffix("}").encode()
    path.write_bytes(before + b',"seal":"%s"}\n' % hashlib.sha256(before).hexdigest().encode())


def test_what_was_recorded_holds(runs: Path) -> None:
    assert wrong(runs) == []
    assert len(results.paths(runs)) == 2


def digits(content: bytes) -> Iterator[int]:
    """Yields the places of some digits, spread over a record."""
    places = [i for i, byte in enumerate(content) if chr(byte).isdigit()]
    yield from places[:: max(1, len(places) // 40)]


def test_one_digit_edited_by_hand_is_rejected_wherever_it_is(runs: Path) -> None:
    path = mine(runs)
    whole = path.read_bytes()
    for place in digits(whole):
        digit = b"1" if whole[place : place + 1] != b"1" else b"2"
        path.write_bytes(whole[:place] + digit + whole[place + 1 :])
        assert wrong(runs), whole[max(0, place - 30) : place + 10]
    path.write_bytes(whole)
    assert wrong(runs) == []


def first_cell(key: str, factor: float) -> Callable[[dict[str, Any]], None]:
    """Returns an edit of a number of the first cell."""

    def change(content: dict[str, Any]) -> None:
        content["cells"][0][key] *= factor

    return change


def better_domains(content: dict[str, Any], by: float = 4) -> None:
    """Divides the errors of all domains, and makes the cell follow from them."""
    for cell in content["cells"]:
        domains = cell["domains"]
        for name in ("mse", "euclidean"):
            domains[name] = [float(f"{value / by:.9g}") for value in domains[name]]
            cell[name] = float(np.mean(domains[name]))
        cell["skill"] = 1 - sum(domains["mse"]) / sum(domains["persistence_mse"])


def other_hyperparameters(content: dict[str, Any]) -> None:
    """Says that the model was of another shape than its weights are."""
    content["provenance"]["hyperparameters"]["ridge"] = 0.25


def worse_persistence(content: dict[str, Any]) -> None:
    """Doubles the errors of persistence, by which skill is measured."""
    for cell in content["cells"]:
        domains = cell["domains"]
        domains["persistence_mse"] = [2 * value for value in domains["persistence_mse"]]
        cell["skill"] = 1 - sum(domains["mse"]) / sum(domains["persistence_mse"])


def fewer_domains(content: dict[str, Any]) -> None:
    """Leaves the worst domain out of every cell."""
    for cell in content["cells"]:
        domains = cell["domains"]
        worst = int(np.argmax(domains["mse"]))
        for values in domains.values():
            del values[worst]
        cell["mse"], cell["euclidean"] = (float(np.mean(domains[name])) for name in ("mse", "euclidean"))
        cell["skill"] = 1 - sum(domains["mse"]) / sum(domains["persistence_mse"])


def fewer_windows(content: dict[str, Any]) -> None:
    """Says that fewer windows were scored."""
    for cell in content["cells"]:
        cell["domains"]["windows"] = [30] * len(cell["domains"]["windows"])


EDITS: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "skill": (first_cell("skill", 1.01), "skill is"),
    "mse": (first_cell("mse", 0.99), "mse is"),
    "domains": (better_domains, "times as much as the record says of all"),
    "persistence": (worse_persistence, "persistence errs by"),
    "fewer domains": (fewer_domains, "scored on 17 domains that are not the 18 of the task"),
    "fewer windows": (fewer_windows, "30 windows"),
    "sample": (lambda c: c["cells"][0]["sample"].update(mse=1e-9), "the kept predictions score"),
    "split": (lambda c: c["provenance"].update(split_sha256="0" * 64), "its split is not that of meta"),
    "data": (lambda c: c["provenance"].update(data_sha256="0" * 64), "its data are not those of meta"),
    "version": (lambda c: c.update(task_version=2), "version 2 of meta, which has version 1"),
    "plugin": (lambda c: c["provenance"].update(plugin_sha256="0" * 64), "the plugin at plugin.py is not the one"),
    "predictions": (lambda c: c.update(predictions_sha256="0" * 64), "are not those that it was recorded with"),
    "none": (lambda c: c.update(predictions_sha256=None), "no predictions stand beside it"),
}


def test_kept_windows_that_err_far_less_than_all_are_no_reason(runs: Path) -> None:
    """Where errors have a heavy tail, the few windows that make it are seldom kept."""
    resealed(mine(runs), partial(better_domains, by=0.05))
    assert not [one for one in wrong(runs) if "times as much" in one]
    resealed(mine(runs), partial(better_domains, by=0.01))
    assert [one for one in wrong(runs) if "times as much" in one], "but not by as much as that"


@pytest.mark.parametrize("what", EDITS)
def test_an_edit_with_a_seal_that_fits_is_rejected(what: str, runs: Path) -> None:
    change, why = EDITS[what]
    resealed(mine(runs), change)
    found = wrong(runs)
    assert any(why in one for one in found), found


def test_other_predictions_than_the_task_says_are_rejected(runs: Path) -> None:
    path = mine(runs).with_suffix(".safetensors")
    there = kept.read(path)
    easier = [replace(one, windows=one.windows + np.int32(1)) for one in there]
    for predictions, why in (
        (easier, "other windows of"),
        (there[1:], "other domains"),
        (there[::-1], "other domains"),
    ):
        kept.write(path, predictions)
        sha = hashlib.sha256(path.read_bytes()).hexdigest()
        resealed(mine(runs), lambda content, sha=sha: content.update(predictions_sha256=sha))  # type: ignore[misc]
        assert any(why in one for one in wrong(runs))


def test_a_truth_of_ones_own_is_rejected(runs: Path) -> None:
    path = mine(runs).with_suffix(".safetensors")
    kept.write(path, [replace(one, true=one.dlo.copy()) for one in kept.read(path)])
    sha = hashlib.sha256(path.read_bytes()).hexdigest()
    resealed(mine(runs), lambda content: content.update(predictions_sha256=sha))
    found = wrong(runs)
    assert any("the truth of meta-learning/" in one for one in found), found


def test_a_copy_under_another_name_is_told(runs: Path) -> None:
    path = mine(runs)
    copy = path.parent.with_name(path.parent.name.replace("mine@", "better@"))
    shutil.copytree(path.parent, copy)
    resealed(copy / "seed0.json", lambda content: content.update(model="better"))
    assert any("predictions are those of better" in one for one in wrong(runs))


def test_a_task_that_nobody_has_is_rejected(runs: Path) -> None:
    path = mine(runs)
    other = runs / "mytask" / "mini" / path.parent.name
    shutil.copytree(path.parent, other)
    resealed(other / "seed0.json", lambda content: content.update(task="mytask"))
    assert any("no task is called 'mytask'" in one for one in wrong(runs))


def test_a_submission_is_packed_verified_and_added(runs: Path, tmp_path: Path, call: Call) -> None:  # noqa: F811
    one, other, board = tmp_path / "one.zip", tmp_path / "other.zip", tmp_path / "board"
    assert submission.pack([mine(runs)], runs, one) == submission.pack([mine(runs)], runs, other)
    assert one.read_bytes() == other.read_bytes()
    done = call("leaderboard", "verify", one)
    assert (done.code, "1 record holds" in done.out) == (0, True)
    assert call("leaderboard", "add", one, "--results", board).code == 0
    assert [record.model for record in results.read_all(board)] == ["mine"]
    assert not list(board.rglob("seed0/*")), "weights stay behind"
    assert (mine(board).with_name("plugin.py")).is_file()
    assert wrong(board) == []
    again = call("leaderboard", "add", one, "--results", board)
    assert (again.code, "is there already" in again.err) == (1, True)


@pytest.mark.parametrize(
    "name",
    [
        "../../evil.json",
        "/etc/passwd",
        "meta/mini/mine@00000000/run.sh",
        "meta/mini/mine@00000000/seed0/../../x.safetensors",
    ],
)
def test_a_submission_that_reaches_outside_is_refused(name: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "bad.zip", "w") as file:
        file.writestr(name, b"x")
    with pytest.raises(RunError, match="is no submission: it holds"):
        submission.unpack(tmp_path / "bad.zip", tmp_path / "out", weights=True)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("content", [b"", b"PK", b"{}"])
def test_what_is_no_zip_is_refused(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "bad.zip").write_bytes(content)
    with pytest.raises(RunError, match="is no submission"):
        submission.unpack(tmp_path / "bad.zip", tmp_path / "out", weights=True)


def test_a_submission_that_does_not_hold_is_not_added(runs: Path, tmp_path: Path, call: Call) -> None:  # noqa: F811
    resealed(mine(runs), first_cell("skill", 1.01))
    submission.pack([mine(runs)], runs, tmp_path / "bad.zip")
    done = call("leaderboard", "add", tmp_path / "bad.zip", "--results", tmp_path / "board")
    assert (done.code, "skill is" in done.err) == (1, True)
    assert not (tmp_path / "board").exists()
    done = call("leaderboard", "verify", tmp_path / "bad.zip")
    assert (done.code, "REJECTED" in done.out) == (1, True)


def test_fresh_domains_tell_who_was_fitted_to_the_old(runs: Path, mini: Path, call: Call, tmp_path: Path) -> None:  # noqa: F811
    path = mine(runs)
    data = Store(shutil.copytree(mini, tmp_path / "copied"))
    task = replace(load_task("meta"), fresh=7)
    for unit in task.of.units(task.spans("mini")["test"]):
        write(data, task.of, unit)
    done = call("leaderboard", "verify", "--fresh", 7, path, "--data", data.root)
    assert done.code == 0, done.err
    assert done.out.count("holds") == 3 + 1
    record, plugin = results.read(path, runs), load_model(str(path.with_name("plugin.py")))

    def compared(record: Record) -> list[Fresh]:
        executor = find_executor("local", workers=1)
        return fresh(record, path, plugin, 7, data, executor=executor, reporter=Quiet())

    assert all(one.holds for one in compared(record))
    resealed(path, better_domains)  # as of a model that knew the test domains
    found = compared(results.read(path, runs))
    assert len(found) == 3
    assert all(not one.holds and one.fresh < one.recorded for one in found)
    (file,) = path.with_suffix("").glob("*.safetensors")
    state = weights.read(file)
    for odd in ([], ["float", "0.5"], ["tuple", [1]]):
        weights.write(file, replace(state, tree=state.tree | {"ridge": odd}))
        with pytest.raises((RunError, UsageError), match=r"ridge = |no weights of"):
            compared(record)
    weights.write(file, state)
    resealed(path, other_hyperparameters)
    with pytest.raises(RunError, match=r"the record is of .* but .* holds"):
        compared(results.read(path, runs))
    shutil.rmtree(path.with_suffix(""))
    there = sorted(data.root.rglob("*"))
    with pytest.raises(RunError, match="has no weights at"):  # told before anything is simulated
        fresh(record, path, plugin, 8, data, executor=find_executor("local", workers=1), reporter=Quiet())
    assert sorted(data.root.rglob("*")) == there
    with pytest.raises(RunError, match="has no weights to submit"):
        submission.pack([path], runs, path.with_name("mine.zip"))
    assert not path.with_name("mine.zip").exists()


def test_fresh_sets_share_no_domain_with_the_set_and_are_the_same_again() -> None:
    of = load_task("meta").of
    new, again, other = of.fresh(7), of.fresh(7), of.fresh(8)
    assert [new.domain(i) for i in range(30)] == [again.domain(i) for i in range(30)]
    for one in (of, other):
        assert not {new.domain(i) for i in range(60)} & {one.domain(i) for i in range(60)}
    assert new.key != of.key
    assert [new.cell(i) for i in range(60)] == [of.cell(i) for i in range(60)]


@pytest.mark.parametrize("name", ["", "My", "1a", "a-b", "../a", "class", "a b"])
def test_odd_names_of_models_are_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="is no name of a model"):
        template.write(name, tmp_path)


def test_a_new_model_is_short_and_writes_over_nothing(tmp_path: Path) -> None:
    path = template.write("my_model", tmp_path)
    text = path.read_text()
    assert len(text.splitlines()) <= 40
    assert "class MyModel(Model)" in text
    with pytest.raises(UsageError, match="is there already"):
        template.write("my_model", tmp_path)
    assert path.read_text() == text
