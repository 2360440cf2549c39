"""Reads a domain in the original layout, and takes nothing in it on trust: files may come from anywhere.

What the layout does not say is inferred from the motion (which boxes a body is made of), or assumed and said so.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NoReturn

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError

from dlobench import ranges
from dlobench.data.domain_set import PUSHES, Cell
from dlobench.data.original import COMMANDED, CYLINDER, EXECUTED, ORIENTATIONS, PARAMS, POSITIONS, YAWS
from dlobench.domain import BOX_SIZE, LENGTHS, MAX_BODIES, MAX_BOXES, MAX_SEGMENTS, SEGMENT_LENGTH, Attachment, Material
from dlobench.errors import RunError, UsageError
from dlobench.trajectories import Geometry, Trajectories

Array = NDArray[np.float64]
Box = tuple[float, float, float, float, float]  # in its body's frame: x m, y m, yaw rad, half sizes m
Boxes = tuple[tuple[Box, ...], ...]  # of each body

RIGID = 1e-4  # m, by which a box may move in the frame of a body and still be taken for a part of it
DIGITS = 7  # of a box's pose, m and rad: float32 has no more


class _Dlo(BaseModel):
    length: Annotated[float, Field(strict=True, allow_inf_nan=False)]  # m
    material_type: Material
    attachment: Attachment


class _Params(BaseModel):
    domain_id: Annotated[int, Field(strict=True)]
    dlo: _Dlo
    rigid_objects: Annotated[list[Any], Field(max_length=MAX_BODIES)]  # an entry may be anything


@dataclass(frozen=True)
class Recorded:
    """Holds what a folder of the layout says of its domain."""

    id: int
    cell: Cell
    boxes: Boxes
    params: dict[str, Any]  # `params.json` as it is
    assumed: tuple[str, ...]  # what the folder does not say
    sha256: str  # of its files
    trajectories: Trajectories


def folders(root: Path) -> list[Path]:
    """Returns the folders of the domains of a folder of the layout; raises `UsageError` for what is none."""
    try:
        found = sorted(path for path in root.iterdir() if not path.name.startswith("."))
    except OSError as error:
        raise UsageError(f"cannot read the folder --original {root}: {error.strerror}") from error
    for path in found:
        if not (path.is_dir() and len(path.name) == 5 and path.name.isascii() and path.name.isdigit()):
            raise UsageError(f"{path} is no folder of a domain, which five digits name as in 00017; move it away")
    if not found:
        raise UsageError(f"--original {root} holds no domains: folders named by five digits, as in 00017")
    return found


def read(folder: Path) -> Recorded:
    """Reads the folder of a domain; raises `RunError`, naming file and fault, for whatever is not the layout."""
    sha256, (params, about) = _digest(folder), _params(folder)
    length, count = _length(folder, params.dlo.length), len(params.rigid_objects)
    segments = round(length / SEGMENT_LENGTH)

    positions = _array(folder / POSITIONS, (None, PUSHES + 1, None, 2))
    K, _, rows, _ = positions.shape
    boxes = rows - 1 - segments - count
    if not count <= boxes <= count * MAX_BOXES:
        _refuse(
            folder / POSITIONS,
            f"{rows} rows are not 1 pusher, {segments} segments, {count} bodies and 1–{MAX_BOXES} boxes of each",
        )
    quaternions = _array(folder / ORIENTATIONS, (K, PUSHES + 1, None, 4))
    turned = quaternions.shape[2]
    if turned < count:
        _refuse(folder / ORIENTATIONS, f"{turned} rows are less than its {count} bodies")
    whole = turned == rows  # an orientation of everything, not of bodies alone
    yaws = _yaws(folder / ORIENTATIONS, quaternions if whole else quaternions[:, :, turned - count :])

    commanded = _array(folder / COMMANDED, (K, PUSHES, 2))
    executed = _optional(folder / EXECUTED, (K, PUSHES, 2))
    along = _optional(folder / YAWS, (K, PUSHES + 1, segments))
    cylinder = _optional(folder / CYLINDER, (K, PUSHES + 1, 3))
    assumed = {
        "boxes measure 15 mm": count > 0,
        "boxes lie as their bodies": count > 0 and not whole,
        "what was executed is what was commanded": executed is None,
        "a segment lies as its neighbours' centres do": along is None and not whole,
        "the cylinder is at 0": cylinder is None and params.dlo.attachment != "none",
    }

    pusher, centres, places, bodies = np.split(positions, [1, 1 + segments, rows - count], axis=2)
    bodies = np.concatenate([bodies, yaws[:, :, yaws.shape[2] - count :, None]], axis=-1)
    if along is None:
        slope = np.gradient(centres, axis=2)
        along = yaws[:, :, 1 : 1 + segments] if whole else np.arctan2(slope[..., 1], slope[..., 0])
    found = _boxes(folder, places, yaws[:, :, 1 + segments : rows - count] if whole else None, bodies)
    dlo_mask, body_mask, geometry = visible(length, found)
    return Recorded(
        id=params.domain_id,
        cell=Cell(params.dlo.material_type, params.dlo.attachment, length, count),
        boxes=found,
        params=about,
        assumed=tuple(text for text, needed in assumed.items() if needed),
        sha256=sha256,
        trajectories=Trajectories(
            dlo=_padded(np.concatenate([centres, along[..., None]], axis=-1), MAX_SEGMENTS),
            dlo_mask=dlo_mask,
            pusher=pusher[:, :, 0].astype(np.float32),
            bodies=_padded(bodies, MAX_BODIES),
            body_mask=body_mask,
            boxes=geometry,
            commanded=commanded.astype(np.float32),
            executed=(commanded if executed is None else executed).astype(np.float32),
            cylinder=(np.zeros((K, PUSHES + 1, 3)) if cylinder is None else cylinder).astype(np.float32),
        ),
    )


def visible(length: float, boxes: Boxes) -> Geometry:
    """Returns what is visible of a domain: dlo_mask (32,), body_mask (3,) and boxes (3, 5, 5)."""
    out = np.zeros((MAX_BODIES, MAX_BOXES, 5), np.float32)
    for row, of_body in zip(out, boxes, strict=False):
        row[: len(of_body)] = of_body
    return np.arange(MAX_SEGMENTS) < round(length / SEGMENT_LENGTH), np.arange(MAX_BODIES) < len(boxes), out


def _digest(folder: Path) -> str:
    """Returns one SHA-256 of all files that are read."""
    out = hashlib.sha256()
    for name in (PARAMS, POSITIONS, ORIENTATIONS, COMMANDED, EXECUTED, YAWS, CYLINDER):
        if name in (PARAMS, POSITIONS, ORIENTATIONS, COMMANDED) or (folder / name).exists():
            try:
                with (folder / name).open("rb") as file:
                    out.update(name.encode() + hashlib.file_digest(file, "sha256").digest())
            except OSError as error:
                raise RunError(f"cannot read {folder / name}: {error.strerror}") from error
    return out.hexdigest()


def _params(folder: Path) -> tuple[_Params, dict[str, Any]]:
    path = folder / PARAMS

    def number(word: str) -> NoReturn:
        raise ValueError(f"{word} is no number")

    try:
        about = json.loads(path.read_bytes(), parse_constant=number)
        params = _Params.model_validate(about)
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"])) or "the file"
        _refuse(path, f"{where} = {ranges.shown(first['input'])}: {first['msg']}")
    except (ValueError, RecursionError) as error:
        raise RunError(f"{path} is no JSON: {error}") from error
    if params.domain_id != int(folder.name):
        _refuse(path, f"domain_id = {params.domain_id} is not that of its folder")
    return params, about


def _length(folder: Path, given: float) -> float:
    """Returns the whole centimetres that are meant, m, as the very float that cells are told by."""
    for length in LENGTHS:
        if math.isclose(length, given, rel_tol=0, abs_tol=1e-6):
            return length
    return _refuse(folder / PARAMS, f"dlo.length = {given} m is not a whole centimetre from 0.10 to 0.16 m")


def _optional(path: Path, shape: tuple[int | None, ...]) -> Array | None:
    return _array(path, shape) if path.exists() else None


def _array(path: Path, shape: tuple[int | None, ...]) -> Array:
    """Reads a finite array of a shape, whose None may be any number; never unpickles."""
    try:
        with path.open("rb") as file:
            if file.read(6) != b"\x93NUMPY":
                _refuse(path, "it is no .npy file")
        found = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror or error}") from error
    except (ValueError, EOFError, OverflowError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise RunError(f"{path} holds no plain array: {error}") from error
    wanted = tuple("any" if size is None else size for size in shape)
    fits = found.ndim == len(shape) and all(size in (None, has) for size, has in zip(shape, found.shape, strict=True))
    if not fits or not len(found):
        _refuse(path, f"its shape {found.shape} is not ({', '.join(map(str, wanted))})")
    if found.dtype.kind != "f":
        _refuse(path, f"{found.dtype} are no floats")
    out = np.array(found, float)
    if not (np.abs(out) < np.finfo(np.float32).max).all():  # NaN is not less
        _refuse(path, "not all of its values are finite")
    return out


def _yaws(path: Path, quaternions: Array) -> Array:
    """Returns the rotation about z of quaternions xyzw, rad."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    if not np.allclose(x**2 + y**2 + z**2 + w**2, 1, rtol=0, atol=1e-3):
        _refuse(path, "not all of its quaternions are of length 1")
    return np.asarray(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2)))


