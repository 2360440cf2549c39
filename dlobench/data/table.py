"""Tabulates the domains of a set: a row a domain, what is sampled and what it holds, SI units in the names.

What is not known of a domain, since it was recorded elsewhere, is absent.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from dlobench.data.domain_set import PARTS, SCALES, DomainSet, ScaleName
from dlobench.data.imported_set import ImportedSet
from dlobench.data.store import Store, atomic_write
from dlobench.domain import MAX_BODIES, SEGMENT_LENGTH, Domain

if TYPE_CHECKING:
    from pathlib import Path

    import pandas as pd
    import pyarrow as pa

NAME = "domains.parquet"

# What the columns hold, in their order. Columns of scales follow: `small_train_trajectories` and its like.
COLUMNS = {
    "id": "the domain's name, as in meta-learning/17",
    "set": "the set",
    "domain": "the domain's number in its set",
    "cell": "what all domains of a cell share: material, attachment, length, number of rigid bodies",
    "parts": "which parts its trajectories belong to: train, valid, test",
    "material": "soft, flexible or elastoplastic",
    "attachment": "what one end of the DLO is attached to: none, a movable or a fixed cylinder",
    "length_m": "length of the DLO, m",
    "rigid_objects": "number of rigid bodies",
    "segments": "number of recorded segments of the DLO, 5 mm each",
    "surface_friction": "friction coefficient of everything on the table",
    "density_kg_per_m3": "density of the DLO, kg/m³",
    "bending_stiffness_N_m2": "bending stiffness EI of the DLO, N m²",
    "yield_curvature_per_m": "curvature at which the DLO yields, 1/m; absent where it never does",
}
BODY_COLUMNS = {
    "shape": "shape of rigid body {}; absent where there is none",
    "densities_kg_per_m3": "densities of its boxes, kg/m³",
    "friction": "its friction coefficient",
}


def about_columns() -> dict[str, str]:
    """Returns what every column of the table holds."""
    bodies = {f"body{i}_{name}": text.format(i) for i in range(MAX_BODIES) for name, text in BODY_COLUMNS.items()}
    held = [(scale, part) for scale in SCALES for part in PARTS]
    scales = {f"{scale}_{part}_trajectories": f"trajectories of part {part} at scale {scale}" for scale, part in held}
    return COLUMNS | bodies | scales


def domains_table(of: DomainSet, *scales: ScaleName) -> pd.DataFrame:
    """Returns a row for each domain that the scales reach, in the order of their numbers; by default of all scales."""
    import pandas as pd

    scales = scales or SCALES
    wanted = [name for name in about_columns() if name.split("_")[0] not in SCALES or name.split("_")[0] in scales]
    frame = pd.DataFrame(list(_rows(of, scales)), columns=wanted)
    shapes = [name for name in wanted if name.endswith("_shape")]
    return frame.astype(dict.fromkeys(shapes, "str") | {name: object for name in wanted if "_densities_" in name})


def write(store: Store, of: DomainSet) -> Path:
    """Writes the table of all domains beside the shards of a set: the same bytes whenever it is written."""
    path = store.root / of.key / NAME
    atomic_write(path, content(of))
    return path


def content(of: DomainSet) -> bytes:
    """Returns the table of all domains as a Parquet file."""
    import pyarrow as pa  # heavy
    import pyarrow.parquet as pq

    schema = pa.schema([(name, _arrow_type(name)) for name in about_columns()], {"set": of.key})
    buffer = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(list(_rows(of, SCALES)), schema), buffer, compression="zstd")
    return buffer.getvalue()


def _arrow_type(name: str) -> pa.DataType:
    """Returns the type of a column of the file."""
    import pyarrow as pa

    if name in ("domain", "rigid_objects", "segments") or name.endswith("_trajectories"):
        return pa.int32()
    if name in ("id", "set", "cell", "parts", "material", "attachment") or name.endswith("_shape"):
        return pa.string()
    return pa.list_(pa.float64()) if "_densities_" in name else pa.float64()


def _rows(of: DomainSet, scales: tuple[ScaleName, ...]) -> Iterator[dict[str, Any]]:
    """Yields the row of each domain; bodies that are not there are left out."""
    counts = {scale: {(span.domain, span.part): span.count for span in of.spans(scale)} for scale in scales}
    held = set[tuple[int, str]]().union(*counts.values())
    for index in sorted({domain for domain, _ in held}):
        row: dict[str, Any] = {"id": f"{of.name}/{index}", "set": of.name, "domain": index, "cell": str(of.cell(index))}
        row["parts"] = " ".join(part for part in PARTS if (index, part) in held)
        for scale in scales:
            row |= {f"{scale}_{part}_trajectories": counts[scale].get((index, part), 0) for part in PARTS}
        cell = of.cell(index)
        row |= {"material": cell.material, "attachment": cell.attachment, "length_m": cell.length}
        row |= {"rigid_objects": cell.rigid_objects, "segments": round(cell.length / SEGMENT_LENGTH)}
        yield row if isinstance(of, ImportedSet) else row | _parameters(of.domain(index))


def _parameters(domain: Domain) -> dict[str, Any]:
    """Returns the columns that tell what nobody knows of a domain that was recorded elsewhere."""
    row: dict[str, Any] = {
        "surface_friction": domain.surface_friction,
        "density_kg_per_m3": domain.density,
        "bending_stiffness_N_m2": domain.bending_stiffness,
        "yield_curvature_per_m": domain.yield_curvature,
    }
    for i, body in enumerate(domain.bodies):
        row |= {
            f"body{i}_shape": body.shape,
            f"body{i}_densities_kg_per_m3": list(body.densities),
            f"body{i}_friction": body.friction,
        }
    return row
