"""Keeps some predictions of every cell beside the record, with the truth, so that anyone can score them again.

Which windows are kept follows from the task, the domain and the horizon alone, so that no model chooses its own. They
are those of the first support.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.bench import metrics, sampled
from dlobench.bench.questions import Domain
from dlobench.bench.record import Sample
from dlobench.bench.statistics import generator
from dlobench.bench.task import Task
from dlobench.data.store import atomic_write
from dlobench.domain import MAX_SEGMENTS
from dlobench.errors import RunError
from dlobench.trajectories import Floats, Mask, Prediction

WINDOWS = 32  # kept of a cell, or one of every domain where there are more domains
SAMPLES = 16  # kept of a window, at most, of what is predicted and of what is true


@dataclass(frozen=True)
class Kept:
    """Holds some windows of one domain in one cell."""

    cell: str
    domain: str  # set/index
    windows: NDArray[np.int32]  # (W,)  their numbers among all that are scored
    mask: Mask  # (32,)
    start: Floats  # (W, 32, 2)  m, where the segments really were
    true: Floats  # (M, W, 32, 2)  m
    dlo: Floats  # (S, W, 32, 2)  m, as predicted


def keep(cell: str, domain: Domain, horizon: int, rows: NDArray[np.int32], answer: Prediction) -> Kept:
    """Returns some windows of a domain, with what was answered."""
    question, mask = domain.question, domain.question.query.dlo_mask
    true = question.truths[horizon].dlo[:SAMPLES, rows]
    dlo = np.where(mask[:, None], answer.dlo[:SAMPLES, rows], 0).astype(np.float32)
    return Kept(cell, domain.name, rows, mask, question.start[rows], true, dlo)


def domains(task: Task, horizon: int, names: Sequence[str]) -> list[str]:
    """Returns the domains of a cell that windows are kept of, sorted."""
    ordered = sorted(names)
    if len(ordered) <= WINDOWS:
        return ordered
    rng = generator("kept domains", task.name, task.version, horizon, *ordered)
    return [ordered[i] for i in sorted(rng.choice(len(ordered), WINDOWS, replace=False))]


def windows(task: Task, horizon: int, domain: str, there: int, kept_domains: int) -> NDArray[np.int32]:
    """Returns the numbers of the windows, of so many, to keep of one of the domains that are kept, sorted."""
    count = min(there, max(1, WINDOWS // kept_domains))
    rng = generator("kept", task.name, task.version, horizon, domain)
    return np.sort(rng.choice(there, count, replace=False)).astype(np.int32)


def score(kept: Sequence[Kept], *, samples: bool) -> Sample:
    """Returns the scores of the kept windows of a cell: means over its domains, in the order given."""

    def mean(values: list[Any]) -> float:
        return float(np.mean(values))

    points = [(one.dlo.mean(axis=0, dtype=np.float64) if len(one.dlo) > 1 else one.dlo[0], one) for one in kept]
    return Sample(
        windows=sum(len(one.windows) for one in kept),
        mse=mean([np.mean([metrics.mse(dlo, true, one.mask) for true in one.true]) for dlo, one in points]),
        euclidean=mean([np.mean([metrics.euclidean(dlo, true, one.mask) for true in one.true]) for dlo, one in points]),
        energy=mean([sampled.energy(one.dlo, one.true, one.mask) for one in kept]) if samples else None,
    )


def write(path: Path, kept: Sequence[Kept]) -> None:
    """Writes kept windows as safetensors, whole or not at all; what is true of a domain and horizon stands there once.

    The tensors hold one row after the other, of valid segments alone; the metadata says which rows are whose.
    """
    from safetensors.numpy import save

    cells, names = (list(dict.fromkeys(values)) for values in ([k.cell for k in kept], [k.domain for k in kept]))
    truths = dict[bytes, Kept]()
    rows = []
    for one in kept:
        key = b"\0".join(x.tobytes() for x in (one.windows, one.mask, one.start, one.true)) + one.domain.encode()
        truths.setdefault(key, one)
        rows.append([cells.index(one.cell), names.index(one.domain), list(truths).index(key), len(one.dlo)])
    true = list(truths.values())
    tensors: dict[str, NDArray[Any]] = {
        "windows": np.concatenate([one.windows for one in true]),
        "mask": np.stack([one.mask for one in true]),
        "start": np.concatenate([one.start[:, one.mask].reshape(-1, 2) for one in true]),
        "true": np.concatenate([one.true[:, :, one.mask].reshape(-1, 2) for one in true]),
        "dlo": np.concatenate([one.dlo[:, :, one.mask].reshape(-1, 2) for one in kept]),
    }
    sizes = [[len(one.windows), len(one.true)] for one in true]
    said = {"cells": cells, "domains": names, "truths": sizes, "kept": rows}
    atomic_write(path, save(tensors, metadata={"rows": json.dumps(said)}))  # several keys would come in any order


def read(path: Path) -> list[Kept]:
    """Reads kept windows; raises `RunError` for what is no such file."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            said = json.loads((file.metadata() or {})["rows"])
            tensors = {name: file.get_tensor(name) for name in ("windows", "mask", "start", "true", "dlo")}
        return _unpacked(said, tensors)
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    except (SafetensorError, KeyError, ValueError, TypeError, IndexError, AttributeError) as error:
        raise RunError(f"{path} does not hold kept predictions: {type(error).__name__}: {error}") from error


def _unpacked(said: dict[str, Any], tensors: dict[str, NDArray[Any]]) -> list[Kept]:
    masks, at = tensors["mask"], dict.fromkeys(tensors, 0)

    def rows(name: str, mask: Mask, *shape: int) -> Floats:
        count = math.prod(shape) * int(mask.sum())
        flat = tensors[name][at[name] : at[name] + count]
        at[name] += count
        out = np.zeros((*shape, MAX_SEGMENTS, 2), np.float32)
        out[..., mask, :] = flat.reshape(*shape, -1, 2)
        return out

    truths = []
    for mask, (W, M) in zip(masks, said["truths"], strict=True):
        if mask.shape != (MAX_SEGMENTS,) or mask.dtype != np.bool_ or not mask.any() or min(W, M) < 1:
            raise ValueError(f"a truth of {W} windows, {M} samples and a mask of {mask.dtype} {mask.shape}")
        numbers = tensors["windows"][at["windows"] : at["windows"] + W]
        at["windows"] += W
        truths.append((numbers, mask, rows("start", mask, W), rows("true", mask, M, W)))
    kept = []
    for cell, domain, truth, S in said["kept"]:
        numbers, mask, start, true = truths[truth]
        dlo = rows("dlo", mask, S, len(numbers))
        kept.append(Kept(said["cells"][cell], said["domains"][domain], numbers, mask, start, true, dlo))
    if any(len(array) != at[name] for name, array in tensors.items() if name != "mask"):
        raise ValueError("it holds more rows than it says")
    return kept
