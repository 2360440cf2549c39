"""Tests that shards are simulated again and compared: by bytes where they must be the same, else by distance."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_faults import inline, quiet, tiny, units

from dlobench.data import reproduce
from dlobench.data.generate import generate
from dlobench.data.reproduce import TOLERANCE, again, chosen
from dlobench.data.sidecar import origin
from dlobench.data.store import Broken, Store
from dlobench.errors import RunError, UsageError

OF = tiny(8)
UNITS = units(OF)


@pytest.fixture
def store(tmp_path: Path) -> Store:
    store = Store(tmp_path)
    generate(store, OF, UNITS, inline, quiet)
    return store


def nudge(store: Store, distance: float) -> None:
    """Moves the DLO of the first shard, sealed as if it had been made so."""
    then = store.load(OF, UNITS[0])
    moved = then.dlo + np.array([distance, 0, 0], np.float32) * then.dlo_mask[:, None]
    store.write(OF, UNITS[0], replace(then, dlo=moved.astype(np.float32)), {}, 0.1)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """Makes this machine another than the one that wrote the shards."""
    monkeypatch.setattr(reproduce, "origin", lambda: origin() | {"cpu": {"model": "another"}})


def test_what_this_machine_made_has_the_same_bytes(store: Store) -> None:
    for one in reproduce.reproduce(store, OF, UNITS[:2], inline):
        assert (one.same_machine, one.same_bytes, one.agrees, one.mean, one.max) == (True, True, True, 0, 0)


def test_one_other_bit_is_too_much_on_the_same_machine(store: Store) -> None:
    nudge(store, 1e-7)
    one = again(UNITS[0], store, OF)
    assert (one.same_machine, one.same_bytes, one.agrees) == (True, False, False)
    assert one.held_to == "its bytes"


@pytest.mark.usefixtures("elsewhere")
def test_another_machine_is_held_to_a_distance(store: Store) -> None:
    assert again(UNITS[0], store, OF).agrees
    nudge(store, TOLERANCE / 2)
    one = again(UNITS[0], store, OF)
    assert (one.same_machine, one.same_bytes, one.agrees) == (False, False, True)
    nudge(store, TOLERANCE)
    one = again(UNITS[0], store, OF)
    assert not one.agrees
    for distance in (one.median, one.mean, one.max):
        assert distance == pytest.approx(1.5 * TOLERANCE, rel=0.01), "padding does not count"
    assert one.held_to == "a median distance of 1e-05 m"


def test_other_versions_are_another_machine(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    here = origin()
    for package, same in (("torch", True), ("numpy", False)):
        monkeypatch.setattr(
            reproduce, "origin", lambda package=package: here | {"versions": here["versions"] | {package: "0"}}
        )
        assert again(UNITS[0], store, OF).same_machine == same


def test_a_broken_shard_is_not_compared(store: Store) -> None:
    store.path(OF, UNITS[0]).write_bytes(b"")
    with pytest.raises(Broken):
        again(UNITS[0], store, OF)


def test_shards_are_spread_over_what_is_there(store: Store) -> None:
    ordered = sorted(UNITS, key=lambda unit: (unit.domain, unit.first))
    count, draws = 4, {tuple(chosen(store, OF, 4, seed=seed)) for seed in range(20)}
    assert len(draws) > 1, "the seed decides"
    for draw in draws:
        assert [ordered.index(unit) * count // len(ordered) for unit in draw] == list(range(count))
    assert chosen(store, OF, 4, seed=3) == chosen(store, OF, 4, seed=3)
    assert set(chosen(store, OF, len(UNITS), seed=0)) == set(UNITS)
    assert UNITS[0] not in chosen(store, OF, len(UNITS) - 1, seed=0, without={UNITS[0]})


def test_more_than_there_is_is_refused(store: Store) -> None:
    with pytest.raises(RunError, match=f"--regenerate {len(UNITS) + 1} is more than the {len(UNITS)} whole shards"):
        chosen(store, OF, len(UNITS) + 1, seed=0)
    with pytest.raises(UsageError, match="--regenerate = 0"):
        chosen(store, OF, 0, seed=0)
