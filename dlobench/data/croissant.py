"""Describes tables in Croissant, the JSON-LD vocabulary of MLCommons, version 1.0, so that programs can load them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import pyarrow as pa

PARQUET = "application/x-parquet"

CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_TYPES = {
    "string": "sc:Text",
    "int8": "cr:Int8",
    "int16": "cr:Int16",
    "int32": "cr:Int32",
    "int64": "cr:Int64",
    "float": "cr:Float32",
    "double": "cr:Float64",
}


def dataset(about: Mapping[str, Any], distribution: list[Any], record_sets: list[Any]) -> dict[str, Any]:
    """Returns the description of a data set: what it is, its files, and the records in them."""
    kind = {"@context": CONTEXT, "@type": "sc:Dataset", "conformsTo": "http://mlcommons.org/croissant/1.0"}
    return kind | dict(about) | {"distribution": distribution, "recordSet": record_sets}


def file_object(name: str, content: bytes, description: str) -> dict[str, Any]:
    """Describes a Parquet file beside the description, with its SHA-256."""
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name,
        "description": description,
        "contentUrl": name,
        "contentSize": f"{len(content)} B",
        "encodingFormat": PARQUET,
        "sha256": hashlib.sha256(content).hexdigest(),
    }


def file_set(name: str, pattern: str, description: str) -> dict[str, Any]:
    """Describes the Parquet files beside the description whose paths fit a pattern."""
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "description": description,
        "encodingFormat": PARQUET,
        "includes": pattern,
    }


def record_set(
    name: str, source: Mapping[str, Any], schema: pa.Schema, columns: Mapping[str, str], *, key: tuple[str, ...]
) -> dict[str, Any]:
    """Describes the rows of a file, or of the files of a set, by the types and the meaning of their columns."""
    kind = {"cr:FileObject": "fileObject", "cr:FileSet": "fileSet"}[source["@type"]]
    fields = []
    for column in schema:
        inner = getattr(column.type, "value_type", column.type)
        field = {
            "@type": "cr:Field",
            "@id": f"{name}/{column.name}",
            "name": column.name,
            "description": columns[column.name],
            "dataType": _TYPES[str(inner)],
            "source": {kind: {"@id": source["@id"]}, "extract": {"column": column.name}},
        }
        fields.append(field | ({"repeated": True} if str(column.type).startswith("list<") else {}))
    keys = [{"@id": f"{name}/{column}"} for column in key]
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "description": source["description"],
        "key": keys[0] if len(keys) == 1 else keys,
        "field": fields,
    }
