"""Tests the command line: every bad input ends in one line and a code, and nothing that was there is lost."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import pytest
import torch
from test_generate import check_interrupted, family, start, wait_for
from test_store import files, write

import dlobench
from dlobench.bench import results
from dlobench.bench.plugins import load_task
from dlobench.cli import main
from dlobench.data.domain_set import PARTS, SCALES, DomainSet, Extent
from dlobench.data.sets import SETS
from dlobench.data.store import Store

META = SETS["meta-learning"]
DLOBENCH = Path(sys.executable).with_name("dlobench")


class Done(NamedTuple):
    """Holds how a command ended."""

    code: int
    out: str
    err: str


Call = Callable[..., Done]


@pytest.fixture
def call(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Call:
    """Returns what calls the command line in this process, in an empty folder and with no data but in tmp_path."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("DLOBENCH_DATA", str(tmp_path / "data"))
    monkeypatch.delenv("DLOBENCH_DEBUG", raising=False)
    for of in SETS.values():  # 270,000 shards are looked at in one test only
        monkeypatch.setitem(of.extents, "paper", of.extents["mini"])

    def run(*arguments: object) -> Done:
        monkeypatch.setattr(sys, "argv", ["dlobench", *map(str, arguments)])
        with pytest.raises(SystemExit) as exit_:
            main()
        out, err = capsys.readouterr()
        assert isinstance(exit_.value.code, int)
        return Done(exit_.value.code, out, err)

    return run


def entry(*arguments: object, timeout: float = 60) -> Done:
    """Calls the command line as a user does, in a process of its own."""
    command = [str(DLOBENCH), *map(str, arguments)]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, check=False, env=os.environ | {"OMP_NUM_THREADS": "1"}
    )
    return Done(done.returncode, done.stdout, done.stderr)


def check_failed(done: Done, code: int, *parts: str) -> None:
    """Sees a command end with a code and one line that holds some parts; progress may have been told before."""
    lines = done.err.strip().splitlines()
    assert done.code == code, done.err
    assert [line for line in lines if line.startswith("dlobench: ")] == lines[-1:]
    assert "Traceback" not in done.err
    assert not [part for part in parts if part not in lines[-1]], lines[-1]
    if code == 2:
        assert len(lines) == 1, "nothing was begun"


