"""Tests the protocols: how domains are parted, what is drawn to adapt on, and that every task file is sound."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from dlobench.bench.plugins import load_task
from dlobench.bench.task import Scale, Task, split_digest, supports
from dlobench.data.domain_set import PARTS, SCALES, ScaleName, Span
from dlobench.data.sets import SETS, find
from dlobench.errors import UsageError

META = SETS["meta-learning"]
FILES = sorted(path for path in (Path(__file__).parents[1] / "tasks").glob("[!_]*.py"))
TASKS = pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)


def everything(task: Task, scale: ScaleName) -> list[Span]:
    """Returns all that a task reads."""
    spans = task.spans(scale)
    return [span for part in PARTS for span in spans[part]]


# Definitions, not outputs: they must be these on every machine. A change here changes a published task.
META_MINI_SPLIT = "c4173998cb98a6d8b78f4cdf00a72cf533d98080bbc5541124d2030b2b08f7ff"
META_MINI_DATA = "bcadb528db084e46c0295f1d75ad4eeb9d6420ddb71bb1f33835ec41ae17f447"
PUBLISHED = {  # the first digits of split and data
    ("distribution", "mini"): ("1fcca6aed928cb99", "5f8d4b040f8eefa1"),
    ("distribution", "small"): ("3ec98d4272203442", "ccc418c78647f291"),
    ("horizon_sweep", "mini"): ("d51b47b811521e12", "50ee67e2e2371edd"),
    ("horizon_sweep", "small"): ("2ed7b97cab240503", "801ab22327bc9ae5"),
    ("length_sweep", "mini"): ("9579f59f8de6e0a4", "ee540c57b1c1abe2"),
    ("length_sweep", "small"): ("65c2d9aee954d789", "8348357ff2fb89fa"),
    ("meta", "mini"): ("c4173998cb98a6d8", "bcadb528db084e46"),
    ("meta", "small"): ("05815637d5c05413", "6a42122c5b9e8de4"),
    ("meta_noisy", "mini"): ("c4173998cb98a6d8", "bcadb528db084e46"),
    ("meta_noisy", "small"): ("05815637d5c05413", "6a42122c5b9e8de4"),
    ("meta_objects", "mini"): ("e1939aa709e43c3c", "ccf9f9f46ac88a14"),
    ("meta_objects", "small"): ("4f8486e3edc3149a", "0dab447e94ff4b01"),
    ("ood", "mini"): ("e1939aa709e43c3c", "ccf9f9f46ac88a14"),
    ("ood", "small"): ("4f8486e3edc3149a", "0dab447e94ff4b01"),
    ("rollout", "mini"): ("d51b47b811521e12", "50ee67e2e2371edd"),
    ("rollout", "small"): ("dee75cc81ffbe74e", "06ea00cd4143e0c1"),
    ("single_domain", "mini"): ("d51b47b811521e12", "50ee67e2e2371edd"),
    ("single_domain", "small"): ("2ed7b97cab240503", "801ab22327bc9ae5"),
}
DIGESTS = """
from dlobench.bench.plugins import load_task
from dlobench.bench.task import split_digest
from dlobench.data.domain_set import PARTS
from dlobench.data.sets import find
spans = load_task("meta").spans("mini")
print(split_digest(spans), find("meta-learning").digest(span for part in PARTS for span in spans[part]))
"""


@pytest.mark.parametrize(("name", "scale"), PUBLISHED)
def test_splits_and_data_are_the_published_ones(name: str, scale: ScaleName) -> None:
    task = load_task(name)
    spans = task.spans(scale)
    assert (split_digest(spans)[:16], task.data_digest(spans)[:16]) == PUBLISHED[name, scale]


def test_every_task_has_published_digests() -> None:
    assert {name for name, _ in PUBLISHED} == {path.stem for path in FILES}


@given(salt=st.text(max_size=8), trajectories=st.integers(1, 20), support=st.integers(0, 10), query=st.integers(1, 10))
@settings(max_examples=25, deadline=None)
def test_parts_never_overlap_whatever_the_salt_and_the_sizes(
    salt: str, trajectories: int, support: int, query: int
) -> None:
    of = replace(META, salt=salt)
    scale = Scale(trajectories=(trajectories,), support=support, query=query, K=(0,))
    task = Task(
        name="toy", version=1, set=META.name, horizon=(4,), where={"length": 0.16, "rigid_objects": 0},
        mini=scale, small=scale, paper=scale, imported=of,  # type: ignore[arg-type]
    )  # fmt: skip
    spans = task.spans("mini")
    domains = {part: {span.domain for span in spans[part]} for part in PARTS}
    assert not domains["train"] & domains["valid"]
    assert not domains["train"] & domains["test"]
    assert not domains["valid"] & domains["test"]
    assert len(set.union(*domains.values())) == 72
    assert [len(domains[part]) for part in PARTS] == [45, 9, 18]
    assert {span.count for span in spans["test"]} == {support + query}, "supports come first, then queries"


def test_the_split_of_meta_mini_is_the_published_one() -> None:
    assert split_digest(load_task("meta").spans("mini")) == META_MINI_SPLIT


def test_the_definition_of_meta_mini_is_the_published_one() -> None:
    assert META.digest(everything(load_task("meta"), "mini")) == META_MINI_DATA


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
        name="toy", version=1, set=META.name, horizon=(1, 4),
        where={"length": 0.16, "rigid_objects": (0,), "material": ("soft", "flexible")},
        mini=Scale(trajectories=(5, 15), support=5, query=7, K=(0, 1)),
        small=Scale(trajectories=(5,), support=50, query=10, K=(0,)),
        paper=Scale(trajectories=(5,), support=50, query=10, K=(0,)),
    )  # fmt: skip
    spans = task.spans("mini")
    assert {span.count for span in spans["train"]} == {15}, "the largest fit"
    assert {span.count for part in ("valid", "test") for span in spans[part]} == {12}, "support and query"
    assert {span.count for span in task.spans("small")["test"]} == {60}
    assert {META.cell(span.domain).material for span in spans["train"]} == {"soft", "flexible"}
    assert [len(spans[part]) for part in PARTS] == [6 * 5, 6, 6 * 2]
    ids = {task.cell_id(fit, K) for fit in task.fits("mini") for K in task.mini.K}
    assert ids == {f"toy/trajectories{t}-h{h}-k{K}" for t in (5, 15) for h in (1, 4) for K in (0, 1)}


def test_a_task_about_nothing_of_its_set_is_refused() -> None:
    odd = replace(load_task("meta"), where={"lenght": 0.16})
    with pytest.raises(UsageError, match="lenght"):
        odd.spans("mini")


def test_there_are_tasks() -> None:
    assert FILES


@TASKS
def test_a_task_is_called_as_its_file(path: Path) -> None:
    assert load_task(str(path)).name == path.stem


@TASKS
def test_scales_nest(path: Path) -> None:
    task = load_task(str(path))
    for smaller, larger in pairwise(SCALES):
        whole = {(span.domain, span.part): span for span in everything(task, larger)}
        for span in everything(task, smaller):
            assert whole[span.domain, span.part].head(span.count) == span, "what was generated is used again"


@TASKS
@pytest.mark.parametrize("scale", SCALES)
def test_a_task_fits_into_its_set(path: Path, scale: ScaleName) -> None:
    task = load_task(str(path))
    task.check(scale)
    chosen, spans = task.scale(scale), task.spans(scale)
    assert max(chosen.K) <= chosen.support, "supports and queries are disjoint"
    assert all(len(supports(chosen.support, K)) == 10 for K in chosen.K if K == 1)
    used = [
        (task.set_of(part).name, span.domain, k)
        for part in PARTS
        for span in spans[part]
        for k in range(span.first, span.first + span.count)
    ]
    assert len(used) == len(set(used)), "no trajectory has two parts"
    of = find(task.set)
    for name in ("material", "attachment"):
        kinds = {part: {getattr(of.cell(span.domain), name) for span in spans[part]} for part in PARTS}
        assert kinds["test"] == kinds["valid"] == kinds["train"]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"horizon": ()}, "horizon"),
        ({"horizon": (25,)}, "horizon = 25"),
        ({"name": ".."}, "'..'"),
        ({"version": -1}, "version = -1"),
        ({"where": {"length": 0.17}}, "0.17"),
        ({"where": {"length": 0.11}}, "no train domain of meta-learning/mini"),
        ({"set": "distribution"}, "no train domain of distribution/mini"),
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
