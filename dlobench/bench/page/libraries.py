"""Takes the page's libraries out of packages: DataTables from itables, Vega-Lite from vl-convert."""

from __future__ import annotations

import re
from dataclasses import dataclass
from importlib.metadata import version
from importlib.resources import files

from dlobench.errors import UsageError

_EXPORTS = re.compile(r"export\{[^}]*?([\w$]+) as default[^}]*\};?")


class MissingError(UsageError):
    """Says that a package of the extra `page` is not installed."""


@dataclass(frozen=True)
class Library:
    """Holds module scripts, each to be put into an element of its own, and a style sheet."""

    scripts: tuple[str, ...]
    style: str
    names: str  # with versions


def libraries() -> Library:
    """Returns DataTables as `window.DataTable` and Vega-Lite as `window.vegaEmbed`.

    Raises `MissingError` where a package is missing, `UsageError` where it holds something else than expected.
    """
    try:
        import itables
        import vl_convert
    except ImportError as error:
        raise MissingError(f"the page needs {error.name}: pip install 'dlobench[page]'") from error
    bundle = files(itables).joinpath("html", "dt_bundle.js").read_text(encoding="utf-8")
    table, found = _EXPORTS.subn(r"window.DataTable=\1;", bundle)
    if found != 1:
        raise UsageError(f"itables {version('itables')} holds no DataTables as it should: take the pinned one")
    chart = vl_convert.javascript_bundle("window.vegaEmbed = vegaEmbed;")
    names = f"itables {version('itables')} (DataTables), vl-convert {version('vl-convert-python')} (Vega-Lite)"
    style = files(itables).joinpath("html", "dt_bundle.css").read_text(encoding="utf-8")
    return Library((_inert(table), _inert(chart)), style.replace("</", "<\\/"), names)


def _inert(script: str) -> str:
    """Returns a script that cannot end its element: what looks like HTML stands in strings, where x3C escapes `<`."""
    return re.sub(r"<(?=!--|/?script)", r"\\x3C", script, flags=re.IGNORECASE)