@pytest.fixture(scope="module")
def mini(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a data folder that holds all of meta/mini, made of random walks; to be read only."""
    store, task = Store(tmp_path_factory.mktemp("mini")), load_task("meta")
    spans = task.spans("mini")
    for unit in META.units(span for part in PARTS for span in spans[part]):
        write(store, META, unit)
    return store.root


@pytest.fixture
def copied(mini: Path, tmp_path: Path) -> Path:
    """Returns a copy of the data folder."""
    return shutil.copytree(mini, tmp_path / "copied")


RUN = ("run", "--task", "meta", "--model", "persistence")
GENERATE = ("generate", "meta-learning")
BAD_USAGE: list[tuple[tuple[str, ...], tuple[str, ...]]] = [
    (("run", "--task", "moon", "--model", "mlp"), ("task", "moon", "meta")),
    (("run", "--task", "meta", "--model", "moon"), ("model", "moon", "maml", "mlp", "multitask", "persistence")),
    (("run", "--task", "meta", "--model", "absent/moon.py"), ("absent/moon.py",)),
    (("run", "--task", "absent/moon.py", "--model", "mlp"), ("absent/moon.py",)),
    (("run", "--task", "meta", "--model", "."), ("model", "'.'")),
    (("run", "--task", "meta", "--model", "./"), ("./",)),
    ((*RUN, "--scale", "huge"), ("huge", "mini", "small", "paper")),
    ((*RUN, "--K", "11"), ("11", "10")),
    ((*RUN, "--K", "-1"), ("-1", "10")),
    ((*RUN, "--K", "ten"), ("ten", "--K")),
    ((*RUN, "--horizon", "3"), ("3", "4")),
    ((*RUN, "--horizon", "1.5"), ("1.5", "--horizon")),
    ((*RUN, "--device", "x"), ("'x'", "auto", "cpu", "cuda")),
    ((*RUN, "--workers", "-1"), ("-1",)),
    ((*RUN, "--seed", "-1"), ("-1", "--seed")),
    ((*RUN, "--seeds", "4-0"), ("4-0", "empty range")),
    ((*RUN, "--seeds", "0-999999999"), ("0-999999999", "more than 1000")),
    ((*RUN, "--seeds", "0,1,0"), ("0,1,0", "twice")),
    ((*RUN, "--seeds", "one"), ("one", "0-4")),
    ((*RUN, "--max-steps", "0"), ("0", "--max-steps")),
    ((*RUN, "--set", "nonsense"), ("nonsense",)),
    ((*RUN, "--set", "width=9"), ("width=9",)),
    (("run", "--task", "meta", "--model", "maml", "--set", "N=many"), ("N=many",)),
    (("run", "--task", "meta", "--model", "maml", "--set", "M=5"), ("M=5", "N=5", "learning_rate=")),
    ((*RUN, "--moon"), ("--moon",)),
    (("run", "--task", "meta"), ("--model",)),
    (("run", "--model", "mlp"), ("--task",)),
    (("generate", "moon"), ("moon", "meta-learning")),
    (("generate",), ("SET",)),
    ((*GENERATE, "--scale", "huge"), ("huge", "mini", "small", "paper")),
    ((*GENERATE, "--domains", "0"), ("0", "1–90")),
    ((*GENERATE, "--domains", "91"), ("91", "1–90")),
    ((*GENERATE, "--domains", "many"), ("many", "--domains")),
    ((*GENERATE, "--workers", "-1"), ("-1",)),
    ((*GENERATE, "--executor", "x"), ("'x'", "local")),
    (("data", "repair", "moon"), ("moon", "meta-learning")),
    (("data", "repair", "meta-learning", "--workers", "-2"), ("-2",)),
    (("check", "moon"), ("moon", "maml")),
    (("check", "absent.py"), ("absent.py",)),
    (("moon",), ("moon",)),
    (("list", "moon"), ("moon",)),
]


@pytest.mark.parametrize(("arguments", "parts"), BAD_USAGE, ids=" ".join)
def test_bad_usage_is_told_in_one_line(
    arguments: tuple[str, ...], parts: tuple[str, ...], call: Call, tmp_path: Path
) -> None:
    before = files(tmp_path)
    done = call(*arguments)
    check_failed(done, 2, *parts)
    assert done.out == ""
    assert files(tmp_path) == before


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device here")
def test_a_device_that_is_not_there_is_refused(call: Call) -> None:
    check_failed(call(*RUN, "--device", "cuda"), 2, "cuda", "cpu")


@pytest.mark.parametrize("index", [7, 22])
def test_bad_usage_ends_the_real_command(index: int, tmp_path: Path) -> None:
    arguments, parts = BAD_USAGE[index]
    done = entry(*arguments)
    check_failed(done, 2, *parts)


@pytest.mark.parametrize("command", [GENERATE, RUN], ids=" ".join)
def test_a_data_folder_that_cannot_be_written_is_named(command: tuple[str, ...], call: Call, tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("mine")
    done = call(*command, "--data", tmp_path / "mine")
    check_failed(done, 2, str(tmp_path / "mine"), "not a folder")
    assert (tmp_path / "mine").read_text() == "mine"


@pytest.mark.parametrize(
    ("model", "setting", "why"),
    [
        *(
            (model, "width=0", "width = 0 is not a positive number")
            for model in ("mlp", "maml", "finetune", "gnn_context")
        ),
        ("mlp", "learning_rate=-1", "learning_rate = -1.0"),
        ("neural_process", "heads=3", "width = 128 is no multiple of heads = 3"),
        ("flow", "flow_steps=0", "flow_steps = 0 is not"),
        ("cvae", "code_rate=0", "code_rate = 0.0 is not"),
        ("ridge", "penalty=-1", "penalty = -1.0 is not"),
    ],
)
def test_hyperparameters_are_refused_before_there_are_data(
    model: str, setting: str, why: str, call: Call, tmp_path: Path
) -> None:
    done = call("run", "--task", "distribution", "--model", model, "--set", setting)
    check_failed(done, 2, model, why)
    assert not (tmp_path / "data").exists(), "nothing was generated"


@pytest.mark.parametrize("option", ["--data", "--out", "--model"])
def test_an_empty_value_is_no_folder(option: str, call: Call) -> None:
    check_failed(call(*RUN, option, ""), 2, option, "nothing")


def test_a_foreign_file_among_the_records_is_named_before_the_run(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "meta").mkdir(parents=True)
    (out / "meta" / "notes.txt").write_text("mine")
    done = call(*RUN, "--out", out)
    check_failed(done, 1, str(out / "meta" / "notes.txt"), "move it away")
    assert files(out) == {"meta/notes.txt": b"mine"}
    assert not (tmp_path / "data").exists(), "nothing was generated"


def test_a_file_in_the_place_of_the_results_is_named_before_the_run(call: Call, mini: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    done = call(*RUN, "--out", tmp_path / "out", "--data", mini)
    check_failed(done, done.code, str(tmp_path / "out"))
    assert done.code in (1, 2)
    assert (tmp_path / "out").read_text() == "mine"
    assert "scoring" not in done.err, "a night's fit would be lost"


INSTANT = [("--help",), ("--version",), ("list", "models"), ("list", "tasks"), ("list", "sets"), ("run", "--help")]


@pytest.mark.parametrize("arguments", INSTANT, ids=" ".join)
def test_help_and_lists_import_neither_torch_nor_mujoco(arguments: tuple[str, ...]) -> None:
    code = (
        f"import sys; sys.argv = ['dlobench', *{arguments!r}]\nfrom dlobench.cli import main\n"
        "try:\n    main()\nfinally:\n    print(*sys.modules, file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip()
    assert not {"torch", "mujoco", "dm_control", "pandas", "wandb"} & set(done.stderr.split())


def test_help_names_the_verbs_and_version_the_versions(call: Call) -> None:
    done = call("--help")
    assert done.code == 0
    assert all(verb in done.out for verb in ("run", "generate", "check", "list", "data", "leaderboard"))
    done = call("--version")
    assert done.code == 0
    assert dlobench.__version__ in done.out
    assert torch.__version__.split("+")[0] in done.out


def test_lists_are_json_on_demand() -> None:
    models = {row["model"]: row for row in json.loads(entry("list", "models", "--json").out)}
    assert {"persistence", "mlp", "multitask", "maml"} <= set(models)
    assert all(Path(row["path"]).is_file() and row["about"] for row in models.values())
    tasks = json.loads(entry("list", "tasks", "--json").out)
    assert "meta/trajectories20-h4-k10" in next(
        r["cells"] for r in tasks if (r["task"], r["scale"]) == ("meta", "mini")
    )
    sets = {(row["set"], row["scale"]): row for row in json.loads(entry("list", "sets", "--json").out)}
    mini = sets["meta-learning", "mini"]
    assert (mini["domains"], mini["trajectories"], mini["pushes"]) == (90, 1800, 1800 * 20)
    large, medium = sets["single-domain-large", "paper"], sets["single-domain-medium", "paper"]
    assert (large["domains"], medium["domains"]) == (18, 27)
    assert min(row["core_hours"] for row in sets.values()) > 0
    for name in ("models", "tasks", "sets"):
        assert entry("list", name).code == 0


def test_sizes_are_promised_as_they_turn_out(call: Call, mini: Path) -> None:
    rows = json.loads(call("list", "sets", "--json").out)
    row = next(row for row in rows if (row["set"], row["scale"]) == (META.name, "mini"))
    paths = list(mini.rglob("*.npy"))
    assert sum(path.stat().st_size for path in paths) / len(paths) == pytest.approx(row["bytes"] / 90, rel=0.01)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> DomainSet:
    """Cuts the set to one short trajectory a cell at every scale; seeds and places stay."""
    extent = Extent(train=1, valid=1, test=1, where={"length": 0.16, "rigid_objects": 0})
    of = replace(META, block=1, extents=dict.fromkeys(SCALES, (extent,)))
    monkeypatch.setitem(SETS, META.name, of)
    return of


def test_a_look_at_all_scales_takes_seconds(copied: Path) -> None:
    begin = time.monotonic()
    done = entry("data", "status", "--json", "--data", copied, timeout=40)
    assert done.code == 0, done.err
    assert time.monotonic() - begin < 20, "it opens no array"
    rows = {row["scale"]: row for row in json.loads(done.out) if row["set"] == META.name}
    assert (rows["mini"]["done"], rows["mini"]["pending"], rows["mini"]["broken"]) == (72, 18, 0)
    assert rows["small"]["done"] == rows["paper"]["done"] == 72
    assert rows["mini"]["pushes"] == 72 * 400


def truncate(path: Path) -> None:
    """Cuts the end off a shard."""
    path.write_bytes(path.read_bytes()[:-1000])


def flip(path: Path) -> None:
    """Flips a bit of a shard."""
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def test_broken_shards_are_found_and_repaired_to_the_same_bytes(call: Call, tiny: DomainSet, tmp_path: Path) -> None:
    store, units = Store(tmp_path / "data"), list(tiny.units(tiny.spans("mini")))
    assert call("generate", META.name).code == 0
    assert call("data", "verify").code == 0
    whole = {name: content for name, content in files(store.root).items() if name.endswith(".npy")}
    assert len(whole) == len(units) == 9
    truncated, flipped = (store.path(tiny, unit) for unit in units[3:5])
    truncate(truncated)
    flip(flipped)
    spoiled = files(store.root)

    done = call("data", "status", "--json")
    assert done.code == 0
    row = next(r for r in json.loads(done.out) if (r["set"], r["scale"]) == (META.name, "mini"))
    assert (row["done"], row["pending"], row["broken"]) == (8, 0, 1), "status goes by sizes"
    assert str(truncated) in done.err

    done = call("data", "verify")
    assert done.code == 1
    assert "dlobench: 2 shards are broken" in done.err.splitlines()[-1]
    assert str(truncated) in done.err
    assert str(flipped) in done.err

    check_failed(call("generate", META.name), 1, str(truncated), "repair")
    assert files(store.root) == spoiled, "what is broken is not overwritten unasked"

    times = {path: path.stat().st_mtime_ns for path in store.root.rglob("*.npy")}
    done = call("data", "repair", META.name)
    assert done.code == 0, done.err
    assert "2 broken shards" in done.err
    assert {name: content for name, content in files(store.root).items() if name.endswith(".npy")} == whole
    again = {path for path, then in times.items() if path.stat().st_mtime_ns != then}
    assert again == {truncated, flipped}, "only what was broken is made again"
    assert call("data", "verify").code == 0
    assert "0 broken shards" in call("data", "repair", META.name).err


@pytest.mark.parametrize("spoil", [truncate, flip])
def test_a_run_on_a_broken_shard_names_it(
    spoil: Callable[[Path], None], call: Call, copied: Path, tmp_path: Path
) -> None:
    path = Store(copied).path(META, next(META.units(load_task("meta").spans("mini")["train"])))
    spoil(path)
    before = files(copied)
    done = call(*RUN, "--data", copied, "--out", tmp_path / "out")
    check_failed(done, 1, str(path), "repair")
    assert not list((tmp_path / "out").rglob("*"))
    assert files(copied) == before


def board(out: Path) -> list[dict[str, str]]:
    """Returns the rows of the leaderboard of a results folder."""
    return list(csv.DictReader((out / "leaderboard.csv").read_text().splitlines()))


def test_a_run_leaves_a_record_and_a_leaderboard_and_is_reused(call: Call, mini: Path, tmp_path: Path) -> None:
    out, before = tmp_path / "out", files(mini)
    done = call(*RUN, "--data", mini, "--out", out)
    assert done.code == 0, done.err
    assert "all 72 shards reused" in done.err
    (record,) = results.read_all(out)
    path = record.path(out)
    assert (record.task, record.scale, record.model, record.seed) == ("meta", "mini", "persistence", 0)
    assert "--task meta" in record.provenance.command
    assert str(tmp_path) not in record.provenance.command, "folders of a machine are nobody else's"
    assert [cell.K for cell in record.cells] == [0, 1, 10]
    assert all(abs(cell.skill) < 1e-12 and cell.mse > 0 and len(cell.domains) == 18 for cell in record.cells)
    assert record.provenance.command.startswith("dlobench run --task meta --model persistence")
    rows = board(out)
    assert {row["cell"] for row in rows} == {cell.id for cell in record.cells}
    assert all(row["cell"] in done.out and row["config"] in done.out for row in rows)

    first, then = files(out), path.stat().st_mtime_ns
    done = call(*RUN, "--data", mini, "--out", out)
    assert done.code == 0
    assert f"reused the record {path}" in done.err
    assert files(out) == first
    assert path.stat().st_mtime_ns == then

    assert call(*RUN, "--data", mini, "--out", out, "--force").code == 0
    assert path.stat().st_mtime_ns != then
    assert len(results.read_all(out)) == 1
    assert files(mini) == before


def plugin(folder: Path, body: str, name: str = "mine") -> Path:
    """Writes a plugin that stands still but for a line at the begin of its predict, or whole methods."""
    folder.mkdir(exist_ok=True)
    method = (
        body
        if "def " in body
        else f"def predict(self, query, samples):\n        {body}\n        return self.still(query)"
    )
    path = folder / f"{name}.py"
    path.write_text(f"""\
import sys
from dataclasses import dataclass
import numpy as np
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Mine(Model):
    gain: int = 1

    def still(self, query):
        return Prediction(dlo=query.dlo[None, ..., :2].copy())

    def fit(self, train, valid, setting):
        pass

    def predict(self, query, samples):
        return self.still(query)

    {method}
""")
    return path


def test_seeds_settings_and_plugins_of_one_name_never_share_a_record(call: Call, mini: Path, tmp_path: Path) -> None:
    mine = plugin(tmp_path / "a", "pass")
    other = plugin(tmp_path / "b", "query = query")
    common = ("run", "--task", "meta", "--K", 1, "--data", mini, "--out", tmp_path / "out", "--model")
    for arguments in ((mine, "--seeds", "0-1"), (mine, "--set", "gain=2"), (other,)):
        assert call(*common, *arguments).code == 0
    rows = board(tmp_path / "out")
    assert sorted(row["seeds"] for row in rows) == ["1", "1", "2"]
    assert len({row["config"] for row in rows}) == 3
    assert {row["model"] for row in rows} == {"mine"}
    assert len(results.read_all(tmp_path / "out")) == 4


FAILS = {
    "raises in predict": ("raise IndexError('the moon')", ("Mine.predict", "IndexError", "mine.py:", "the moon")),
    "raises in fit": ("def fit(self, train, valid, setting):\n        1 / 0", ("mine.fit", "ZeroDivisionError")),
    "raises when built": ("def __post_init__(self):\n        raise OSError('the moon')", ("mine", "the moon")),
    "says much": ("raise ValueError('one\\ntwo\\n\\nthree')", ("one two three",)),
    "returns NaN": ("return Prediction(dlo=query.dlo[None, ..., :2] * np.nan)", ("not finite",)),
    "returns None": ("return None", ("predict", "NoneType")),
    "exits in predict": ("sys.exit(0)", ("predict", "SystemExit")),
    "exits in fit": ("def fit(self, train, valid, setting):\n        sys.exit(0)", ("fit", "SystemExit")),
    "counts oddly": ("def parameters(self):\n        return None", ("parameters",)),
    "counts broken": ("def parameters(self):\n        return 1.5", ("parameters",)),
    "is enormous": ("return Prediction(dlo=np.full((1, *query.dlo.shape[:2], 2), 1e200))", ()),
    "logs text": ("def fit(self, train, valid, setting):\n        setting.log(1, 1, loss='low')", ("fit",)),
}


@pytest.mark.parametrize("what", FAILS)
def test_a_failed_run_leaves_what_was_there(what: str, call: Call, mini: Path, tmp_path: Path) -> None:
    out, (body, parts) = tmp_path / "out", FAILS[what]
    assert call(*RUN, "--K", 1, "--data", mini, "--out", out).code == 0
    before = files(out)
    done = call(
        "run", "--task", "meta", "--K", 1, "--data", mini, "--out", out, "--model", plugin(tmp_path / "p", body)
    )
    check_failed(done, 1, *parts)
    assert done.out == ""
    assert files(out) == before


@pytest.mark.parametrize("method", ["fit(self, train, valid, setting)", "predict(self, query, samples)"])
def test_an_interrupted_run_leaves_what_was_there(method: str, call: Call, mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call(*RUN, "--K", 1, "--data", mini, "--out", out).code == 0
    before = files(out)
    mine = plugin(tmp_path / "p", f"def {method}:\n        import time\n        time.sleep(60)")
    command = ["run", "--task", "meta", "--K", "1", "--data", str(mini), "--out", str(out), "--model", str(mine)]
    process = start(DLOBENCH, *command)
    wait_for(lambda: len(family(process.pid)) > 1)  # the plugin's own process
    time.sleep(2)
    os.killpg(process.pid, signal.SIGINT)  # what a terminal sends
    check_interrupted(process)
    assert files(out) == before
    wait_for(lambda: not family(process.pid))


def test_a_failed_run_ends_the_real_command(mini: Path, tmp_path: Path) -> None:
    mine = plugin(tmp_path / "p", "raise IndexError('the moon')")
    done = entry("run", "--task", "meta", "--data", mini, "--out", tmp_path / "out", "--model", mine)
    check_failed(done, 1, "Mine.predict", "IndexError", "mine.py:", "the moon")
    assert not list((tmp_path / "out").rglob("*"))


def test_a_plugin_that_fails_to_load_is_named(call: Call, tmp_path: Path) -> None:
    path = tmp_path / "bad.py"
    path.write_text("import no_such_module_at_all\n")
    check_failed(call("run", "--task", "meta", "--model", path), 1, str(path), "no_such_module_at_all")
    check_failed(call("check", path), 1, str(path), "no_such_module_at_all")


def test_check_tells_every_point_and_fails_with_the_broken_ones(call: Call, tmp_path: Path) -> None:
    done = call("check", "persistence")
    assert done.code == 0
    *points, protection = done.out.splitlines()
    assert len(points) > 8 and {line.split()[0] for line in points} == {"ok"}
    assert "process" in protection
    done = call("check", plugin(tmp_path / "p", "query.dlo[:] = np.nan"))
    check_failed(done, 1, "mine.py", "breaks the contract")
    assert "FAILED" in done.out


def test_the_leaderboard_is_built_to_the_same_bytes(call: Call, mini: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call(*RUN, "--data", mini, "--out", out).code == 0
    board_file = out / "leaderboard.csv"
    first = board_file.read_bytes()
    for _ in range(2):
        board_file.unlink()
        done = call("leaderboard", "build", "--results", out)
        assert done.code == 0
        assert f"{board_file}: 3 rows" in done.out
        assert board_file.read_bytes() == first
    elsewhere = tmp_path / "board.csv"
    assert call("leaderboard", "build", "--results", out, "--out", elsewhere).code == 0
    assert elsewhere.read_bytes() == first

    (out / "meta" / "notes.txt").write_text("mine")
    check_failed(call("leaderboard", "build", "--results", out), 1, "notes.txt")
    assert board_file.read_bytes() == first


def test_a_missing_results_folder_is_named(call: Call, tmp_path: Path) -> None:
    check_failed(call("leaderboard", "build", "--results", tmp_path / "absent"), 1, str(tmp_path / "absent"))
    assert not (tmp_path / "absent").exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
@pytest.mark.parametrize("command", [("list", "sets"), ("list", "models", "--json"), ("data", "status")])
def test_a_full_disk_behind_the_output_is_told_in_one_line(command: tuple[str, ...], tmp_path: Path) -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [str(DLOBENCH), *command],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            env=os.environ | {"DLOBENCH_DATA": str(tmp_path)},
        )
    assert done.returncode == 1
    assert done.stderr == "dlobench: cannot write what was to be printed: No space left on device\n"


def test_a_reader_that_has_seen_enough_is_no_failure_worth_a_line() -> None:
    command = [str(DLOBENCH), "list", "tasks", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None and process.stderr is not None
        process.stdout.close()  # as `head` does
        assert process.stderr.read() == ""
    assert process.returncode == 1


@pytest.mark.parametrize("minutes", ["0", "inf"])
def test_a_budget_of_no_minutes_is_refused(minutes: str, call: Call, tmp_path: Path) -> None:
    done = call("run", "--task", "meta", "--model", "ridge", "--out", tmp_path / "out", "--max-minutes", minutes)
    assert done.code == 2
    assert f"--max-minutes {minutes} is not a finite number of minutes above 0" in done.err
