"""Tests the protocols: how domains are parted, what is drawn to adapt on, and that every task file is sound."""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dlobench.bench.plugins import load_task
from dlobench.bench.task import Scale, Split, Task, partition, supports
from dlobench.data.sets import SCALES, SETS, find
from dlobench.errors import UsageError

META = SETS["meta-learning"]
FILES = sorted(path for path in (Path(__file__).parents[1] / "tasks").glob("[!_]*.py"))
TASKS = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)

salts = st.text(max_size=8)
shares = st.floats(0, 0.45)
sizes = st.integers(3, META.per_cell)
cells = st.lists(st.integers(0, len(META.cells) - 1), min_size=1, max_size=4, unique=True)


def members(cells: list[int], size: int) -> list[int]:
    """Returns the first domains of some cells."""
    return [cell * META.per_cell + k for cell in cells for k in range(size)]


@given(salt=salts, test=shares, valid=shares, size=sizes, cells=cells, order=st.randoms(use_true_random=False))
@settings(deadline=None)
def test_partitions_are_disjoint_complete_stratified_and_blind_to_order(
    salt: str, test: float, valid: float, size: int, cells: list[int], order: object
) -> None:
    domains = members(cells, size)
    tested, validated = max(1, round(test * size)), max(1, round(valid * size))
    assume(tested + validated < size)
    split = Split(salt=salt, test=test, valid=valid)
    parts = partition(META, domains, split)
    assert sorted(parts.train + parts.valid + parts.test) == sorted(domains), "disjoint and complete"
    for part, count in ((parts.test, tested), (parts.valid, validated), (parts.train, size - tested - validated)):
        assert Counter(index // META.per_cell for index in part) == dict.fromkeys(cells, count)
    shuffled = list(domains)
    order.shuffle(shuffled)  # type: ignore[attr-defined]
    assert partition(META, shuffled, split) == parts
    assert partition(META, shuffled, split).digest == parts.digest


@given(one=salts, other=salts)
@settings(max_examples=50, deadline=None)
def test_another_salt_parts_otherwise(one: str, other: str) -> None:
    assume(one != other)
    domains = members(list(range(9)), META.per_cell)
    first, second = (partition(META, domains, Split(salt=salt, test=0.25, valid=0.1)) for salt in (one, other))
    assert set(first.test) != set(second.test)
    assert first.digest != second.digest


def test_a_stratum_is_parted_alike_whatever_others_there_are() -> None:
    split = Split(salt="x", test=0.25, valid=0.1)
    alone, together = partition(META, members([4], 10), split), partition(META, members([2, 4, 7], 10), split)
    assert set(alone.test) == {index for index in together.test if index // META.per_cell == 4}


@pytest.mark.parametrize("size", [1, 2])
def test_a_stratum_too_small_for_three_parts_is_refused(size: int) -> None:
    with pytest.raises(UsageError, match=rf"{META.cells[3]} has {size} domains"):
        partition(META, [*members([1], 5), *members([3], size)], Split(salt="x", test=0.25, valid=0.1))


@pytest.mark.parametrize(("test", "valid"), [(0.9, 0.1), (0.5, 0.5), (1.0, 0.0)])
def test_shares_that_leave_nothing_to_train_on_are_refused(test: float, valid: float) -> None:
    with pytest.raises(UsageError, match="none is left to train on"):
        partition(META, members([1], 10), Split(salt="x", test=test, valid=valid))


# Definitions, not outputs: they must be these on every machine. A change here changes a published task.
META_MINI_SPLIT = "d2b3fa505f7f6270ece035868cf7f5ed814c6f5d44fb00ee951f38d76ce9d11e"
META_MINI_DATA = "e5376927e1b9e9f4382e0b6b196226ca4f5bb7eb2c5014d58a10a0659d5adac0"
DIGESTS = """
from dlobench.bench.plugins import load_task
from dlobench.data.sets import find
task = load_task("meta")
print(task.partition("mini").digest, find(task.set).digest(task.domains("mini"), task.trajectories("mini")))
"""


def test_the_split_of_meta_mini_is_the_published_one() -> None:
    assert load_task("meta").partition("mini").digest == META_MINI_SPLIT


def test_the_definition_of_meta_mini_is_the_published_one() -> None:
    task = load_task("meta")
    assert META.digest(task.domains("mini"), task.trajectories("mini")) == META_MINI_DATA


@pytest.mark.parametrize("disabled", ["", "X86_V4 AVX512_ICL AVX512_SPR", "AVX512F AVX512CD AVX512_SKX"])
def test_digests_do_not_depend_on_the_kind_of_cpu(disabled: str) -> None:
    # NumPy warns of the names that this machine or version does not know, and takes the others.
    environment = os.environ | {"NPY_DISABLE_CPU_FEATURES": disabled, "PYTHONHASHSEED": "7", "PYTHONWARNINGS": ""}
    done = subprocess.run(
        [sys.executable, "-P", "-c", DIGESTS], env=environment, capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [META_MINI_SPLIT, META_MINI_DATA]


@given(pool=st.integers(1, 80), K=st.integers(1, 80))
def test_supports_are_disjoint_whole_and_inside_the_pool(pool: int, K: int) -> None:
    assume(pool >= K)
    drawn = [list(range(pool + 99))[chosen] for chosen in supports(pool, K)]
    assert 1 <= len(drawn) <= 10
    assert all(len(support) == K for support in drawn)
    flat = [index for support in drawn for index in support]
    assert len(set(flat)) == len(flat)
    assert set(flat) <= set(range(pool)), "never the queries, which come after the pool"
    assert len(drawn) == min(10, pool // K), "as many as there are, up to ten"


def test_no_support_is_one_empty_support() -> None:
    assert [list(range(20))[chosen] for chosen in supports(10, 0)] == [[]]


def test_one_trajectory_is_averaged_over_ten_supports() -> None:
    assert len(supports(10, 1)) == len(supports(50, 1)) == 10


def test_a_task_reads_what_it_says() -> None:
    task = Task(
        name="toy", version=1, set=META.name, horizon=(1, 4), split=Split(salt="x", test=0.25, valid=0.1),
        where={"length": 0.16, "rigid_objects": 0, "material": "soft"},
        mini=Scale(trajectories=(5, 30), support=10, query=10, K=(0, 1)),
        small=Scale(trajectories=(5,), support=50, query=10, K=(0,)),
        paper=Scale(trajectories=(5,), support=50, query=10, K=(0,)),
    )  # fmt: skip
    assert task.trajectories("mini") == 30
    assert task.trajectories("small") == 60
    assert {META.cell(i).material for i in task.domains("mini")} == {"soft"}
    assert len(task.domains("mini")) == 3 * META.extents["mini"].per_cell
    ids = {task.cell_id(fit, K) for fit in task.fits("mini") for K in task.mini.K}
    assert ids == {f"toy/trajectories{t}-h{h}-k{K}" for t in (5, 30) for h in (1, 4) for K in (0, 1)}


def test_a_task_about_nothing_of_its_set_is_refused() -> None:
    odd = replace(load_task("meta"), where={"lenght": 0.16})
    with pytest.raises(UsageError, match="lenght"):
        odd.domains("mini")


def test_there_are_tasks() -> None:
    assert FILES


@TASKS
def test_a_task_is_called_as_its_file(path: Path) -> None:
    assert load_task(str(path)).name == path.stem


@TASKS
def test_scales_nest(path: Path) -> None:
    task = load_task(str(path))
    for smaller, larger in pairwise(SCALES):
        assert set(task.domains(smaller)) <= set(task.domains(larger)), "what was generated is used again"
        assert task.trajectories(smaller) <= task.trajectories(larger)


@TASKS
@pytest.mark.parametrize("scale", SCALES)
def test_a_task_fits_into_its_set(path: Path, scale: str) -> None:
    task = load_task(str(path))
    for name in SCALES:
        if name != scale:
            continue
        of, chosen = find(task.set), task.scale(name)
        assert task.domains(name)
        assert task.trajectories(name) <= of.extents[name].trajectories
        assert max(chosen.K) <= chosen.support
        assert chosen.support + chosen.query <= of.extents[name].trajectories, "supports and queries are disjoint"
        assert all(len(supports(chosen.support, K)) == 10 for K in chosen.K if K == 1)
        parts = task.partition(name)
        assert sorted(parts.train + parts.valid + parts.test) == sorted(task.domains(name))
        assert {str(of.cell(i)) for i in parts.test} == {str(of.cell(i)) for i in parts.train}


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"horizon": ()}, "horizon"),
        ({"horizon": (25,)}, "horizon = 25"),
        ({"name": ".."}, "'..'"),
        ({"version": -1}, "version = -1"),
        ({"where": {"length": 0.17}}, "0.17"),
        ({"split": Split(salt="x", test=-1.0, valid=0.1)}, "split.test = -1.0"),
        ({"split": Split(salt="x", test=0.9, valid=math.nan)}, "split.valid = nan"),
        ({"mini": Scale(trajectories=(-5,), support=10, query=10, K=(1,))}, "trajectories = -5"),
        ({"mini": Scale(trajectories=(21,), support=10, query=10, K=(1,))}, "trajectories = 21"),
        ({"mini": Scale(trajectories=(20,), support=10, query=11, K=(1,))}, "support + query = 21"),
        ({"mini": Scale(trajectories=(20,), support=10, query=0, K=(1,))}, "query = 0"),
        ({"mini": Scale(trajectories=(20,), support=10, query=10, K=(11,))}, "K = 11"),
        ({"mini": Scale(trajectories=(20,), support=10, query=10, K=(1, 1))}, "K = (1, 1)"),
    ],
)
def test_what_no_run_could_honour_is_refused(change: dict[str, Any], named: str) -> None:
    task = replace(load_task("meta"), **change)
    with pytest.raises(UsageError, match=re.escape(named)):
        task.check("mini")
