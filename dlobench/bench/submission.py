"""Packs records with all that stands beside them into one file, and unpacks it into a folder of results."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

from dlobench.data.store import atomic_write
from dlobench.errors import RunError

MEMBER = re.compile(
    r"^[\w.-]+/(mini|small|paper)/[\w.-]+@[0-9a-f]{8}/(plugin\.py|seed\d+(\.json|(/[\w.-]+)?\.safetensors))$"
)
LARGE = 4 * 2**30  # bytes, unpacked
_TIME = (1980, 1, 1, 0, 0, 0)  # of every member, so that the same records give the same bytes


def pack(records: Sequence[Path], folder: Path, out: Path) -> int:
    """Writes records of a folder of results with plugin, predictions and weights into a .zip; returns its bytes.

    Raises `RunError` for a record without weights: nobody could score it on new domains.
    """
    import io

    members = set[Path]()
    for record in records:
        weights = [*record.with_suffix("").glob("*.safetensors")]
        if not weights:
            raise RunError(f"{record} has no weights to submit: the run says which field of the model cannot be saved")
        members |= {record, record.with_name("plugin.py"), record.with_suffix(".safetensors"), *weights}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(members):
            try:
                content = path.read_bytes()
            except OSError as error:
                raise RunError(f"cannot pack {path}: {error.strerror}") from error
            file.writestr(zipfile.ZipInfo(path.relative_to(folder).as_posix(), _TIME), content, zipfile.ZIP_DEFLATED)
    atomic_write(out, buffer.getvalue())
    return len(buffer.getvalue())


def unpack(path: Path, folder: Path, *, weights: bool) -> list[Path]:
    """Unpacks a submission into a folder and returns its records; weights are large, and may stay behind.

    Raises `RunError` for what is no submission, and where the folder has a record of that place: none is overwritten.
    """
    try:
        with zipfile.ZipFile(path) as file:
            infos = file.infolist()
            odd = next((info.filename for info in infos if not MEMBER.match(info.filename)), None)
            if odd is not None or not infos or sum(info.file_size for info in infos) > LARGE:
                raise RunError(f"{path} is no submission: it holds {odd or 'nothing, or too much'}")
            records = [folder / info.filename for info in infos if info.filename.endswith(".json")]
            for record in records:
                if record.exists():
                    raise RunError(f"{record} is there already; remove it to replace it")
            for info in infos:
                if weights or len(Path(info.filename).parts) == 4:
                    atomic_write(folder / info.filename, file.read(info))
    except OSError as error:
        raise RunError(f"cannot read {path}: {error.strerror}") from error
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"{path} is no submission, which is a .zip of `dlobench submit`: {error}") from error
    return sorted(records)
