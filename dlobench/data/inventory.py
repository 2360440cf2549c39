"""Lists what is on disk of a set by reading folders alone: possible shards are never asked for one by one."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from dlobench.data.domain_set import SCALES, DomainSet, ScaleName, Unit
from dlobench.data.store import Store
from dlobench.errors import RunError

Places = dict[int, list[range]]  # of each domain, the first trajectories of its shards

_SHARD = re.compile(r"(\d{7})\.(npy|json)")


@dataclass
class Folder:
    """Holds what lies in the folder of one domain, in the order of its names."""

    sealed: list[Unit] = field(default_factory=list)  # with a sidecar, whether or not it is right
    halves: list[Unit] = field(default_factory=list)  # arrays without a sidecar: a killed process left them, or a loss
    temporary: list[Path] = field(default_factory=list)  # half-written by what was killed, or being written right now
    strays: list[Path] = field(default_factory=list)  # that no shard of this set is called


def places(of: DomainSet, scale: ScaleName) -> Places:
    """Returns where the shards of a scale belong."""
    found: Places = {}
    for span in of.spans(scale):
        found.setdefault(span.domain, []).append(
            range(span.first - span.first % of.block, span.first + span.count, of.block)
        )
    return found


def within(places: Places, unit: Unit) -> bool:
    """Tells whether a shard belongs to some places."""
    return any(unit.first in each for each in places.get(unit.domain, ()))


def folders(store: Store, of: DomainSet) -> Iterator[Folder]:
    """Yields what is there of a set, domain after domain; memory does not grow with their number."""
    known = [places(of, scale) for scale in SCALES]
    names = listed(store.root / of.key)
    for name in names:
        path = store.root / of.key / name
        if re.fullmatch(r"\d{5}", name) and any(int(name) in each for each in known):
            yield _folder(of, path, known)
        elif _temporary(name):
            yield Folder(temporary=[path])
        elif path.is_dir():  # files beside the domains are tables and cards
            yield Folder(strays=[path])


def _folder(of: DomainSet, path: Path, known: list[Places]) -> Folder:
    out, names = Folder(), listed(path)
    here = set(names)
    for name in names:
        match = _SHARD.fullmatch(name)
        unit = Unit(of.name, int(path.name), int(match[1]), of.block) if match else None
        if unit is None or not any(within(each, unit) for each in known):
            (out.temporary if _temporary(name) else out.strays).append(path / name)
        elif name.endswith(".json"):
            out.sealed.append(unit)
        elif f"{name.removesuffix('.npy')}.json" not in here:
            out.halves.append(unit)
    return out


def sealed(folder: Path) -> set[int]:
    """Returns the first trajectories of the shards in the folder of a domain that have a sidecar."""
    matches = (_SHARD.fullmatch(name) for name in listed(folder) if name.endswith(".json"))
    return {int(match[1]) for match in matches if match}


def other_versions(store: Store, of: DomainSet) -> list[str]:
    """Returns the folders of this set that another version of it, of the world or of the engine has made."""
    return [name for name in listed(store.root) if re.match(rf"{re.escape(of.name)}-v\d", name) and name != of.key]


def listed(folder: Path) -> list[str]:
    """Returns the sorted names in a folder, none where there is no folder; raises `RunError` where it is unreadable."""
    try:
        with os.scandir(folder) as entries:
            return sorted(entry.name for entry in entries)
    except FileNotFoundError:
        return []
    except OSError as error:
        raise RunError(f"cannot read {folder}: {error.strerror}") from error


def _temporary(name: str) -> bool:
    return name.startswith(".") and name.endswith(".tmp")
