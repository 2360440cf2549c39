"""Draws the board's page: one HTML file that needs no network, a pure function of the records."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from html import escape
from importlib.resources import files

import pandas as pd

from dlobench.bench.page.charts import CHARTS, CURVE
from dlobench.bench.page.libraries import Library, libraries
from dlobench.bench.page.payload import payload
from dlobench.bench.page.rollout import Windows, rollout
from dlobench.bench.record import Record
from dlobench.bench.scores import scores

CSP = (
    "default-src 'none'; connect-src 'none'; img-src data:; style-src 'unsafe-inline'; "
    "script-src {scripts}; base-uri 'none'; form-action 'none'"
)


def build(
    records: Sequence[Record],
    frame: pd.DataFrame,
    rollouts: Mapping[str, Windows] | None = None,
    tidy: pd.DataFrame | None = None,
) -> bytes:
    """Returns the page of records and of their `leaderboard.table`; the same records give the same bytes.

    `rollouts` holds predicted windows by the name to show them under, `tidy` the `scores` of the records, for those who
    have them already. What comes from records is text wherever it is shown: it is escaped here or set as text by the
    page's script, and no script runs but those whose digests stand in the page's policy. Raises `UsageError` where the
    libraries of the extra `page` are missing.
    """
    found = libraries()
    data = payload(records, frame, scores(records) if tidy is None else tidy) | {"charts": CHARTS, "curve": CURVE}
    pictures = "".join(
        f"<figure>{rollout(windows, name)}<figcaption>{escape(name)}</figcaption></figure>"
        for name, windows in sorted((rollouts or {}).items())
    )
    return _page(data, found, pictures)


def _page(data: Mapping[str, object], found: Library, pictures: str) -> bytes:
    own = files("dlobench.bench.page")
    scripts = [*found.scripts, own.joinpath("page.js").read_text(encoding="utf-8")]
    digests = [base64.b64encode(hashlib.sha256(each.encode()).digest()).decode() for each in scripts]
    parts = {
        "policy": CSP.format(scripts=" ".join(f"'sha256-{digest}'" for digest in digests)),
        "style": found.style + own.joinpath("page.css").read_text(encoding="utf-8"),
        "data": json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c"),
        "scripts": "".join(f'<script type="module">{each}</script>\n' for each in scripts),
        "rollouts": pictures,
        "state": "board" if data["rows"] else "empty",
        "libraries": escape(found.names),
    }
    pieces = own.joinpath("page.html").read_text(encoding="utf-8").split("@@")  # text, name, text, name, …, text
    return "".join(parts[piece] if i % 2 else piece for i, piece in enumerate(pieces)).encode()
