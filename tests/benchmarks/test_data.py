"""Measures reading beside its peers: random minibatches of windows out of 10^6 pushes, all sides turn by turn.

Run with `make bench-data`. Every side hands out the same three arrays, from the same random rows, which the cache of
the system holds: a state (64, 107), the next n displacements (64, n, 2), the state after them (64, 107). Each runs on
one thread, but for the worker processes of torch's `DataLoader`. Nothing is asserted about time: machines differ. Where
benchmarks are disabled, all sides run once on little. What is flat in memory is asserted.
"""

from __future__ import annotations

import itertools
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from rates import Tables
from tensordict import TensorDict  # type: ignore[import-untyped]
from torch.utils.data import DataLoader, Dataset
from torchrl.data import LazyMemmapStorage, ReplayBuffer, TensorStorage  # type: ignore[import-untyped]
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement  # type: ignore[import-untyped]

from dlobench.data.minibatches import STATE, Minibatches
from dlobench.data.store import WIDTH, Rows

Window = tuple[Any, Any, Any]  # state, actions, after
Side = Callable[[], Window]  # hands out the next minibatch

BATCH, PUSHES = 64, 20
TRAJECTORIES = 50_000
TESTS = Path(__file__).parents[1]
BOUND = 8_000_000  # bytes; the rows of 10^6 pushes take 479 MB
OURS = "Minibatches.epoch"


@pytest.fixture(scope="module")
def small(request: pytest.FixtureRequest) -> bool:
    return bool(request.config.getoption("benchmark_disable")) and not request.config.getoption("benchmark_enable")


def make_rows(path: Path, trajectories: int) -> None:
    """Writes random rows, of which the first number tells which row it is."""
    rng = np.random.default_rng(0)
    rows = np.lib.format.open_memmap(path, "w+", np.float32, (trajectories, PUSHES + 1, WIDTH))
    for first in range(0, trajectories, 1000):
        part = rows[first : first + 1000]
        part[:] = rng.standard_normal(part.shape, np.float32)
        part[..., 0] = np.arange(first * (PUSHES + 1), (first + len(part)) * (PUSHES + 1)).reshape(part.shape[:2])
    rows.flush()


@pytest.fixture(scope="module")
def rows(small: bool, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rows]:
    path = tmp_path_factory.mktemp("rows") / "rows.npy"
    make_rows(path, 200 if small else TRAJECTORIES)
    yield np.load(path, mmap_mode="c")  # which torch takes without a warning; nothing is written
    path.unlink()


class Windows(Dataset[Window]):
    """Gives one window, as a reader of torch's tutorial would write it; tensors, since arrays were slower."""

    def __init__(self, rows: Rows, horizon: int) -> None:
        self.rows, self.horizon, self.starts = torch.from_numpy(rows), horizon, PUSHES - horizon + 1

    def __len__(self) -> int:
        return len(self.rows) * self.starts

    def __getitem__(self, index: int) -> Window:
        trajectory, start = divmod(index, self.starts)
        one, end = self.rows[trajectory], start + self.horizon
        return one[start, :STATE], one[start:end, -2:], one[end, :STATE]


def loader(rows: Rows, horizon: int, workers: int) -> Side:
    """Returns torch's loader, whose workers are kept and read ahead."""
    kept = {"persistent_workers": True, "prefetch_factor": 8, "multiprocessing_context": "fork"}  # share the rows
    options: dict[str, Any] = {"shuffle": True, "drop_last": True, "num_workers": workers, **(kept if workers else {})}
    made = DataLoader(Windows(rows, horizon), BATCH, **options)
    endless = itertools.chain.from_iterable(itertools.repeat(made))
    return lambda: tuple(next(endless))


def replay(rows: Rows, n: int, storage: Any, **options: Any) -> Side:
    """Returns torchrl's buffer, in which windows lie side by side: it copies three rows a window and searches none."""
    tensors = torch.from_numpy(rows)
    starts = PUSHES - n + 1
    actions = tensors[..., -2:].unfold(1, n, 1)[:, :starts].transpose(2, 3)
    parts = {"state": tensors[:, :starts, :STATE], "actions": actions, "after": tensors[:, n:, :STATE]}
    flat = {name: part.reshape(-1, *part.shape[2:]) for name, part in parts.items()}
    buffer = ReplayBuffer(storage=storage(TensorDict(flat, [len(rows) * starts])), batch_size=BATCH, **options)

    def sample() -> Window:
        found = buffer.sample()
        return found["state"], found["actions"], found["after"]

    return sample


