"""Tests W&B by real offline runs that are read back, and that nobody pays for it who does not ask."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_cli import Call, call, mini  # noqa: F401  # fixtures
from test_kept import some

from dlobench.bench import results, tracking
from dlobench.errors import RunError, UsageError


def records(path: Path) -> Iterator[bytes]:
    """Yields the records of a .wandb file: after 7 bytes, fragments in blocks of 32 KiB as LevelDB's log has them."""
    content, at, parts = path.read_bytes(), 7, list[bytes]()
    assert content.startswith(b":W&B")
    while at < len(content):
        left = 32768 - at % 32768
        if left < 7:
            at += left
            continue
        length, kind = int.from_bytes(content[at + 4 : at + 6], "little"), content[at + 6]  # after a checksum
        parts.append(content[at + 7 : at + 7 + length])
        at += 7 + length
        if kind in (1, 4):  # the whole record, or the last of its fragments
            yield b"".join(parts)
            parts = []


def read_back(folder: Path) -> dict[str, Any]:
    """Reads an offline run: what was logged, point by point, its configuration and its summary."""
    proto: Any = import_module("wandb.proto.wandb_internal_pb2")
    (path,) = folder.rglob("run-*.wandb")
    found: dict[str, Any] = {"history": [], "config": {}, "summary": {}, "exit": None}

    def values(items: Any) -> dict[str, Any]:
        return {item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items}

    for data in records(path):
        record = proto.Record()
        record.ParseFromString(data)
        kind = record.WhichOneof("record_type")
        if kind == "history":
            found["history"].append(values(record.history.item))
        elif kind == "run":
            found["config"] |= values(record.run.config.update)
            found["id"] = record.run.run_id
        elif kind == "summary":
            found["summary"] |= values(record.summary.update)
        elif kind == "exit":
            found["exit"] = record.exit.exit_code
    return found


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_an_offline_run_can_be_read_back(call: Call, mini: Path, tmp_path: Path) -> None:  # noqa: F811
    out = tmp_path / "out"
    fit = ("run", "--task", "meta", "--model", "mlp", "--max-steps", 60, "--K", 1, "--seeds", 4)
    done = call(*fit, "--data", mini, "--out", out, "--wandb", "offline")
    assert done.code == 0, done.err
    (record,) = results.read_all(out)
    (cell,) = record.cells
    found = read_back(out / ".wandb")
    assert found["id"] == f"meta-mini-mlp-{record.config}-seed4"
    assert found["exit"] == 0
    config = found["config"]
    assert config["task"] == "meta"
    assert config["seed"] == 4
    assert config["hyperparameters"] == record.provenance.hyperparameters
    assert config["split_sha256"] == record.provenance.split_sha256
    curve = [
        (row["trajectories20-h4/step"], row["trajectories20-h4/loss"])
        for row in found["history"]
        if "trajectories20-h4/step" in row
    ]
    assert curve == [(point["step"], point["loss"]) for point in record.fits[0].curve]
    assert len(curve) >= 3
    assert found["summary"][f"{cell.id}/skill"] == cell.skill
    assert found["summary"][f"{cell.id}/mse"] == cell.mse
    logged = {name: value for row in found["history"] for name, value in row.items()}
    path = logged.get(f"predictions/{cell.id}/path") or logged[f"predictions/{cell.id}"]["path"]
    (picture,) = out.rglob(path)
    assert picture.read_bytes().startswith(b"\x89PNG")
    (table,) = out.rglob("cells_*.table.json")
    assert json.loads(table.read_text())["data"][0][0] == cell.id
    assert "wandb" not in done.out
    assert "wandb" not in done.err.replace(str(out), ""), "it says nothing of its own"
    assert call("leaderboard", "build", "--results", out, "--no-page").code == 0, "its folder is no record"


def test_disabled_never_imports_it(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from dlobench.bench.tracking import tracker\n"
        f"with tracker('disabled', Path({str(tmp_path)!r})) as t: t.begin('a', 0, {{}})\n"
        "print('wandb' in sys.modules, 'matplotlib' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
    assert not list(tmp_path.iterdir())


def test_another_mode_is_refused(call: Call) -> None:  # noqa: F811
    done = call("run", "--task", "meta", "--model", "mlp", "--wandb", "dryrun")
    assert done.code == 2
    assert all(word in done.err for word in ("dryrun", "disabled, offline, online"))
    with pytest.raises(UsageError):
        tracking.tracker("", Path())


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_online_without_a_key_is_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("WANDB_API_KEY", raising=False)
    monkeypatch.setenv("NETRC", str(tmp_path / "none"))
    monkeypatch.setattr("sys.stdin", open("/dev/null"))  # noqa: PTH123, SIM115
    with tracking.tracker("online", tmp_path) as one, pytest.raises(RunError, match=r"W&B does not begin a run: .*key"):
        one.begin("meta-mini-mlp@1", 0, {})


def test_a_mode_of_the_environment_that_is_none_is_one_sentence(tmp_path: Path) -> None:
    code = "import sys, pathlib; from dlobench.bench import tracking\n"
    code += "with tracking.tracker('offline', pathlib.Path(sys.argv[1])) as one: one.begin('a', 0, {})"
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)],
        env={**os.environ, "WANDB_MODE": "nonsense"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert "RunError: W&B does not begin a run: " in done.stderr and "nonsense" in done.stderr


def test_a_picture_shows_prediction_over_truth() -> None:
    picture = tracking.draw([some(1), some(2, domain="set/00002")])
    assert picture.dtype == np.uint8
    assert picture.shape == (300, 1200, 3)
    orange = (picture == [255, 127, 14]).all(axis=-1).sum()
    black = (picture < 40).all(axis=-1).sum()
    assert orange > 200
    assert black > 200
    assert np.array_equal(picture, tracking.draw([some(1), some(2, domain="set/00002")]))
