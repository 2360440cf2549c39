"""Tests generation by SLURM: options, the script of a dry run, and a real SLURM of one node where it can start."""

from __future__ import annotations

import contextlib
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Generator, Iterator
from pathlib import Path

import pytest

from dlobench.data import slurm
from dlobench.data.domain_set import Unit
from dlobench.data.executors import find_executor
from dlobench.data.generate import generate
from dlobench.data.sets import SETS
from dlobench.data.slurm import Slurm, minutes, parse_options
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError

pytest.importorskip("submitit", reason="submitit is not installed: pip install 'dlobench[cluster]'")

META = SETS["meta-learning"]
UNITS = [Unit(META.name, domain, 0, 1) for domain in (0, 2100, 4300)]
DLOBENCH = Path(sys.executable).with_name("dlobench")
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={controller}
SlurmdPort={node}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
MpiDefault=none
ReturnToService=2
KillWait=1
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=batch Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


def digests(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.npy")}


def quiet(done: int, total: int) -> None:
    """Listens to no progress."""


def fail_at_two(number: int) -> int:
    if number == 2:
        raise RunError("two is too many")
    return number


def die(number: int) -> int:
    """Ends its job as an operator does, without a word."""
    subprocess.run(["scancel", os.environ["SLURM_JOB_ID"]], check=True)
    time.sleep(60)
    return number


def square(number: int) -> int:
    return number * number


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Starts a SLURM of one node, of two CPUs, and points the clients at it; skips where that is not possible."""
    needed = ("munged", "slurmctld", "slurmd", "sbatch", "srun", "squeue", "scancel")
    absent = [name for name in needed if shutil.which(name) is None]
    if absent:
        pytest.skip(f"no {absent[0]} here (Debian's slurm-wlm and munge)")
    if os.geteuid() != 0:
        pytest.skip("a SLURM of our own needs root")
    folder = tmp_path_factory.mktemp("slurm")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    (folder / "munge.key").write_bytes(os.urandom(128))
    (folder / "munge.key").chmod(0o600)
    host = socket.gethostname().partition(".")[0]
    text = CONFIGURATION.format(host=host, folder=folder, controller=free_port(), node=free_port())
    (folder / "slurm.conf").write_text(text)
    munge = {
        name: str(folder / f"munge.{name.partition('-')[0]}")
        for name in ("key-file", "socket", "pid-file", "log-file", "seed-file")
    }
    commands = (
        ["munged", "--foreground", "--force", *(f"--{name}={path}" for name, path in munge.items())],
        ["slurmctld", "-D"],
        ["slurmd", "-D", "-N", host],
    )
    started: list[subprocess.Popen[bytes]] = []
    with pytest.MonkeyPatch.context() as patch, (folder / "said").open("wb") as said:
        patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)  # jobs find this file's functions
        try:
            for command in commands:
                process = subprocess.Popen(command, stdout=said, stderr=said, stdin=subprocess.DEVNULL)
                started.append(process)
                if command[0] == "munged":
                    wait_for_file(folder / "munge.socket")
            if not becomes_idle(started):
                pytest.skip(f"no SLURM starts here: {(folder / 'said').read_text()[-500:]}")
            yield
        finally:
            for process in reversed(started):
                process.terminate()
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(10)
                process.kill()
                process.wait()


def wait_for_file(path: Path) -> None:
    end = time.monotonic() + 10
    while not path.exists() and time.monotonic() < end:
        time.sleep(0.02)


def becomes_idle(started: list[subprocess.Popen[bytes]]) -> bool:
    """Waits until the node is ready; False when it is not in time, or a daemon has died."""
    end = time.monotonic() + 20
    while time.monotonic() < end and all(process.poll() is None for process in started):
        asked = subprocess.run(["sinfo", "--noheader", "--format=%t"], capture_output=True, text=True, check=False)
        if asked.stdout.strip() == "idle":
            return True
        time.sleep(0.1)
    return False


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Asks the queue often."""
    monkeypatch.setattr(slurm, "ASK", 1.0)
    monkeypatch.setattr(slurm, "POLL", 0.1)


@pytest.mark.parametrize(
    ("text", "limit"),
    [("90", 90), ("1:30", 2), ("2:00:00", 120), ("1-0", 1440), ("1-2:30", 1590), ("0-0:00:01", 1)],
)
def test_time_limits_are_read_as_slurm_reads_them(text: str, limit: int) -> None:
    assert minutes(text) == limit


@pytest.mark.parametrize("text", ["", "x", "-1", "1:2:3:4", "1-", "0", "1-x", "1:-2"])
def test_what_is_no_time_limit_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="leaves no time" if text == "0" else "is no time limit"):
        minutes(text)