def mapped(path: Path) -> Callable[[TensorDict], Any]:
    """Returns what fills a memory-mapped storage of torchrl's."""

    def fill(windows: TensorDict) -> Any:
        storage = LazyMemmapStorage(len(windows), scratch_dir=path)
        storage.set(range(len(windows)), windows)
        return storage

    return fill


def epochs(batches: Minibatches, *, tensors: bool = False) -> Side:
    """Returns our minibatches, epoch after epoch."""
    rng = np.random.default_rng(0)
    endless = itertools.chain.from_iterable(batches.epoch(BATCH, rng) for _ in itertools.count())

    def following() -> Window:
        batch = next(endless).torch() if tensors else next(endless)
        return batch.state, batch.actions, batch.after

    return following


def drawn(batches: Minibatches) -> Side:
    """Returns our minibatches, each drawn from all windows."""
    rng = np.random.default_rng(0)

    def draw() -> Window:
        batch = batches.draw(BATCH, rng)
        return batch.state, batch.actions, batch.after

    return draw


def check(side: Side, rows: Rows, n: int) -> None:
    """Sees that a side hands out windows."""
    state, actions, after = (np.asarray(each) for each in side())
    first = state[:, 0].astype(int)
    flat = rows.reshape(-1, WIDTH)
    np.testing.assert_array_equal(state, flat[first, :STATE])
    np.testing.assert_array_equal(after, flat[first + n, :STATE])
    np.testing.assert_array_equal(actions, flat[first[:, None] + np.arange(n), -2:])
    assert (first % (PUSHES + 1) <= PUSHES - n).all() and len({*first.tolist()}) > BATCH / 2


def memcpy(megabytes: int) -> Side:
    """Returns what copies memory as fast as it goes, a minibatch's worth in name only."""
    source, target = np.ones((2, megabytes * 250_000), np.float32)

    def copy() -> Window:
        np.copyto(target, source)
        return source, source, target

    return copy


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")  # of Python 3.12, where there are threads
@pytest.mark.parametrize("n", [1, 4])
def test_minibatches_beside_their_peers(
    benchmark: Any, small: bool, tables: Tables, rows: Rows, tmp_path: Path, n: int
) -> None:
    batches = Minibatches({0: rows}, horizon=n)
    parts = np.split(rows, 50)
    several = Minibatches(dict(enumerate(parts)), horizon=n)
    sides: dict[str, tuple[Side, int]] = {  # and how many minibatches a turn
        OURS: (epochs(batches), 4000),
        "Minibatches.epoch, torch": (epochs(batches, tensors=True), 4000),
        "Minibatches.epoch, 50 domains": (epochs(several), 4000),
        "Minibatches.draw": (drawn(batches), 2000),
        "torch DataLoader, no workers": (loader(rows, n, 0), 100),
        "torch DataLoader, 2 workers": (loader(rows, n, 2), 100),
        "torchrl ReplayBuffer, in memory": (replay(rows, n, TensorStorage), 1000),
        "torchrl ReplayBuffer, memory-mapped": (replay(rows, n, mapped(tmp_path / "replay")), 1000),
        "torchrl ReplayBuffer, without replacement": (
            replay(rows, n, TensorStorage, sampler=SamplerWithoutReplacement()),
            1000,
        ),
    }
    for side, _ in sides.values():
        check(side, rows, n)
    minibatch = BATCH * (2 * STATE + 2 * n) * 4  # bytes
    copy, size = memcpy(1 if small else 256), (1 if small else 256) * 1e6
    copy()
    taken: dict[str, list[float]] = {name: [] for name in (*sides, "memcpy")}

    def turn() -> None:
        for name, (side, number) in sides.items():
            begin = time.perf_counter()
            for _ in range(2 if small else number):
                side()
            taken[name].append((time.perf_counter() - begin) / (2 if small else number))
        begin = time.perf_counter()
        copy()
        taken["memcpy"].append((time.perf_counter() - begin) * minibatch / size)

    benchmark.pedantic(turn, rounds=1 if small else 7)
    if small:
        return
    times = {name: statistics.median(each) for name, each in taken.items()}
    title = f"minibatches of {BATCH} windows, n = {n}, out of {len(rows) * PUSHES:,} pushes, medians"
    tables[title] = [
        f"{name:44}{1e6 * each:9.1f} µs{minibatch / each / 1e9:8.2f} GB/s   {OURS} is {each / times[OURS]:.2f} ×"
        for name, each in times.items()
    ]
    benchmark.extra_info |= {
        "bytes": minibatch,
        "microseconds": {name: 1e6 * each for name, each in times.items()},
    }


