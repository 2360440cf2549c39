"""Writes the original DLO@Scale layout: a folder a domain, which the authors' own loader reads.

`<domain id, five digits>/` holds `params.json`, positions (K, 21, 1 + segments + boxes + bodies, 2) m in the order
pusher, DLO segments, boxes, bodies; quaternions xyzw of the bodies; and commanded displacements (K, 20, 2) m. What that
cannot hold stands beside it in files of our own, which that loader does not open; docs/adr/0011 has the details.
"""

from __future__ import annotations

import io
import json
import shutil
import uuid
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dlobench.data.domain_set import PUSHES, DomainSet, Part, ScaleName, Span
from dlobench.data.status import status
from dlobench.data.store import Store, atomic_write
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Trajectories, concatenate

PARAMS = "params.json"
POSITIONS, ORIENTATIONS, COMMANDED = "data_pos_all.npy", "data_or_all.npy", "data_true_action_all.npy"
# Files of our own: executed displacements, yaws of the DLO's segments, and what an attached DLO ends in.
EXECUTED, YAWS, CYLINDER = "data_executed_action_all.npy", "data_segment_yaw_all.npy", "data_cylinder_all.npy"

Plan = Mapping[int, Sequence[Span]]  # what to export of each domain
Progress = Callable[[int, int], None]  # domains done, domains to do in all


def arrays(trajectories: Trajectories) -> dict[str, NDArray[Any]]:
    """Returns the arrays of the layout, and those of ours, by the names of their files."""
    if trajectories.cylinder is None:
        raise ValueError("trajectories without the cylinder are not whole")
    bodies = trajectories.bodies[:, :, trajectories.body_mask].astype(float)
    c, s = np.cos(bodies[..., 2]), np.sin(bodies[..., 2])
    boxes = [
        bodies[:, :, number, :2] + np.stack([c * x - s * y, s * x + c * y], axis=-1)[:, :, number]
        for number, of_body in enumerate(trajectories.boxes[trajectories.body_mask].astype(float))
        for x, y, *_ in of_body[of_body[:, 3] > 0]
    ]
    rows = [trajectories.pusher[:, :, None], trajectories.dlo[:, :, trajectories.dlo_mask, :2]]
    rows += [*(box[:, :, None] for box in boxes), bodies[..., :2]]
    half = bodies[..., 2] / 2
    return {
        POSITIONS: np.concatenate(rows, axis=2).astype(np.float32),
        ORIENTATIONS: np.stack([0 * half, 0 * half, np.sin(half), np.cos(half)], axis=-1),
        COMMANDED: trajectories.commanded,
        EXECUTED: trajectories.executed,
        YAWS: trajectories.dlo[:, :, trajectories.dlo_mask, 2],
        CYLINDER: trajectories.cylinder,
    }


def params(of: DomainSet, spans: Sequence[Span]) -> dict[str, Any]:
    """Returns the `params.json` of one domain; what its readers do not ask for stands under `dlobench`."""
    index = spans[0].domain
    cell, definition = of.cell(index), of.definition(index)
    return {
        "domain_id": index,
        # The loader counts int(length * 200) segments and looks cells up by these very floats.
        "dlo": {"length": cell.length, "material_type": cell.material, "attachment": cell.attachment},
        "rigid_objects": definition["bodies"],
        "dlobench": {
            "set": of.key,
            "domain": definition,
            "trajectories": [[span.part, span.first, span.count] for span in spans],
        },
    }


def write(folder: Path, about: Mapping[str, Any], trajectories: Trajectories) -> None:
    """Writes the folder of a domain, whole or not at all; one that holds just that already is left alone.

    Raises `UsageError` where something else is there, `RunError` when the disk refuses.
    """
    content = {PARAMS: _json(about)} | {name: _npy(array) for name, array in arrays(trajectories).items()}
    root = folder.parent
    staging = root.with_name(f".{root.name}.{uuid.uuid4().hex}.tmp")  # the loader opens whatever lies in the root
    try:
        if _occupied(folder):
            if any(_content(folder / name) != content[name] for name in content):
                raise UsageError(f"{folder} holds something else; export into another folder")
            return
        try:
            for name, each in content.items():
                atomic_write(staging / folder.name / name, each)
            root.mkdir(parents=True, exist_ok=True)
            (staging / folder.name).rename(folder)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    except OSError as error:
        raise RunError(f"cannot write {folder}: {error.strerror}") from error


def plan(
    store: Store, of: DomainSet, scale: ScaleName, folder: Path, *, domains: int | None = None, part: Part | None = None
) -> Plan:
    """Returns what to export of a set, all parts or one, after every check that can be made before writing.

    Raises `UsageError` for a set that the layout cannot hold and for a folder that holds something else, `RunError` for
    shards that are missing or broken.
    """
    if of.pushes != PUSHES:
        raise UsageError(f"{of.name} has {of.pushes} pushes a trajectory, the original layout holds just {PUSHES}")
    found: dict[int, list[Span]] = {}
    for span in of.spans(scale):
        if part in (None, span.part):
            found.setdefault(span.domain, []).append(span)
    if domains is not None and not 1 <= domains <= len(found):
        raise UsageError(f"--domains {domains} is outside 1–{len(found)}, what {of.name}/{scale} has")
    chosen = {index: found[index] for index in list(found)[:domains]}
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"--original {folder} is not a folder")
    for index, spans in chosen.items():
        place = folder / f"{index:05d}"
        if _occupied(place) and _content(place / PARAMS) != _json(params(of, spans)):
            raise UsageError(f"{place} holds something else; export into another folder")
    there = status(store, of, of.units(span for spans in chosen.values() for span in spans))
    for unit, why in there.broken.items():
        raise RunError(
            f"shard {store.path(of, unit)} is broken ({why}); `dlobench data repair {of.name}` makes it again"
        )
    if there.pending:
        raise RunError(
            f"{len(there.pending)} of {len(there.pending) + len(there.done)} shards are still to be made; "
            f"`dlobench generate {of.name} --scale {scale}` does it"
        )
    return chosen


def export(store: Store, of: DomainSet, chosen: Plan, folder: Path, progress: Progress) -> None:
    """Writes what was planned, domain after domain; raises `RunError` when the disk refuses."""
    for done, (index, spans) in enumerate(chosen.items()):
        progress(done, len(chosen))
        trajectories = concatenate([store.load_span(of, span) for span in spans])
        write(folder / f"{index:05d}", params(of, spans), trajectories)
    progress(len(chosen), len(chosen))


def _occupied(folder: Path) -> bool:
    return folder.is_file() or (folder.is_dir() and any(folder.iterdir()))


def _content(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _json(about: Mapping[str, Any]) -> bytes:
    return json.dumps(about, indent=1).encode()


def _npy(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.ascontiguousarray(array), allow_pickle=False)
    return buffer.getvalue()
