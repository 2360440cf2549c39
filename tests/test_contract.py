"""Tests the contract: every plugin keeps it, and whoever breaks it in one point is caught by that point's check."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from dlobench.bench import contract
from dlobench.bench.plugins import load_model
from dlobench.trajectories import Trajectories

FILES = sorted((Path(__file__).parents[1] / "models").glob("[!_]*.py"))
FITS = "fits on three domains, validating on one"
PREDICTS = "predicts finite float arrays of (1, B, 32, 2)"
SAMPLED = "asked for 99 samples, predicts as many, or one"
TWICE = "predicts the same twice"
UNTOUCHED = "leaves the query as it was"
PERMUTED = "permuted queries give permuted predictions"
ADAPTS = "adapts to 1 trajectory and predicts"
UNCHANGED = "adapting leaves the model as it was"
FORGETFUL = "adapting depends on nothing before"
SEEDED = "the same seed gives the same model"
COUNTS = "counts its parameters"
ALL = [FITS, PREDICTS, SAMPLED, TWICE, UNTOUCHED, PERMUTED, ADAPTS, UNCHANGED, FORGETFUL, SEEDED, COUNTS]


@pytest.fixture(scope="module", autouse=True)
def simulated_once() -> Iterator[list[Trajectories]]:
    """Lets all checks share one simulation of the tiny set, and gives each its own copy."""
    data = contract.tiny(privileged=True)

    def copied(*, privileged: bool = False) -> list[Trajectories]:
        return [replace(each, parameters=each.parameters if privileged else None) for each in copy.deepcopy(data)]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contract, "tiny", copied)
        yield data


def test_there_are_plugins() -> None:
    assert {"persistence", "mlp", "multitask", "maml"} <= {path.stem for path in FILES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_model_keeps_the_contract(path: Path) -> None:
    if path.stem == "maml_learn2learn" and find_spec("learn2learn") is None:
        pytest.skip("learn2learn is not installed: make peers")
    outcomes = list(contract.check(load_model(str(path))))
    assert [outcome.name for outcome in outcomes] == ALL
    assert not [(outcome.name, outcome.why) for outcome in outcomes if not outcome.passed]


def test_the_tiny_set_moves_and_is_always_the_same(simulated_once: list[Trajectories]) -> None:
    again = contract.tiny()
    assert len(again) == 5
    assert len({int(part.dlo_mask.sum()) for part in again}) == 2, "two lengths"
    for one, other in zip(simulated_once, again, strict=True):
        assert (one.dlo == other.dlo).all()
        assert abs(one.dlo[:, -1] - one.dlo[:, 0]).max() > 1e-3


GOOD = """
from dataclasses import dataclass, field
import numpy as np
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction

@dataclass
class Mine(Model):
    offset: float = 0.0

    def fit(self, train, valid, setting):
        self.offset = float(np.random.default_rng(self.seed).normal())

    def adapt(self, support):
        return Mine(offset=self.offset + len(support))

    def predict(self, query, samples):
        return Prediction(dlo=query.dlo[None, ..., :2] + np.float32(self.offset))

    def parameters(self):
        return 1
"""
RETURN = "        return Pred"
THREE = """        if samples > 1:
            return Prediction(dlo=np.repeat(query.dlo[None, ..., :2], 3, axis=0))
"""
BREAKS = {
    "changes itself in adapt": ("        return Mine(offset=self.offset + len(support))",
                                "        self.offset += len(support)\n        return self", {UNCHANGED}),
    "writes into the query": (RETURN, "        query.dlo[..., 0] += 1\n        return Pred", {UNTOUCHED}),
    "writes into the actions": (RETURN, "        query.actions[:] = 0\n        return Pred", {UNTOUCHED}),
    "rolls dice": ("np.float32(self.offset)", "np.float32(np.random.default_rng().normal())", {TWICE}),
    "depends on the place in the batch": (
        "np.float32(self.offset)", "np.arange(len(query), dtype=np.float32)[:, None, None]", {PERMUTED}),
    "depends on its neighbours": ("np.float32(self.offset)", "query.actions[:1, :1] * 1000", {PERMUTED}),
    "returns NaN": ("np.float32(self.offset)", "np.float32('nan')", {PREDICTS, SAMPLED}),
    "returns NaN after adapting": ("self.offset + len(support)", "float('nan')", {ADAPTS}),
    "returns the yaw too": ("query.dlo[None, ..., :2]", "query.dlo[None]", {PREDICTS, SAMPLED}),
    "returns no samples": ("query.dlo[None, ..., :2]", "query.dlo[..., :2]", {PREDICTS, SAMPLED}),
    "forgets to return from adapt": ("return Mine(offset=self.offset + len(support))", "pass", {ADAPTS}),
    "ignores its seed": ("np.random.default_rng(self.seed)", "np.random.default_rng()", {SEEDED}),
    "raises in fit": ("self.offset = float", "raise OSError('moon')\n        self.offset = float", {FITS}),
    "raises in predict": (RETURN, "        raise OSError('moon')\n        return Pred", {PREDICTS, SAMPLED}),
    "raises in adapt": ("        return Mine(", "        raise OSError('moon')\n        return Mine(", {ADAPTS}),
    "returns three samples": (RETURN, THREE + RETURN, {SAMPLED}),
    "counts no parameters": ("        return 1", "        return None", {COUNTS}),
    "counts a negative number": ("        return 1", "        return -1", {COUNTS}),
}  # fmt: skip


def outcomes(source: str, folder: Path) -> dict[str, contract.Check]:
    """Checks a plugin given as source."""
    path = folder / "mine.py"
    path.write_text(source)
    return {outcome.name: outcome for outcome in contract.check(load_model(str(path)))}


def test_a_good_plugin_passes(tmp_path: Path) -> None:
    assert [name for name, outcome in outcomes(GOOD, tmp_path).items() if outcome.passed] == ALL


@pytest.mark.parametrize("what", BREAKS)
def test_a_broken_plugin_is_caught_by_the_check_meant_for_it(what: str, tmp_path: Path) -> None:
    part, instead, meant = BREAKS[what]
    assert GOOD.count(part) == 1
    found = outcomes(GOOD.replace(part, instead), tmp_path)
    failed = {name for name, outcome in found.items() if not outcome.passed}
    assert meant <= failed
    assert all(found[name].why for name in failed)
    if meant & {PERMUTED, SEEDED, COUNTS}:
        assert failed == meant, "nothing else is wrong with it"


def test_an_error_is_told_with_its_line(tmp_path: Path) -> None:
    part, instead, _ = BREAKS["raises in fit"]
    source = GOOD.replace(part, instead)
    line = source.splitlines().index("        raise OSError('moon')") + 1
    (only,) = outcomes(source, tmp_path).values()
    assert "OSError" in only.why
    assert f"mine.py:{line}" in only.why
    assert "moon" in only.why