MEMORY = f"""
import os, resource, sys
from pathlib import Path
import numpy as np
sys.path.append({str(TESTS)!r})
from dlobench.data.minibatches import Minibatches

def told(name):
    lines = dict(line.split(":") for line in Path("/proc/self/status").read_text().splitlines())
    return 1024 * int(lines[name].split()[0])

def stream(path):
    "Reads all windows, and returns the peaks of memory, anonymous and mapped."
    batches = Minibatches({{0: np.load(path, mmap_mode="r")}}, horizon=4)
    anonymous, seen, total = 0, 0, 0.0
    for number, batch in enumerate(batches.epoch(64, np.random.default_rng(0))):
        seen, total = seen + len(batch), total + float(batch.after[0, 1])
        if number % 50 == 0:
            anonymous = max(anonymous, told("RssAnon"))
    assert seen == len(batches) and np.isfinite(total)
    return anonymous, told("RssFile")

stream(sys.argv[1])
for path in sys.argv[1:]:
    print(*stream(path))
"""


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="only Linux tells what memory is anonymous")
def test_memory_is_flat_while_reading(small: bool, tables: Tables, tmp_path: Path) -> None:
    """From 10^4 to 10^6 pushes (10^5 where benchmarks are disabled), in a process of its own.

    What grows is what the process has mapped of the file: the system's cache, which it takes back when it needs memory.
    """
    sizes, paths = (10**4, 10**5 if small else 10**6), [tmp_path / "few.npy", tmp_path / "many.npy"]
    for path, size in zip(paths, sizes, strict=True):
        make_rows(path, size // PUSHES)
    done = subprocess.run([sys.executable, "-c", MEMORY, *map(str, paths)], capture_output=True, text=True, check=False)
    held = [path.stat().st_size for path in paths]
    for path in paths:
        path.unlink()
    assert done.returncode == 0, done.stderr
    (few, few_mapped), (many, many_mapped) = (map(int, line.split()) for line in done.stdout.splitlines())
    if not small:
        tables["memory while all windows are read once, MB"] = [
            f"{size:>9,} pushes{own / 1e6:8.1f} anonymous{file / 1e6:8.1f} mapped, of a file of {bytes_ / 1e6:.1f}"
            for size, own, file, bytes_ in zip(sizes, (few, many), (few_mapped, many_mapped), held, strict=True)
        ]
    assert many - few < BOUND


JOIN = f"""
import resource, sys
from pathlib import Path
sys.path.append({str(TESTS)!r})
from test_store import fake
from dlobench.data import joined, store as module
from dlobench.data.domain_set import Span
from dlobench.data.sets import SETS

module.os.fsync = lambda _: None  # the volume is what counts here
of, store = SETS["single-domain-large"], module.Store(Path(sys.argv[1]))
walk = fake(of.domain(0), of.block)

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)

def join(span):
    for unit in of.units([span]):
        store.write(of, unit, walk, {{}}, 0.0)
    assert len(joined.map_rows(store, of, span)) == span.count
    return joined.join_path(store, of, span).unlink()

join(Span(0, "train", 0, 500))
before = peak()
join(Span(1, "train", 0, int(sys.argv[2]) // of.pushes))
print(peak() - before)
"""


def test_memory_is_flat_while_shards_are_joined(small: bool, tables: Tables, tmp_path: Path) -> None:
    """From 50 to 5,000 shards (500 where benchmarks are disabled), in a process of its own."""
    pushes = 10**5 if small else 10**6
    command = [sys.executable, "-c", JOIN, str(tmp_path), str(pushes)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    grown = int(done.stdout)
    if not small:
        tables["memory while shards are joined"] = [
            f"the peak, all included, grew by {grown / 1e6:.1f} MB from 10,000 to {pushes:,} pushes"
        ]
    assert grown < BOUND
