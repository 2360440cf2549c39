"""Tests weights: what a plugin has learned is saved and restored to the last bit, whatever it is made of."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from toy import toy_domains

from dlobench.bench import weights
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import load_model
from dlobench.bench.remote import revive, state_of
from dlobench.bench.sandbox import Sandbox
from dlobench.bench.weights import State, flatten, restore
from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget
from dlobench.trajectories import Prediction, Query

TOYS = toy_domains(4, trajectories=6)
QUERY = TOYS[3].windows(2)[0]
SETTING = Setting(2, (1,), Budget(steps=20))

RIDGE = '''
"""Fits a ridge regression of scikit-learn."""
from dataclasses import dataclass
import numpy as np
from sklearn.linear_model import Ridge
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Linear(Model):
    alpha: float = 1.0

    def fit(self, train, valid, setting):
        windows = [domain.windows(setting.horizon) for domain in train]
        x = np.concatenate([self.features(query) for query, _ in windows])
        y = np.concatenate([(after.dlo[0] - query.dlo[..., :2]).reshape(len(query), -1) for query, after in windows])
        self.ridge = Ridge(alpha=self.alpha).fit(x, y)

    def features(self, query):
        return np.concatenate([query.dlo[..., :2].reshape(len(query), -1), query.actions.reshape(len(query), -1)], 1)

    def predict(self, query, samples):
        moved = self.ridge.predict(self.features(query)).reshape(len(query), 32, 2)
        return Prediction(dlo=(query.dlo[..., :2] + moved)[None].astype(np.float32))
'''
MODULE = '''
"""Fits a network of torch.nn."""
from dataclasses import dataclass
import torch
from torch import nn
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

class Body(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(64, 8), nn.SiLU(), nn.BatchNorm1d(8), nn.Linear(8, 64))

    def forward(self, x):
        return self.layers(x)

@dataclass
class Net(Model):
    def fit(self, train, valid, setting):
        torch.manual_seed(self.seed)
        self.body = Body().eval()

    def predict(self, query, samples):
        with torch.no_grad():
            out = self.body(torch.from_numpy(query.dlo[..., :2].reshape(len(query), 64)))
        return Prediction(dlo=out.reshape(1, len(query), 32, 2).numpy())
'''


def plugin(text: str, folder: Path) -> str:
    """Writes a plugin."""
    path = folder / "mine.py"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("what", ["persistence", "mlp", "multitask", "maml", RIDGE, MODULE], ids=lambda w: w[:11])
def test_a_model_is_restored_in_another_process_to_the_last_bit(what: str, tmp_path: Path) -> None:
    if what is RIDGE:
        pytest.importorskip("sklearn", reason="scikit-learn is not installed: pip install 'dlobench[test]'")
    path = plugin(what, tmp_path) if "\n" in what else what
    with Sandbox() as one, Sandbox() as other:
        model = one.load(path).model()
        model.fit(TOYS[:2], TOYS[2:3], SETTING)
        weights.write(tmp_path / "w", state_of(model))
        (tmp_path / "elsewhere").mkdir()
        if "\n" in what:
            path = plugin(what, tmp_path / "elsewhere")
        again = revive(other.load(path).model, weights.read(tmp_path / "w"), device="cpu")
        weights.write(tmp_path / "v", state_of(again))
        for adapted, beside in (
            (model, again),
            (model.adapt(TOYS[3].take(slice(1))), again.adapt(TOYS[3].take(slice(1)))),
        ):
            assert np.array_equal(adapted.predict(QUERY, 1).dlo, beside.predict(QUERY, 1).dlo)
        assert model.parameters() == again.parameters()
    assert (tmp_path / "w").read_bytes() == (tmp_path / "v").read_bytes()


def test_a_model_is_restored_without_a_process() -> None:
    plugin = load_model("maml")
    model = plugin.model(seed=4)
    model.fit(TOYS[:2], TOYS[2:3], SETTING)
    again = revive(plugin.model, state_of(model), device="cpu")
    assert np.array_equal(model.predict(QUERY, 1).dlo, again.predict(QUERY, 1).dlo)
    assert again.seed == 4


@dataclass
class Holder(Model):
    """Holds anything."""

    thing: Any = None
    extra: int = field(init=False, default=3)

    def fit(self, train: object, valid: object, setting: Setting) -> None:
        """Learns nothing."""

    def predict(self, query: Query, samples: int) -> Prediction:
        raise NotImplementedError


class Slotted:
    """Has slots."""

    __slots__ = ("a",)

    def __init__(self) -> None:
        self.a = np.arange(3)


def back(thing: Any) -> Any:
    """Returns what becomes of a thing."""
    return restore(Holder, flatten(Holder(thing=thing)), device="cpu").thing


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**50), 2**50) | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.tuples(inner, inner) | st.dictionaries(st.text(max_size=3), inner, max_size=3)
    ),
    max_leaves=12,
)


@given(PLAIN)
def test_plain_values_come_back(thing: Any) -> None:
    assert back(thing) == thing
    assert repr(back(thing)) == repr(thing), "a tuple stays a tuple"


def test_other_values_come_back() -> None:
    assert math.isnan(back(math.nan))
    assert back({1: "a", (2, 3): {4}}) == {1: "a", (2, 3): {4}}
    assert isinstance(back(OrderedDict(a=1)), OrderedDict)
    assert isinstance(back(np.float32(2)), np.float32)
    assert back(np.zeros((0, 3), np.int16)).shape == (0, 3)
    assert back(Slotted()).a.tolist() == [0, 1, 2]
    assert back(np.tanh) is np.tanh if isinstance(np.tanh, type(len)) else True
    assert back(torch.nn.functional.silu) is torch.nn.functional.silu
    parameter = back(torch.nn.Parameter(torch.ones(2)))
    assert isinstance(parameter, torch.nn.Parameter)
    assert parameter.requires_grad
    assert back(torch.ones(2, dtype=torch.bool)).dtype == torch.bool


def cycle() -> list[Any]:
    """Makes a list that holds itself."""
    found: list[Any] = []
    found.append(found)
    return found


def deep() -> list[Any]:
    """Makes a list in a list in a list."""
    found: list[Any] = []
    for _ in range(200):
        found = [found]
    return found


@pytest.mark.parametrize(
    ("thing", "named"),
    [
        (lambda: lambda x: x, r"thing needs .*lambda"),
        (lambda: {"a": [torch.Generator()]}, r"thing\['a'\]\[0\] is of Generator"),
        (lambda: np.array([object()]), "thing is an array of object"),
        (lambda: (i for i in "ab"), "thing is of generator"),
        (lambda: torch.ones(2, dtype=torch.bfloat16), "thing is a tensor of torch.bfloat16"),
        (cycle, "holds itself"),
        (deep, "too much"),
        (lambda: list(range(300_000)), "too much"),
        (lambda: 2**70, "thing is of int"),
    ],
)
def test_what_weights_cannot_hold_is_named(thing: Callable[[], Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        flatten(Holder(thing=thing()))


@pytest.mark.parametrize(
    ("node", "named"),
    [
        (["name", "no.such.module", "f"], "f of no.such.module, which the plugin has not imported"),
        (["object", "os", "system", {}], "system of os"),
        (["reduce", "os", "system"], "'reduce', which is no kind"),
    ],
)
def test_a_tree_of_others_runs_nothing(node: Any, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        restore(Holder, State({"thing": node}, {}), device="cpu")


@pytest.mark.parametrize("damage", [b"", b"{}", b"\0" * 200])
def test_a_damaged_file_is_named(damage: bytes, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(damage)
    with pytest.raises(RunError, match=r"w\.safetensors does not hold weights"):
        weights.read(path)
    with pytest.raises(RunError, match=r"cannot read .*nothing"):
        weights.read(tmp_path / "nothing")
