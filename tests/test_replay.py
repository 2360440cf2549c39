"""Tests what torchrl is offered: the buffer of a set, the environment of a domain, and the examples."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_reading import fill
from torchrl.data import SliceSampler  # type: ignore[import-untyped]
from torchrl.data.datasets import load_dataset  # type: ignore[import-untyped]
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement  # type: ignore[import-untyped]
from torchrl.envs.utils import check_env_specs  # type: ignore[import-untyped]

from dlobench.data import sets
from dlobench.data.replay import DLOExperienceReplay
from dlobench.data.store import Store
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories
from dlobench.world.env import make_torchrl_env

META = sets.find("meta-learning")
EXAMPLES = Path(__file__).parents[1] / "examples"
DATASET = "dlobench:meta-learning-mini"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a data folder with the training and test parts of a set."""
    out = tmp_path_factory.mktemp("data")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda _: None)
        fill(Store(out), META, "train")
        fill(Store(out), META, "test")
    return out


@pytest.fixture(scope="module")
def whole(folder: Path) -> list[tuple[int, Trajectories]]:
    """Returns the training part, in memory."""
    spans = sorted((span for span in META.spans("mini") if span.part == "train"), key=lambda span: span.domain)
    return [(span.domain, Store(folder).load_span(META, span)) for span in spans]


def field(whole: list[tuple[int, Trajectories]], name: str) -> Any:
    """Returns a field of all trajectories, (trajectories, T or T+1, …)."""
    return np.concatenate([getattr(trajectories, name) for _, trajectories in whole])


def test_torchrl_finds_the_set(folder: Path, whole: list[tuple[int, Trajectories]]) -> None:
    replay = load_dataset(DATASET, root=folder, batch_size=32)
    assert isinstance(replay, DLOExperienceReplay)
    assert len(replay) == sum(len(trajectories) * 20 for _, trajectories in whole)
    assert replay.sample().shape == (32,)
    assert list(replay.domains.index) == [domain for domain, _ in whole]
    assert replay.data_path == folder / META.key
    other = load_dataset(DATASET, root=folder, part="test")
    assert {*other.sample(200)["domain"].tolist()} <= {
        span.domain for span in META.spans("mini") if span.part == "test"
    }