def _boxes(folder: Path, places: Array, yaws: Array | None, bodies: Array) -> Boxes:
    """Tells which boxes belong to which body: a box keeps its place in its body's frame at all times."""
    out: list[list[Box]] = [[] for _ in range(bodies.shape[2])]
    c, s = np.cos(bodies[..., 2]), np.sin(bodies[..., 2])
    for number in range(places.shape[2]):
        x, y = np.moveaxis(places[:, :, number, None] - bodies[..., :2], -1, 0)
        local = np.stack([c * x + s * y, c * y - s * x])  # (2, K, T+1, bodies)
        middle = local.mean(axis=(1, 2), keepdims=True)
        owners = np.flatnonzero(np.abs(local - middle).max(axis=(0, 1, 2)) < RIGID)
        if len(owners) != 1:
            what = "no body" if not len(owners) else f"bodies {', '.join(map(str, owners))} alike"
            _refuse(folder / POSITIONS, f"box {number} moves with {what}, so that its own cannot be told")
        body = int(owners[0])
        apart = 0.0 if yaws is None else yaws[:, :, number] - bodies[:, :, body, 2]
        yaw = math.atan2(float(np.mean(np.sin(apart))), float(np.mean(np.cos(apart))))
        pose = [round(float(value), DIGITS) + 0.0 for value in (*middle[:, 0, 0, body], yaw)]
        out[body].append((pose[0], pose[1], pose[2], BOX_SIZE / 2, BOX_SIZE / 2))
    for number, found in enumerate(out):
        if not 1 <= len(found) <= MAX_BOXES:
            _refuse(folder / POSITIONS, f"{len(found)} boxes move with body {number}, it has 1–{MAX_BOXES}")
    return tuple(map(tuple, out))


def _padded(rows: Array, size: int) -> NDArray[np.float32]:
    out = np.zeros((*rows.shape[:2], size, 3), np.float32)
    out[:, :, : rows.shape[2]] = rows
    return out


def _refuse(path: Path, why: str) -> NoReturn:
    raise RunError(f"{path}: {why}")
