"""Speaks the verb `dlobench validate`: the world beside closed forms and independent codes, one row a figure."""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dlobench.errors import RunError, UsageError

if TYPE_CHECKING:
    from dlobench.validation.check import Effort, Row


def validate(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer pushes, within a minute.")] = False,
    full: Annotated[bool, typer.Option("--full", help="10^5 random pushes, and more of everything.")] = False,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="NAME", help="Only this check; repeat it.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Hold the world against closed forms and independent codes; exit code 1 if a bound is not kept."""
    from dlobench.console import TerminalReporter
    from dlobench.validation.suite import choose, rows

    if quick and full:
        raise UsageError("--quick and --full exclude each other")
    effort: Effort = "quick" if quick else "full" if full else "normal"
    checks, reporter = choose(only or []), TerminalReporter()
    found: list[tuple[str, Row]] = []
    with reporter.bar("validating", "checks") as listen:
        for done, (name, check) in enumerate(checks.items()):
            listen(done, len(checks), {})
            began, own = time.monotonic(), list(rows(name, check, effort))
            found += [(name, row) for row in own]
            failed = sum(row.passed is False for row in own)
            bounded = sum(row.passed is not None for row in own)
            kept = f"{bounded - failed} of {bounded} bounds kept" if own else f"no part of {effort}"
            reporter.say(f"{name}: {kept}, {time.monotonic() - began:.1f} s")
        listen(len(checks), len(checks), {})
    if not found:
        raise UsageError(f"nothing to check: {', '.join(checks)} is no part of --{effort}")
    _print(found, as_json)
    failing = [row.name for _, row in found if row.passed is False]
    if failing:
        judged = sum(row.passed is not None for _, row in found)
        raise RunError(f"{len(failing)} of {judged} bounds are not kept: {'; '.join(failing)}")


def _print(found: list[tuple[str, Row]], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps([_json(name, row) for name, row in found], indent=1, ensure_ascii=False, allow_nan=False))
        return
    from dlobench.console import print_table

    lines = [
        [
            row.name,
            _figure(row.measured, row.unit),
            _figure(row.reference, row.unit),
            _figure(row.error, row.error_unit),
            "" if row.bound is None else _figure(row.bound, row.error_unit),
            {True: "yes", False: "NO", None: ""}[row.passed],
            row.note,
        ]
        for _, row in found
    ]
    print_table(["name", "measured", "reference", "error", "bound", "pass", "note"], lines)


def _figure(value: float, unit: str) -> str:
    return f"{value:.4g} {unit}".rstrip()


def _json(name: str, row: Row) -> dict[str, Any]:
    """Returns a row as JSON values; what is no finite number is null."""
    fields = {key: None if isinstance(v, float) and not math.isfinite(v) else v for key, v in asdict(row).items()}
    return {"check": name, **fields, "pass": row.passed}
