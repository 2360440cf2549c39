"""Tests what is kept of predictions: chosen by the task alone, read back as it was, scored as it says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dlobench.bench import kept
from dlobench.bench.kept import Kept
from dlobench.bench.plugins import load_task
from dlobench.errors import RunError

META = load_task("meta")


def some(seed: int, *, cell: str = "c", domain: str = "set/00001", segments: int = 20, S: int = 1, M: int = 1) -> Kept:
    """Makes windows."""
    rng = np.random.default_rng([seed, segments])
    mask = np.arange(32) < segments

    def shapes(*shape: int) -> np.ndarray:
        return np.where(mask[:, None], rng.normal(size=(*shape, 32, 2)), 0).astype(np.float32)

    truth = np.random.default_rng(sum(map(ord, domain)))
    start, true = (
        np.where(mask[:, None], truth.normal(size=(*shape, 32, 2)), 0).astype(np.float32) for shape in ((3,), (M, 3))
    )
    return Kept(cell, domain, np.array([1, 5, 8], np.int32), mask, start, true, shapes(S, 3))


def check_same(one: Kept, other: Kept) -> None:
    """Sees that two are the same to the last bit."""
    assert (one.cell, one.domain) == (other.cell, other.domain)
    for name in ("windows", "mask", "start", "true", "dlo"):
        a, b = getattr(one, name), getattr(other, name)
        assert a.dtype == b.dtype
        assert np.array_equal(a, b)


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    samples = some(4, S=16, M=5, domain="f/1", cell="e")
    written = [some(1), some(2, cell="d"), some(3, domain="set/00002", segments=32), samples]
    kept.write(tmp_path / "a", written)
    for one, other in zip(kept.read(tmp_path / "a"), written, strict=True):
        check_same(one, other)
    kept.write(tmp_path / "b", kept.read(tmp_path / "a"))
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_a_truth_that_cells_share_stands_there_once(tmp_path: Path) -> None:
    kept.write(tmp_path / "one", [some(1)])
    kept.write(tmp_path / "ten", [some(seed, cell=f"c{seed}") for seed in range(10)])
    one, ten = ((tmp_path / name).stat().st_size for name in ("one", "ten"))
    assert ten - one < 9 * (3 * 20 * 8 + 40), "nine more predictions, no more truth"


@pytest.mark.parametrize("damage", [lambda b: b[:-1], lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b"{}" * 40])
def test_a_damaged_file_is_named(damage, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "seed0.safetensors"
    kept.write(path, [some(1)])
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RunError, match=r"seed0\.safetensors"):
        kept.read(path)
    with pytest.raises(RunError, match=r"cannot read .*nothing"):
        kept.read(tmp_path / "nothing")


@given(domains=st.integers(1, 200), there=st.integers(1, 500), horizon=st.integers(1, 20))
def test_few_windows_of_many_domains_are_kept(domains: int, there: int, horizon: int) -> None:
    names = [f"set/{i:05d}" for i in range(domains)]
    chosen = kept.domains(META, horizon, names)
    assert len(chosen) == min(domains, kept.WINDOWS)
    assert set(chosen) <= set(names)
    assert chosen == kept.domains(META, horizon, names[::-1]), "whatever their order"
    rows = kept.windows(META, horizon, chosen[0], there, len(chosen))
    assert len(rows) == min(there, max(1, kept.WINDOWS // len(chosen)))
    assert len(set(rows.tolist())) == len(rows)
    assert rows.min() >= 0
    assert rows.max() < there


def test_the_kept_windows_are_scored_by_hand() -> None:
    one, other = some(1), some(2, domain="set/00002", segments=32)
    found = kept.score([one, other], samples=False)
    assert found.windows == 6
    assert found.energy is None
    errors = [(each.dlo[0] - each.true[0])[:, each.mask].astype(float) for each in (one, other)]
    assert found.mse == pytest.approx(np.mean([np.mean(error**2) for error in errors]))
    assert found.euclidean == pytest.approx(np.mean([np.sqrt((e**2).sum(-1)).mean() for e in errors]))


def test_kept_samples_have_an_energy() -> None:
    one = some(1, S=16, M=16)
    found = kept.score([one], samples=True)
    assert found.energy is not None
    x, y = (each[:, :, one.mask].reshape(16, 3, -1).astype(float) for each in (one.dlo, one.true))
    pairs = [(i, j) for i in range(16) for j in range(16)]
    between = np.mean([np.linalg.norm(x[i, w] - y[j, w]) for w in range(3) for i, j in pairs])
    within = np.mean([np.linalg.norm(x[i, w] - x[j, w]) for w in range(3) for i, j in pairs if i != j])
    assert found.energy == pytest.approx((between - within / 2) / np.sqrt(20))