def test_the_environment_names_the_folder(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DLOBENCH_DATA", str(folder))
    assert len(load_dataset(DATASET)) == len(load_dataset(DATASET, root=folder))


def test_frames_are_what_was_recorded(folder: Path, whole: list[tuple[int, Trajectories]]) -> None:
    frames = load_dataset(DATASET, root=folder)[:]
    for name in ("dlo", "pusher", "bodies"):
        recorded = field(whole, name)
        assert np.array_equal(frames[name].numpy(), recorded[:, :-1].reshape(-1, *recorded.shape[2:])), name
        assert np.array_equal(frames["next", name].numpy(), recorded[:, 1:].reshape(-1, *recorded.shape[2:])), name
    executed = field(whole, "executed")
    assert np.array_equal(frames["action"].numpy(), field(whole, "commanded").reshape(-1, 2))
    assert np.array_equal(frames["next", "executed"].numpy(), executed.reshape(-1, 2))
    before = np.concatenate([np.zeros_like(executed[:, :1]), executed[:, :-1]], axis=1)
    assert np.array_equal(frames["executed"].numpy(), before.reshape(-1, 2))
    assert np.array_equal(frames["trajectory"].numpy(), np.repeat(np.arange(len(executed)), 20))
    domains = np.repeat([domain for domain, _ in whole], [20 * len(trajectories) for _, trajectories in whole])
    assert np.array_equal(frames["domain"].numpy(), domains)
    last = torch.arange(len(frames))[:, None] % 20 == 19
    assert torch.equal(frames["next", "done"], last) and torch.equal(frames["next", "truncated"], last)
    for never in ("done", "truncated", "terminated", ("next", "terminated")):
        assert frames[never].shape == (len(frames), 1) and not frames[never].any()
    assert frames["next", "reward"].shape == (len(frames), 1)


def test_what_comes_next_is_the_frame_after(folder: Path) -> None:
    frames = load_dataset(DATASET, root=folder)[:]
    going_on = ~frames["next", "done"][:-1, 0]
    after, following = frames["next"][:-1][going_on], frames[1:][going_on]
    for name in ("dlo", "pusher", "bodies", "executed"):
        assert torch.equal(after[name], following[name]), name
    assert torch.equal(frames["trajectory"][:-1][going_on], following["trajectory"])


def test_frames_have_the_names_and_shapes_of_the_environment(folder: Path) -> None:
    frames = load_dataset(DATASET, root=folder)[:3]
    rollout = make_torchrl_env(sets.domain("meta-learning/600")).rollout(3)
    ours, theirs = ({*td.keys(include_nested=True, leaves_only=True)} for td in (frames, rollout))
    assert ours - theirs == {"trajectory", "domain"} and theirs <= ours
    for name in theirs:
        assert frames[name].shape == rollout[name].shape, name
        assert frames[name].dtype.is_floating_point == rollout[name].dtype.is_floating_point, name


def test_any_index_is_taken(folder: Path) -> None:
    replay = load_dataset(DATASET, root=folder)
    frames = replay[:]
    chosen = torch.tensor([[5, 700], [3, -1]])
    for index, wanted in (
        (7, frames[7]),
        (-1, frames[-1]),
        (slice(10, 4, -2), frames[torch.tensor([10, 8, 6])]),
        ([1, 2], frames[1:3]),
        (range(3), frames[:3]),
        (chosen, frames[chosen]),
        (frames["next", "done"][:, 0], frames[19::20]),
    ):
        found = replay._storage.get(index)
        assert found.shape == wanted.shape
        assert (found == wanted).all()
    for index in (len(replay), torch.tensor([0, -len(replay) - 1])):
        with pytest.raises(IndexError, match=f"there are {len(replay)}"):
            replay._storage.get(index)


def test_all_frames_are_sampled_in_an_epoch(folder: Path) -> None:
    replay = load_dataset(DATASET, root=folder, batch_size=100, sampler=SamplerWithoutReplacement())
    seen = torch.cat([batch["index"] for batch in replay])
    assert torch.equal(seen.sort().values, torch.arange(len(replay)))


def test_stretches_of_a_trajectory_are_sampled(folder: Path) -> None:
    sampler = SliceSampler(slice_len=4, traj_key="trajectory", cache_values=True)
    stretches = load_dataset(DATASET, root=folder, batch_size=400, sampler=sampler).sample().reshape(100, 4)
    assert (stretches["trajectory"] == stretches["trajectory"][:, :1]).all()
    for name in ("dlo", "pusher", "bodies", "executed"):
        assert torch.equal(stretches["next", name][:, :-1], stretches[name][:, 1:]), name
    assert len({*stretches["trajectory"][:, 0].tolist()}) > 50


def test_the_buffer_is_not_to_be_written(folder: Path) -> None:
    replay = load_dataset(DATASET, root=folder, batch_size=4)
    frames = replay.sample()
    for write, arguments in ((replay.add, [frames[0]]), (replay.extend, [frames]), (replay.empty, [])):
        with pytest.raises(RuntimeError, match="doesn't allow writing"):
            write(*arguments)
    with pytest.raises(RunError, match="shared by"):
        replay.delete()
    before = replay[3].clone()
    replay[3]["dlo"].zero_()  # a copy
    assert (replay[3] == before).all()


@pytest.mark.parametrize("dataset", ["dlobench:meta-learning", "dlobench:rope-mini", "dlobench:"])
def test_an_unknown_data_set_is_refused_with_the_choices(dataset: str) -> None:
    with pytest.raises(UsageError, match=r"^unknown data set '.*'; there are: single-domain-large-mini, "):
        load_dataset(dataset)


def test_a_missing_part_is_named_with_its_command(folder: Path) -> None:
    with pytest.raises(RunError, match="`dlobench generate meta-learning --scale mini"):
        load_dataset(DATASET, root=folder, part="valid")


@pytest.mark.parametrize("goal", [False, True])
def test_the_environment_keeps_torchrls_contract(goal: bool) -> None:
    env = make_torchrl_env(sets.domain("meta-learning/17"), seed=1, goal=goal)
    check_env_specs(env)
    rollout = env.rollout(30)
    assert rollout.shape == (20,)
    twin = make_torchrl_env(sets.domain("meta-learning/17"), seed=1, noise=False)
    pushed = twin.step(twin.reset().set("action", torch.tensor([0.01, 0.0], dtype=torch.float64)))
    assert pushed["next", "executed"].tolist() == [0.01, 0.0]


def run(example: str, *arguments: str, **environment: str) -> str:
    """Runs an example as a reader would, and returns what it prints."""
    command = [sys.executable, str(EXAMPLES / example), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=os.environ | environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_rollout_example_collects_a_rollout() -> None:
    printed = run("torchrl_rollout.py", "8")
    assert "batch_size=torch.Size([8])" in printed and "dlo: Tensor(shape=torch.Size([8, 32, 3])" in printed
    moved = json.loads(printed.splitlines()[-1].partition(": ")[2])
    assert len(moved) == 8 and max(moved) > 5, "mm: the policy reaches the DLO"


def test_the_reading_example_reads(folder: Path) -> None:
    printed = run("read.py", DLOBENCH_DATA=str(folder))
    assert "(20, 21, 32, 3) x m" in printed and "windows; a linear model explains" in printed
    assert "nan" not in printed.splitlines()[-1]
