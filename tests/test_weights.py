"""Tests weights: what a plugin has learned is saved and restored to the last bit, whatever it is made of."""

from __future__ import annotations

import enum
import functools
import io
import math
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
import safetensors.torch
import torch
from hypothesis import given
from hypothesis import strategies as st
from toy import toy_domains

from dlobench.bench import remote, state, weights
from dlobench.bench.answers import Misdeed
from dlobench.bench.model import Model, Setting
from dlobench.bench.plugins import load_model
from dlobench.bench.remote import revive, state_of
from dlobench.bench.sandbox import Sandbox
from dlobench.bench.weights import State, flatten, restore
from dlobench.errors import RunError, UsageError
from dlobench.nn.budget import Budget
from dlobench.trajectories import Prediction, Query

OURS = ["persistence", "ridge", "mlp", "multitask", "finetune", "maml", "neural_process", "gnn", "gnn_context"]
TOYS = toy_domains(4, trajectories=6)
QUERY = TOYS[3].windows(2)[0]
SETTING = Setting(2, (1,), Budget(steps=20))

RIDGE = '''
"""Fits a ridge regression of scikit-learn."""
from dataclasses import dataclass
import numpy as np
from sklearn.linear_model import Ridge
from dlobench.bench.answers import Misdeed
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
import copy
from dataclasses import dataclass
import torch
from torch import nn
from dlobench.bench.answers import Misdeed
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

class Body(nn.Module):
    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(nn.Linear(64, 8), nn.SiLU(), nn.BatchNorm1d(8), nn.Linear(8, 64))
        self.recurrent = nn.GRU(64, 64)

    def forward(self, x):
        return self.recurrent(self.layers(x)[None])[0][0]

@dataclass
class Net(Model):
    def fit(self, train, valid, setting):
        torch.manual_seed(self.seed)
        self.body = Body().eval()

    def adapt(self, support):
        adapted = copy.deepcopy(self)
        torch.manual_seed(1)
        adapted.body.train()(torch.randn(4, 64)).square().mean().backward()
        with torch.no_grad():
            for weight in adapted.body.parameters():
                weight -= 0.1 * weight.grad
        adapted.body.eval()
        return adapted

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


@pytest.mark.parametrize("what", [*OURS, RIDGE, MODULE], ids=lambda w: w[:11])
def test_a_model_is_restored_in_another_process_to_the_last_bit(what: str, tmp_path: Path) -> None:
    if what is RIDGE:
        pytest.importorskip("sklearn", reason="scikit-learn is not installed: pip install 'dlobench[test]'")
    path = plugin(what, tmp_path) if "\n" in what else what
    with Sandbox() as one, Sandbox() as other:
        model = one.load(path).model(seed=6)
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
        assert (again.seed, again.device) == (model.seed, model.device)
        assert repr(again) == repr(model), "hyperparameters too"
    assert (tmp_path / "w").read_bytes() == (tmp_path / "v").read_bytes()


@pytest.mark.parametrize("name", OURS)
def test_a_model_is_restored_without_a_process(name: str, tmp_path: Path) -> None:
    plugin, support = load_model(name), TOYS[3].take(slice(1))
    model = plugin.model(seed=4)
    model.fit(TOYS[:2], TOYS[2:3], SETTING)
    weights.write(tmp_path / "w", state_of(model))
    again = revive(plugin.model, weights.read(tmp_path / "w"), device="cpu")
    for one, other in ((model, again), (model.adapt(support), again.adapt(support))):
        assert np.array_equal(one.predict(QUERY, 1).dlo, other.predict(QUERY, 1).dlo)
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
    """Has slots, one of them private."""

    __slots__ = ("__b", "a")

    def __init__(self) -> None:
        self.a, self.__b = np.arange(3), 4

    @property
    def b(self) -> int:
        """Returns what is private."""
        return self.__b


class Single:
    """Has one slot, named without a tuple."""

    __slots__ = "ab"  # noqa: PLC0205

    def __init__(self) -> None:
        self.ab = 1


class Empty:
    """Has no field."""


class Colour(enum.Enum):
    """Has members that are compared by identity."""

    RED = 1


class Point(NamedTuple):
    """Has names for its places."""

    x: float
    y: Any


class Guarded:
    """Has a property that must not be set."""

    def __init__(self) -> None:
        self.__dict__["q"] = 1

    @property
    def q(self) -> int:
        """Returns what is there."""
        return int(self.__dict__["q"])

    @q.setter
    def q(self, value: int) -> None:
        raise AssertionError("something was called")


def back(thing: Any) -> Any:
    """Returns what becomes of a thing."""
    return restore(Holder, flatten(Holder(thing=thing)), device="cpu").thing


def filed(thing: Any, folder: Path) -> Any:
    """Returns what becomes of a thing by way of a file."""
    weights.write(folder / "w", flatten(Holder(thing=thing)))
    return restore(Holder, weights.read(folder / "w"), device="cpu").thing


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
    assert back(2**60 + 1) == 2**60 + 1
    assert back(np.zeros((0, 3), np.int16)).shape == (0, 3)
    assert (back(Slotted()).a.tolist(), back(Slotted()).b) == ([0, 1, 2], 4)
    assert back(Single()).ab == 1
    assert isinstance(back(Empty()), Empty)
    assert back(Colour.RED) is Colour.RED
    assert back(Point(1.0, (2,))) == Point(1.0, (2,))
    assert type(back(Point(1.0, 2))) is Point
    assert back(Path("a/b")) == Path("a/b")
    assert back(Guarded()).q == 1
    assert back(Holder(thing=[1])).thing == [1], "an ensemble holds models"
    parameter = back(torch.nn.Parameter(torch.ones(2)))
    assert isinstance(parameter, torch.nn.Parameter)
    assert parameter.requires_grad
    assert back(torch.ones(2, dtype=torch.bool)).dtype == torch.bool


@pytest.mark.parametrize(
    "thing",
    [np.array(2.0), np.float64(2), torch.tensor(3.0), {np.int64(1): "a", np.int64(2): "b"}, {"\ud800": np.int8(1)}],
    ids=["array", "number", "tensor", "keys", "surrogate"],
)
def test_what_has_no_axes_has_none_in_a_file(thing: Any, tmp_path: Path) -> None:
    found = filed(thing, tmp_path)
    assert repr(found) == repr(thing)
    assert getattr(found, "shape", ()) == ()


@pytest.mark.parametrize(
    "named",
    [torch.tanh, torch.nn.functional.gelu, np.tanh, len, np.float32, torch.nn.SiLU, cast],
    ids=lambda f: f.__name__,
)
def test_functions_and_classes_come_back_by_name(named: Any, tmp_path: Path) -> None:
    assert filed({"act": named}, tmp_path)["act"] is named


def test_modules_that_hold_functions_come_back(tmp_path: Path) -> None:
    layer = torch.nn.TransformerEncoderLayer(8, 2, dropout=0.0, batch_first=True).eval()
    x = torch.randn(2, 3, 8)
    assert torch.equal(filed(layer, tmp_path)(x), layer(x))


def test_two_fields_never_share_an_array(tmp_path: Path) -> None:
    one, inner = Empty(), Empty()
    vars(inner)["b"] = np.zeros(1)
    vars(one).update({"a": inner, "a.b": np.ones(1)})
    found = vars(filed(one, tmp_path))
    assert (vars(found["a"])["b"].tolist(), found["a.b"].tolist()) == ([0], [1])


def test_axes_keep_their_order_in_memory(tmp_path: Path) -> None:
    rows = np.arange(24.0).reshape(2, 3, 4)
    for order in ((0, 1, 2), (2, 1, 0), (1, 2, 0)):
        array = rows.transpose(order)
        for found in (filed(array, tmp_path), filed(torch.from_numpy(array), tmp_path).numpy()):
            assert np.array_equal(found, array)
            assert found.strides == array.strides


def test_what_is_held_twice_is_one_again(tmp_path: Path) -> None:
    one, other = torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)
    other.weight = one.weight
    first, second = filed([one, other], tmp_path)
    assert first.weight is second.weight
    assert first.bias is not second.bias


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
        (lambda: lambda x: x, "thing is a <lambda> of .*, which cannot be found"),
        (lambda: [].append, "thing is a append of None, which cannot be found"),
        (lambda: Holder().parameters, "thing is a method, which weights cannot hold"),
        (lambda: functools.partial(max, 1), "thing is a partial"),
        (type("Local", (), {}), "thing is a Local of .*, which cannot be found"),
        (io.StringIO, "thing is a StringIO"),
        (lambda: np.random.default_rng(0), "thing is a Generator"),
        (lambda: np.ma.masked_array([1, 2], [False, True]), "thing is a MaskedArray"),
        (lambda: {"a": [torch.Generator()]}, r"thing\['a'\]\[0\] is a Generator"),
        (lambda: np.array([object()]), "thing is an array of object"),
        (lambda: (i for i in "ab"), "thing is a generator"),
        (lambda: torch.ones(2, dtype=torch.bfloat16), "thing is a tensor of torch.bfloat16"),
        (cycle, "holds itself"),
        (deep, "too much"),
        (lambda: list(range(300_000)), "too much"),
        (lambda: 2**70, "thing is an int"),
    ],
)
def test_what_weights_cannot_hold_is_named(thing: Callable[[], Any], named: str) -> None:
    with pytest.raises(UsageError, match=named):
        flatten(Holder(thing=thing()))


@pytest.mark.parametrize(
    ("node", "named"),
    [
        (["object", "no.such.module", "F", {}], "F of no.such.module, which the plugin does not import"),
        (["object", "os", "system", {}], "system of os"),
        (["named", "no.such.module", "f"], "f of no.such.module"),
        (["named", "os", "environ"], "environ of os"),
        (["reduce", "os", "system"], "'reduce', which is no kind"),
        (["namedtuple", "subprocess", "Popen", []], "no weights of Holder"),
        (["array", "absent"], "absent"),
        ([], "no weights of Holder"),
        ([["list"]], "no weights of Holder"),
        (["dict", [[["list", []], 1]]], "unhashable"),
        (["tensor", "counts", True], "no weights of Holder"),
        (["array", "counts", [5, 7]], "no weights of Holder"),
    ],
)
def test_a_tree_of_others_runs_nothing(node: Any, named: str) -> None:
    with pytest.raises(UsageError, match=named):
        restore(Holder, State({"thing": node}, {"counts": np.arange(3)}), device="cpu")


def test_no_module_is_imported_for_a_tree() -> None:
    code = """
import sys, scipy
from dlobench.bench.weights import State, restore
from dlobench.bench.plugins import load_model
from dlobench.errors import UsageError
try:
    restore(load_model("persistence").model, State({"a": ["object", "scipy", "signal.lti", {}]}, {}), device="cpu")
except UsageError as error:
    print(error, "scipy.signal" in sys.modules)
"""
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "signal.lti of scipy, which the plugin does not import as it is loaded False" in found.stdout


def nested(levels: int) -> Any:
    """Returns a tree that is deep."""
    tree: Any = 0
    for _ in range(levels):
        tree = ["list", [tree]]
    return {"a": tree}


LIES: dict[str, tuple[Any, dict[str, Any], str]] = {
    "no object": ("x", {}, "no JSON object"),
    "deep": (nested(150), {}, "too deep"),
    "deeper than anything can be read": (nested(20_000), {}, "too deep|RecursionError|recursion"),
    "large": ({"a": [0] * 1_700_000}, {}, "too large"),
    "long": ({"a": "x" * 40_000_000}, {}, "too much text"),
    "many": ({}, {str(i): np.zeros(1, bool) for i in range(200_001)}, "too many arrays"),
    "odd": ({}, {"x": np.ones(2, np.longdouble)}, "float128|longdouble"),
    "reserved": ({}, {"__metadata__": np.ones(2)}, "__metadata__"),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_state_that_lies_is_neither_written_nor_restored(lie: str, tmp_path: Path) -> None:
    tree, arrays, why = LIES[lie]
    with pytest.raises(RunError, match=why):
        weights.write(tmp_path / "w", State(tree, arrays))
    with pytest.raises(UsageError, match=why):
        restore(Holder, State(tree, arrays), device="cpu")
    assert not list(tmp_path.iterdir())


LIAR = """
import sys
import numpy as np
from dataclasses import dataclass
from dlobench.bench import state
from dlobench.bench.answers import Misdeed
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

def nested(levels):
    tree = 0
    for _ in range(levels):
        tree = ["list", [tree]]
    return {"a": tree}

LIES = {
    "deep": lambda: (nested(150), {}),
    "deeper": lambda: (nested(400), {}),
    "large": lambda: ({str(i): 0 for i in range(1_700_000)}, {}),
    "many": lambda: ({}, {str(i): np.zeros(1, bool) for i in range(300_000)}),
    "odd": lambda: ({}, {"x": np.ones(2, np.longdouble)}),
    "heavy": lambda: ({}, {"x": np.zeros(20_000_000, np.int8)}),
    "outside": lambda: ({"a": ["object", "os", "system", {}]}, {}),
}

@dataclass
class Liar(Model):
    lie: str = ""

    def fit(self, train, valid, setting):
        state.flatten = lambda model: state.State(*LIES[self.lie]())

    def predict(self, query, samples):
        return Prediction(dlo=query.dlo[..., :2][None].copy())
"""


def test_a_plugin_that_lies_about_its_state_fails_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "MOST", 1000)
    told = {
        "deep": "too deep",
        "deeper": "too deep|no message",
        "large": "too large",
        "many": "no message",
        "odd": "longdouble|float128",
        "heavy": "no message",
    }
    with Sandbox() as sandbox:
        cls: Any = sandbox.load(plugin(LIAR, tmp_path)).model
        for lie, why in told.items():
            model = cls(lie=lie)
            model.fit([], [], SETTING)
            with pytest.raises(Misdeed, match=why):
                state_of(model)
        model = cls(lie="outside")
        model.fit([], [], SETTING)
        with pytest.raises(UsageError, match="system of os"):
            revive(cls, state_of(model), device="cpu")
        assert cls().predict(QUERY, 1).dlo.shape == (1, len(QUERY), 32, 2), "others go on"


def test_a_state_may_only_be_so_large(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "MOST", 1000)
    flatten(Holder(thing=np.zeros(1000, np.int8)))
    with pytest.raises(UsageError, match=r"Holder cannot be saved as weights: there are 1.01e-06 GB"):
        flatten(Holder(thing=np.zeros(1008, np.int8)))


@pytest.mark.parametrize("damage", [b"", b"{}", b"\0" * 200])
def test_a_damaged_file_is_named(damage: bytes, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(damage)
    with pytest.raises(RunError, match=r"w\.safetensors does not hold weights"):
        weights.read(path)
    weights.write(path, flatten(Holder(thing=np.ones(1000))))
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(RunError, match=r"w\.safetensors does not hold weights"):
        weights.read(path)
    with pytest.raises(RunError, match=r"cannot read .*nothing"):
        weights.read(tmp_path / "nothing")


@pytest.mark.parametrize("tree", ["[" * 100_000 + "]" * 100_000, '"x"', "{", None])
def test_a_file_of_others_is_named(tree: str | None, tmp_path: Path) -> None:
    path = tmp_path / "w.safetensors"
    path.write_bytes(safetensors.torch.save({"a": torch.ones(2)}, None if tree is None else {"tree": tree}))
    with pytest.raises(RunError, match=r"w\.safetensors does not hold weights"):
        weights.read(path)
    path.write_bytes(safetensors.torch.save({"a": torch.ones(2, dtype=torch.bfloat16)}, {"tree": "{}"}))
    with pytest.raises(RunError, match=r"w\.safetensors does not hold weights"):
        weights.read(path)
