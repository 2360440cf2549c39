"""Brings sets that were recorded elsewhere, in the original layout, into the data folder, and finds them there.

The shards are like all others; `<set key>.set.json` beside their folder defines the set and is written last.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NoReturn

from pydantic import ValidationError

from dlobench import ranges
from dlobench.data.domain_set import Span
from dlobench.data.imported_set import DOMAINS, VERSION, ImportedDomain, ImportedSet
from dlobench.data.original import Progress
from dlobench.data.recorded import Recorded, read
from dlobench.data.sets import SETS
from dlobench.data.status import status
from dlobench.data.store import Store, atomic_write
from dlobench.errors import RunError, UsageError


def check_name(name: str) -> None:
    """Raises `UsageError` for what a set cannot be called."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,63}", name) or name in SETS:
        raise UsageError(
            f"--name {ranges.shown(name)} is not of letters, digits and _ . - alone, or is one of {', '.join(SETS)}"
        )


def import_set(store: Store, found: Sequence[Path], name: str, progress: Progress) -> ImportedSet:
    """Reads folders of domains in the original layout into the data folder; what is there already stays.

    All of it is read and checked before anything is written. Raises `UsageError` for a name that is taken, `RunError`
    for what is not the layout, and when the disk refuses.
    """
    check_name(name)
    total = 2 * len(found)
    domains: dict[int, ImportedDomain] = {}
    for done, folder in enumerate(found):
        progress(done, total)
        one = read(folder)
        domains[one.id] = _known(one)
    of = ImportedSet.make(name, domains)
    for other in imported_sets(store):
        if other.name == name and other.key != of.key:
            raise UsageError(f"--name {name} is that of another imported set, {other.key}; give this one another name")
    for done, folder in enumerate(found, start=len(found)):
        progress(done, total)
        one = read(folder)
        if of.domains[one.id] != _known(one):
            raise RunError(f"{folder} changed while it was imported; import it again")
        units = list(of.units([Span(one.id, "train", 0, len(one.trajectories))]))
        whole = status(store, of, units, every_byte=True).done
        for unit in units:
            if unit not in whole:
                rows = slice(unit.first, unit.first + unit.count)
                store.write(of, unit, one.trajectories.take(rows), {"imported": unit.count}, 0.0)
    about = {"name": name, "version": VERSION, "domains": DOMAINS.dump_python(dict(of.domains), mode="json")}
    atomic_write(_path(store, of), json.dumps(about, indent=1).encode())
    progress(total, total)
    return of


def imported_sets(store: Store) -> list[ImportedSet]:
    """Returns the imported sets of a data folder; raises `RunError` for a definition that was altered."""
    return [_read(store, path) for path in sorted(store.root.glob("*.set.json")) if not path.name.startswith(".")]


def find_imported(store: Store, name: str) -> ImportedSet:
    """Returns an imported set by its name; raises `UsageError` naming the choices."""
    sets = {of.name: of for of in imported_sets(store)}
    if name not in sets:
        there = f"there are: {', '.join(sets)}" if sets else "there is none"
        raise UsageError(
            f"no imported set {ranges.shown(name)} in {store.root}; {there} (`dlobench data import` makes one)"
        )
    return sets[name]


def check_whole(store: Store, of: ImportedSet, spans: Iterable[Span]) -> None:
    """Checks every byte of what is about to be read; raises `RunError` for what is missing or broken."""
    found = status(store, of, list(dict.fromkeys(of.units(spans))), every_byte=True)
    lost = [*found.pending, *found.broken]
    if lost:
        raise RunError(
            f"{len(lost)} shards of the imported set {of.name} are missing or broken, the first "
            f"{store.path(of, lost[0])}; nothing can generate them: import the set again under its name"
        )


def _known(one: Recorded) -> ImportedDomain:
    return ImportedDomain(one.cell, len(one.trajectories), one.boxes, one.params, one.assumed, one.sha256)


def _path(store: Store, of: ImportedSet) -> Path:
    return store.root / f"{of.key}.set.json"


def _read(store: Store, path: Path) -> ImportedSet:
    def refuse(why: object) -> NoReturn:
        raise RunError(f"{path} does not define an imported set ({why}); move it away and import the set again")

    try:
        about = json.loads(path.read_bytes())
        of = ImportedSet.make(about["name"], DOMAINS.validate_python(about["domains"]))
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except ValidationError as error:
        refuse(error.errors()[0]["msg"])
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        refuse(error)
    if _path(store, of) != path:
        refuse(f"it was altered, or belongs to {of.key}")
    return of
