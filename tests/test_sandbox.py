"""Tests the process of a plugin: what it does there is a failure that names it, and the board stays as it was."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_store import files, write
from toy import toy_domains

from dlobench.bench import results
from dlobench.bench.contract import check
from dlobench.bench.limits import Limits
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import load_model, load_task
from dlobench.bench.sandbox import Sandbox
from dlobench.cli import main
from dlobench.data.domain_set import PARTS
from dlobench.data.sets import SETS
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget, Log

HOSTILE = Path(__file__).with_name("hostile")
TASK = """
from dlobench.bench.task import Scale, Task

MINI = Scale(trajectories=(2,), support=2, query=2, K=(1,))
TASK = Task(
    name="tiny", version=1, set="meta-learning", horizon=(2,), mini=MINI, small=MINI, paper=MINI,
    where={"length": 0.16, "rigid_objects": 0, "material": "soft", "attachment": "none"},
)
"""
Call = Callable[..., tuple[int, str, str]]


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns the file of a tiny task."""
    path = tmp_path_factory.mktemp("task") / "tiny.py"
    path.write_text(TASK)
    return path


@pytest.fixture(scope="module")
def data(task: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a data folder that holds what the tiny task reads, made of random walks."""
    store, tiny = Store(tmp_path_factory.mktemp("data")), load_task(str(task))
    spans = tiny.spans("mini")
    for unit in SETS["meta-learning"].units(span for part in PARTS for span in spans[part]):
        write(store, SETS["meta-learning"], unit)
    return store.root


@pytest.fixture(scope="module")
def call(task: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Call:
    """Returns what runs a plugin on the tiny task through the command line, in this process."""

    def run(out: Path, model: object, *options: object) -> tuple[int, str, str]:
        arguments = ["run", "--task", task, "--model", model, "--data", data, "--out", out, *options]
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(tmp_path_factory.mktemp("here"))
            patch.setenv("DLOBENCH_DATA", str(data))
            patch.delenv("DLOBENCH_DEBUG", raising=False)
            patch.setattr(sys, "argv", ["dlobench", *map(str, arguments)])
            with pytest.raises(SystemExit) as exit_:
                main()
        assert isinstance(exit_.value.code, int)
        return exit_.value.code, "", ""

    return run


@pytest.fixture(scope="module")
def board(call: Call, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, bytes]]:
    """Returns a results folder that holds a run of persistence, and what is in it."""
    out = tmp_path_factory.mktemp("out")
    assert call(out, "persistence")[0] == 0
    return out, files(out)


LIMITED = ("--time-limit", 20, "--memory-limit", 1)
FAILURES: dict[str, tuple[tuple[object, ...], tuple[str, ...]]] = {
    "nan": ((), ("Hostile.predict", "not finite")),
    "infinite": ((), ("Hostile.predict", "not finite")),
    "wrong_shape": ((), ("Hostile.predict", "(1, 38, 32, 3)", "(1, 38, 32, 2)")),
    "wrong_dtype": ((), ("Hostile.predict", "int64")),
    "objects": ((), ("Hostile.predict", "object")),
    "raises_in_fit": ((), ("raises_in_fit.fit raised IndexError at raises_in_fit.py:14: the moon",)),
    "raises_in_adapt": ((), ("Hostile.adapt raised IndexError at raises_in_adapt.py:17: the moon",)),
    "raises_in_predict": ((), ("Hostile.predict raised IndexError at raises_in_predict.py:20: the moon",)),
    "exits": ((), ("exits.fit raised SystemExit",)),
    "interrupts": ((), ("interrupts.fit raised KeyboardInterrupt",)),
    "loops": (("--time-limit", 1), ("Hostile.predict took longer than the time limit of 1 s",)),
    "loops_in_adapt": (("--time-limit", 1), ("Hostile.adapt took longer than the time limit of 1 s",)),
    "loops_in_fit": (("--time-limit", 1), ("loops_in_fit.fit took longer than the time limit of 1 s",)),
    "memory_bomb": ((), ("memory_bomb.fit raised MemoryError", "memory_bomb.py")),
    "memory_in_children": ((), ("memory_in_children.fit holds", "the memory limit is 1 GB")),
    "writes_query": ((), ("Hostile.predict changed query.actions",)),
    "writes_support": ((), ("Hostile.adapt changed support.dlo",)),
    "writes_results": (("--set", "target={out}"), ("Hostile.predict raised", "seed1.json")),
    "prints_megabytes": ((), ("prints_megabytes.fit printed more than 1,048,576 bytes",)),
    "misses_package": ((), ("misses_package.py", "no_such_package_at_all")),
    "syntax_error": ((), ("syntax_error.py", "SyntaxError")),
    "returns_view": ((), ("Hostile.predict returned a view of query.dlo",)),
    "environment": ((), ("Hostile.predict raised ValueError", "OMP_NUM_THREADS", "PATH")),
    "os_exit": ((), ("Hostile.predict ended its process with exit code 3",)),
    "kills_itself": ((), ("Hostile.predict was ended by SIGKILL",)),
    "closes_socket": ((), ("Hostile.predict closed the socket",)),
    "garbles": ((), ("Hostile.predict answered with something that is no message",)),
    "forges": ((), ("Hostile.predict answered with something that is no message",)),
    "enormous": ((), ("Hostile.predict answered with something that is no message",)),
}
USAGE = {"two_models": ("two_models.py", "found 2: One, Two"), "no_model": ("no_model.py", "found 0: none")}


def told(capsys: pytest.CaptureFixture[str]) -> str:
    """Returns the one line that a command ended with."""
    lines = capsys.readouterr().err.strip().splitlines()
    assert [line for line in lines if line.startswith("dlobench: ")] == lines[-1:]
    assert not any("Traceback" in line for line in lines)
    return lines[-1]


@pytest.mark.parametrize("name", FAILURES)
def test_what_a_plugin_does_is_a_failure_that_names_it(
    name: str, call: Call, board: tuple[Path, dict[str, bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    out, before = board
    options, parts = FAILURES[name]
    begin = time.monotonic()
    given = [str(option).format(out=out) for option in (*LIMITED, *options)]
    assert call(out, HOSTILE / f"{name}.py", *given)[0] == 1
    line = told(capsys)
    assert not [part for part in parts if part not in line], line
    assert files(out) == before
    assert time.monotonic() - begin < 15
    assert "DLOBENCH" not in line


@pytest.mark.parametrize("name", USAGE)
def test_a_file_without_just_one_model_is_bad_usage(
    name: str, call: Call, board: tuple[Path, dict[str, bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    out, before = board
    assert call(out, HOSTILE / f"{name}.py")[0] == 2
    line = told(capsys)
    assert not [part for part in USAGE[name] if part not in line], line
    assert files(out) == before


def test_a_fork_bomb_is_ended_with_all_of_its_processes(call: Call, board: tuple[Path, dict[str, bytes]]) -> None:
    out, before = board
    with Sandbox(Limits(20.0, 10**9, processes=8), hidden=[out]) as sandbox:
        model = sandbox.load(str(HOSTILE / "fork_bomb.py")).model()
        with pytest.raises(RunError, match=r"started more than 8 processes|raised BlockingIOError"):
            model.fit([], [], Setting(1, (0,)))
    deadline = time.monotonic() + 10  # a busy machine takes its time to bury those that were killed
    while running("fork_bomb") and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not running("fork_bomb"), "none is left"
    assert files(out) == before


def running(word: str) -> list[str]:
    """Returns the command lines of the processes of plugins that hold a word, or of those that serve one."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            line = path.read_bytes().replace(b"\0", b" ").decode(errors="replace")
        except OSError:
            continue
        if word in line and "pytest" not in line:
            found.append(line)
    return found


def test_a_daemon_goes_with_its_plugin(tmp_path: Path) -> None:
    name = f"daemon-of-{os.getpid()}"
    with Sandbox(hidden=[tmp_path]) as sandbox:
        model: Any = sandbox.load(str(HOSTILE / "leaves_a_daemon.py")).model
        model(target=name).fit([], [], Setting(1, (0,)))
        until = time.monotonic() + 5
        while not running(name) and time.monotonic() < until:
            time.sleep(0.02)
        assert running(name), "it was there"
    assert not running(name)


QUERY, _ = toy_domains(1, trajectories=2)[0].windows(2)
TINY = toy_domains(4, trajectories=4)


def test_a_fork_that_goes_on_has_nothing_to_say() -> None:
    with Sandbox() as sandbox:
        model = sandbox.load(str(HOSTILE / "forks_and_goes_on.py")).model()
        for _ in range(3):
            assert np.array_equal(model.predict(QUERY, 1).dlo[0], QUERY.dlo[..., :2])


def test_state_that_cannot_be_pickled_is_no_obstacle() -> None:
    with Sandbox() as sandbox:
        model = sandbox.load(str(HOSTILE / "unpicklable.py")).model()
        model.fit([], [], Setting(1, (0,)))
        assert np.array_equal(model.adapt(TINY[0]).predict(QUERY, 1).dlo[0], QUERY.dlo[..., :2])


def test_results_are_out_of_reach_of_who_tries_in_silence(call: Call, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert call(out, "persistence")[0] == 0
    (record,) = results.read_all(out)
    path, modes = record.path(out), {path: path.stat().st_mode for path in out.rglob("*")}
    before = files(path.parent)
    assert call(out, HOSTILE / "writes_results_quietly.py", "--set", f"target={path.parent}")[0] == 0
    assert files(path.parent) == before
    if "data and results under empty mounts" in record.provenance.protection:
        assert {path: path.stat().st_mode for path in modes if path.suffix != ".csv"} == {
            path: mode for path, mode in modes.items() if path.suffix != ".csv"
        }


@pytest.mark.parametrize("what", ["shard", "data", "record", "out", "checkout", "home"])
def test_a_plugin_cannot_read_what_it_was_not_given(
    what: str,
    call: Call,
    data: Path,
    board: tuple[Path, dict[str, bytes]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("PYTHONPATH", raising=False)  # what its user imports from, a plugin may read
    out, before = board
    shard = next(path for path in sorted(data.rglob("*")) if path.is_file())
    record = next(path for path in sorted(out.rglob("seed*.json")))
    places = {
        "shard": shard, "data": data, "record": record, "out": out, "checkout": Path(__file__).parent,
        "home": Path.home(),
    }  # fmt: skip
    target = places[what]
    assert call(out, HOSTILE / "reads.py", "--set", f"target={target}")[0] == 1
    line = told(capsys)
    assert "Hostile.predict raised PermissionError" in line or "Hostile.predict raised FileNotFoundError" in line
    assert "found" not in line
    assert files(out) == before


def test_even_where_data_lies_among_the_packages_it_is_out_of_reach(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    packages = tmp_path / "packages"
    (packages / "data").mkdir(parents=True)
    (packages / "data" / "shard").write_text("secret")
    (packages / "open").mkdir()
    (packages / "open" / "notes").write_text("common")
    monkeypatch.setenv("PYTHONPATH", str(packages))
    with Sandbox(hidden=[packages / "data"]) as sandbox:
        model: Any = sandbox.load(str(HOSTILE / "reads.py")).model
        with pytest.raises(RunError, match=r"PermissionError|FileNotFoundError"):
            model(target=str(packages / "data" / "shard")).predict(QUERY, 1)
        with pytest.raises(RunError, match="found b'common'"):
            model(target=str(packages / "open" / "notes")).predict(QUERY, 1)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("reads_parent", r"found \[\]"),
        ("connects", "PermissionError"),
        ("kills_parent", "PermissionError"),
    ],
)
def test_a_plugin_reaches_neither_other_processes_nor_the_network(name: str, message: str) -> None:
    with Sandbox() as sandbox:
        model = sandbox.load(str(HOSTILE / f"{name}.py")).model()
        if not any("no signals to outside" in phrase for phrase in sandbox.protection):
            pytest.skip("this kernel's Landlock is older")
        with pytest.raises(RunError, match=message):
            model.predict(QUERY, 1)


CAUGHT = {
    "keeps_state": "adapting depends on nothing before",
    "adapts_itself": "adapting leaves the model as it was",
    "rolls_dice": "the same seed gives the same model",
    "hashes": "the same seed gives the same model",
    "writes_query": "leaves the query as it was",
}


@pytest.mark.parametrize("name", CAUGHT)
def test_check_catches_what_a_run_cannot_see(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("PYTHONHASHSEED", raising=False)
    with Sandbox() as sandbox, Sandbox() as another:
        path = str(HOSTILE / f"{name}.py")
        outcomes = {each.name: each for each in check(sandbox.load(path), lambda: another.load(path))}
    assert not outcomes[CAUGHT[name]].passed
    assert outcomes[CAUGHT[name]].why


def fitted(model: Model, curve: list[tuple[int, int, dict[str, float]]]) -> Model:
    """Fits a model on toy domains, for a few steps."""
    log = Log([lambda step, total, values: curve.append((step, total, values))])
    model.fit(TINY[:3], TINY[3:], Setting(2, (1,), Budget(steps=60), log))
    return model


@pytest.mark.parametrize("name", ["persistence", "mlp", "maml"])
def test_a_fit_is_the_same_to_the_bit_there_as_here(name: str) -> None:
    settings: dict[str, Any] = {} if name == "persistence" else {"width": 16, "depth": 2}
    here: list[tuple[int, int, dict[str, float]]] = []
    there: list[tuple[int, int, dict[str, float]]] = []
    ours = fitted(load_model(name).model(seed=5, **settings), here)
    with Sandbox() as sandbox:
        theirs = fitted(sandbox.load(name).model(seed=5, **settings), there)
        assert ours.parameters() == theirs.parameters()
        assert np.array_equal(ours.predict(QUERY, 1).dlo, theirs.predict(QUERY, 1).dlo)
        one, other = ours.adapt(TINY[0]), theirs.adapt(TINY[0])
        assert np.array_equal(one.predict(QUERY, 1).dlo, other.predict(QUERY, 1).dlo)
        assert np.array_equal(ours.predict(QUERY, 1).dlo, theirs.predict(QUERY, 1).dlo), "adapting changed neither"
    assert here == there
    assert bool(here) == (name != "persistence")


def test_much_data_arrives_whole_and_may_be_written_into(tmp_path: Path) -> None:
    path = tmp_path / "sums.py"
    path.write_text(
        (HOSTILE / "nan.py").read_text().replace(
            "        pass",
            "        self.sum = sum(float(p.dlo.sum(dtype=float) + p.executed.sum(dtype=float)) for p in train)\n"
            "        train[0].dlo[:] = 0",
            1,
        ).replace("dlo[0, -1, 3, 1] = np.nan", "dlo[:] = self.sum")
    )  # fmt: skip
    train = toy_domains(2, trajectories=400)
    before = [part.dlo.copy() for part in train]
    assert sum(part.dlo.nbytes for part in train) > 2**21, "it goes as shared memory"
    with Sandbox() as sandbox:
        model = sandbox.load(str(path)).model()
        model.fit(train, [], Setting(1, (0,)))
        found = model.predict(QUERY, 1).dlo[0, 0, 0, 0]
    wanted = sum(float(p.dlo.sum(dtype=float) + p.executed.sum(dtype=float)) for p in train)
    assert found == np.float32(wanted)
    assert all(np.array_equal(part.dlo, kept) for part, kept in zip(train, before, strict=True)), "ours is as it was"


def test_adapted_models_are_let_go_of(tmp_path: Path) -> None:
    path = tmp_path / "counts.py"
    path.write_text(
        (HOSTILE / "nan.py").read_text().replace("return self", "return Hostile()")
        + "\n    def parameters(self):\n        import gc\n\n"
        "        return sum(isinstance(each, Hostile) for each in gc.get_objects())\n"
    )
    with Sandbox() as sandbox:
        model = sandbox.load(str(path)).model()
        kept = [model.adapt(TINY[0]) for _ in range(5)]
        assert model.parameters() == 6
        del kept[1:]
        assert model.parameters() == 2


def test_a_model_whose_process_was_ended_says_so_and_another_can_be_built() -> None:
    with Sandbox(Limits(1.0)) as sandbox:
        plugin = sandbox.load(str(HOSTILE / "loops.py"))
        model = plugin.model()
        with pytest.raises(RunError, match="time limit"):
            model.predict(QUERY, 1)
        with pytest.raises(RunError, match="lost its process"):
            model.predict(QUERY, 1)
        plugin.model().fit([], [], Setting(1, (0,)))


def test_hyperparameters_keep_their_types(tmp_path: Path) -> None:
    path = tmp_path / "typed.py"
    path.write_text(
        (HOSTILE / "nan.py").read_text()
        .replace("class Hostile(Model):", "class Hostile(Model):\n    sizes: tuple[int, ...] = (3, 4)\n"
                 "    where: Path = Path('a')\n    rate: float | None = None\n\n    def __post_init__(self):\n"
                 "        raise ValueError(repr((self.sizes, self.where, self.rate, self.seed)))\n")
        .replace("import numpy", "from pathlib import Path\n\nimport numpy")
    )  # fmt: skip
    with Sandbox() as sandbox:
        model: Any = sandbox.load(str(path)).model
        with pytest.raises(RunError, match=r"\(\(3, 4\), PosixPath\('a'\), None, 0\)"):
            model()
        with pytest.raises(RunError, match=r"\(\(3, 4\), PosixPath\('b'\), 2.0, 7\)"):
            model(seed=7, where="b", rate=2.0)
        assert sandbox.parse_settings(["where=b", "rate=2"]) == {"where": "b", "rate": 2.0}
        with pytest.raises(UsageError, match="moon=1"):
            sandbox.parse_settings(["moon=1"])


@pytest.mark.parametrize("option", ["--time-limit", "--memory-limit"])
@pytest.mark.parametrize("value", ["0", "-1", "nan", "inf"])
def test_limits_are_positive_numbers(
    option: str, value: str, call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert call(tmp_path / "out", "persistence", option, value)[0] == 2
    assert option in told(capsys)


def test_records_say_what_was_in_force(board: tuple[Path, dict[str, bytes]]) -> None:
    (record,) = results.read_all(board[0])
    said = "; ".join(record.provenance.protection)
    assert "GB a process" in said
    assert ("Landlock" in said or "data and results under empty mounts" in said) != ("nothing hides" in said)


def test_what_the_plugin_printed_and_its_traceback_are_there_for_who_debugs(tmp_path: Path) -> None:
    path = tmp_path / "says.py"
    path.write_text(
        (HOSTILE / "raises_in_fit.py").read_text().replace("raise Index", "print('hello')\n        raise Index")
    )
    with Sandbox() as sandbox:
        model = sandbox.load(str(path)).model()
        with pytest.raises(RunError, match="the moon") as failed:
            model.fit([], [], Setting(1, (0,)))
    notes = "\n".join(failed.value.__notes__)
    assert 'raise IndexError("the moon")' in notes
    assert "hello" in notes


def test_no_order_reaches_the_terminal(tmp_path: Path) -> None:
    path = tmp_path / "shouts.py"
    path.write_text((HOSTILE / "raises_in_fit.py").read_text().replace("the moon", "\\x1b[2J\\x07moon"))
    with Sandbox() as sandbox:
        model = sandbox.load(str(path)).model()
        with pytest.raises(RunError, match="moon") as failed:
            model.fit([], [], Setting(1, (0,)))
    assert str(failed.value).isprintable()


def test_ctrl_c_ends_the_plugin_too(task: Path, data: Path, tmp_path: Path) -> None:
    dlobench = Path(sys.executable).with_name("dlobench")
    arguments = ["run", "--task", task, "--model", HOSTILE / "loops.py", "--data", data, "--out", tmp_path / "out"]
    process = subprocess.Popen(
        [str(dlobench), *map(str, arguments)],
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )
    try:
        guest = _guest_of(process.pid)
        process.send_signal(signal.SIGINT)
        _, err = process.communicate(timeout=20)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "interrupted" in err
    assert not Path(f"/proc/{guest}").exists()
    assert not list((tmp_path / "out").rglob("seed*"))


def test_a_plugin_ends_with_a_run_that_is_killed(task: Path, data: Path, tmp_path: Path) -> None:
    process = _looping(task, data, tmp_path / "out")
    guest = _guest_of(process.pid)
    folder = Path(f"/proc/{guest}/cwd").readlink()
    assert folder.exists()
    process.kill()
    process.communicate()
    until = time.monotonic() + 10
    while Path(f"/proc/{guest}").exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not Path(f"/proc/{guest}").exists()
    while folder.exists() and time.monotonic() < until:
        time.sleep(0.05)
    assert not folder.exists(), "nor does what it wrote stay"


def _looping(task: Path, data: Path, out: Path) -> subprocess.Popen[str]:
    """Starts a run that never ends."""
    dlobench = Path(sys.executable).with_name("dlobench")
    arguments = ["run", "--task", task, "--model", HOSTILE / "loops.py", "--data", data, "--out", out]
    return subprocess.Popen([str(dlobench), *map(str, arguments)], stderr=subprocess.PIPE, text=True)


def _guest_of(pid: int) -> int:
    """Returns the process in which a run's plugin works, once it does: the one that burns time."""
    from dlobench.bench.processes import descendants

    until = time.monotonic() + 40
    while time.monotonic() < until:
        for each in descendants(pid):
            line = Path(f"/proc/{each}/cmdline").read_bytes()
            ticks = Path(f"/proc/{each}/stat").read_text().rpartition(")")[2].split()
            if b"dlobench.bench.guest" in line and int(ticks[1]) != pid and int(ticks[11]) > 100:
                return each
        time.sleep(0.1)
    raise AssertionError("no plugin works")