@pytest.mark.parametrize("setting", ["partition", "=x", "partition=", "a b=c", "x=a\n#SBATCH --exclusive", "array=1-9"])
def test_what_is_no_option_of_sbatch_is_refused(setting: str) -> None:
    with pytest.raises(UsageError, match="is not KEY=VALUE" if "array" not in setting else "itself decides"):
        parse_options([setting])


def test_options_may_be_written_as_sbatch_writes_them() -> None:
    assert parse_options(["--mem-per-cpu=2G", "time=1:00:00"]) == {"mem_per_cpu": "2G", "time": "1:00:00"}


def test_an_array_never_has_more_tasks_than_slurm_takes(tmp_path: Path) -> None:
    for pieces, tasks in ((1, 1), (10, 1), (11, 2), (10_000, 1000), (10_001, 910), (157_500, 997)):
        assert Slurm(tmp_path).script(pieces)[1] == tasks


def test_a_dry_run_writes_the_script_and_submits_nothing(tmp_path: Path) -> None:
    """With no SLURM on the PATH at all."""
    command = [str(DLOBENCH), "generate", META.name, "--data", str(tmp_path), "--executor", "slurm", "--dry-run"]
    options = ["--slurm", "partition=long", "--slurm", "time=1:00:00", "--workers", "5"]
    done = subprocess.run(
        [*command, *options], capture_output=True, text=True, check=False, env=os.environ | {"PATH": "/nowhere"}
    )
    assert done.returncode == 0, done.stderr
    script = tmp_path / "slurm" / "dry-run.sh"
    assert str(script) in done.stderr
    assert "nothing was" in done.stderr
    lines = script.read_text().splitlines()
    last = -(-len(list(META.units(META.spans("mini")))) // slurm.CHUNK) - 1
    for line in ("--partition=long", "--time=60", f"--array=0-{last}%5", "--cpus-per-task=1"):
        assert f"#SBATCH {line}" in lines
    assert f"python -u -m submitit.core._submit {script.parent}" in script.read_text()
    assert [path for path in tmp_path.rglob("*") if path.is_file()] == [script]


def test_no_sbatch_is_one_sentence(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UsageError, match="finds no sbatch on the PATH"):
        find_executor("slurm", folder=tmp_path)


def test_an_array_makes_the_same_bytes_as_this_machine(cluster: None, impatient: None, tmp_path: Path) -> None:
    here, there = Store(tmp_path / "here"), Store(tmp_path / "there")
    generate(here, META, UNITS, find_executor("local", workers=1), quiet)
    heard: list[int] = []
    executor = Slurm(there.root / "slurm", parse_options(["partition=batch"]), workers=2, chunk=1)
    generate(there, META, UNITS, executor, lambda done, total: heard.append(done))
    assert heard == [0, 20, 40, 60]
    assert digests(there.root) == digests(here.root)
    assert not list((there.root / "slurm").iterdir()), "scripts and logs of what succeeded go"


@pytest.mark.parametrize("count", [0, 1, 7])
def test_every_piece_is_done_once(cluster: None, impatient: None, tmp_path: Path, count: int) -> None:
    assert sorted(Slurm(tmp_path, chunk=4)(square, range(count))) == [number**2 for number in range(count)]


def test_a_failing_task_ends_all_and_names_its_log(cluster: None, impatient: None, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="two is too many") as failure:
        list(Slurm(tmp_path, chunk=1)(fail_at_two, [2, 3]))
    log = Path(str(failure.value).rpartition("its log is ")[2])
    assert "two is too many" in log.read_text()


def test_a_job_that_vanishes_is_noticed(cluster: None, impatient: None, tmp_path: Path) -> None:
    with pytest.raises(RunError, match="left the queue without a result"):
        list(Slurm(tmp_path, chunk=1)(die, [1]))


def test_what_sbatch_refuses_is_said(cluster: None, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RunError, match=r"sbatch refuses: .*invalid partition"):
        list(Slurm(tmp_path, {"partition": "moon"})(square, [1]))
    assert not capfd.readouterr().err


def test_stopping_cancels_what_is_queued(cluster: None, impatient: None, tmp_path: Path) -> None:
    results = Slurm(tmp_path, workers=1, chunk=1)(sleep_unless_first, range(4))
    assert next(results) == 0
    assert isinstance(results, Generator)
    results.close()  # what Ctrl-C does, too
    end = time.monotonic() + 20
    while subprocess.run(["squeue", "--noheader"], capture_output=True, check=True).stdout.strip():
        assert time.monotonic() < end, "jobs are left"
        time.sleep(0.2)


def sleep_unless_first(number: int) -> int:
    if number:
        time.sleep(120)
    return number
