"""Tests the house: imports point down, plugins are never imported, and modules stay small and well named."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FLOORS = {
    "errors": 1, "ranges": 1, "domain": 1, "trajectories": 1, "machine": 1,
    "world": 2, "nn": 2,
    "data": 3, "validation": 3,
    "bench": 4,
    "console": 5, "cli_board": 5, "cli_compare": 5, "cli_data": 5, "cli_describe": 5, "cli_exchange": 5,
    "cli_look": 5, "cli_new": 5, "cli_render": 5, "cli_run": 5, "cli_store": 5, "cli_validate": 5,
    "cli_verify": 5, "cli": 5,
}  # fmt: skip
MODULES = sorted((ROOT / "dlobench").rglob("*.py"))
PLUGINS = [path for kind in ("models", "tasks") for path in sorted((ROOT / kind).glob("*.py"))]
EVERY = pytest.mark.parametrize("path", MODULES + PLUGINS, ids=lambda path: str(path.relative_to(ROOT)))


def imports(path: Path, *, nested: bool = True) -> Iterator[str]:
    """Yields the full names that a module imports, at its top level or anywhere."""
    tree = ast.parse(path.read_text())
    names = {each.stem for each in (ROOT / "dlobench").iterdir()}
    for node in ast.walk(tree) if nested else top(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path} imports relatively"
            module = node.module or ""
            if module == "dlobench":  # from dlobench import machine
                yield from (f"dlobench.{alias.name}" if alias.name in names else "dlobench" for alias in node.names)
            elif module.count(".") == 1 and module.startswith("dlobench."):  # from dlobench.bench import run
                yield from (f"{module}.{alias.name}" for alias in node.names)
            else:
                yield module


def top(tree: ast.AST) -> Iterator[ast.AST]:
    """Yields the nodes that run when a module is imported: those outside of functions."""
    for node in ast.iter_child_nodes(tree):
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            yield from top(node)


def part(name: str) -> str | None:
    """Returns the part of the house that a full name lives in, None for other packages and the package itself."""
    parts = name.split(".")
    return parts[1] if parts[0] == "dlobench" and len(parts) > 1 else None


def home(path: Path) -> str:
    """Returns the part of the house that a file lives in."""
    first = path.relative_to(ROOT / "dlobench").parts[0]
    return first.removesuffix(".py")


def test_every_part_has_a_floor() -> None:
    assert {home(path) for path in MODULES} - {"__init__"} <= set(FLOORS)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_point_down(path: Path) -> None:
    here = home(path)
    floor = FLOORS["data" if here == "__init__" else here]  # the front door offers `load`
    for name in imports(path):
        there = part(name)
        assert there not in ("models", "tasks"), f"{path} imports the plugin {name}"
        assert name.split(".")[0] not in ("models", "tasks")
        if there not in (None, here):
            assert there in FLOORS, f"{path} imports {name}, which has no floor"
            assert FLOORS[there] <= floor, f"{path} on floor {floor} imports {name} from floor {FLOORS[there]}"
            assert {here, there} != {"world", "nn"}, f"{path} imports {name}, its neighbour"


def test_nothing_imports_in_a_circle() -> None:
    names = {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in MODULES}
    graph: dict[str, set[str]] = {}
    for name, path in names.items():
        found = set(imports(path))
        graph[name] = {target for target in names if target in found or any(f.startswith(target + ".") for f in found)}
        graph[name] -= {"dlobench", name} | {".".join(name.split(".")[:n]) for n in range(1, 4)}
    done: set[str] = set()

    def visit(name: str, above: tuple[str, ...]) -> None:
        assert name not in above, f"circle: {' → '.join((*above, name))}"
        if name not in done:
            for target in sorted(graph[name]):
                visit(target, (*above, name))
            done.add(name)

    for name in graph:
        visit(name, ())
    assert done == set(names)


@pytest.mark.parametrize("path", PLUGINS, ids=lambda path: str(path.relative_to(ROOT)))
def test_plugins_import_no_plugin_and_no_command_line(path: Path) -> None:
    for name in imports(path):
        there = part(name)
        assert there is None or FLOORS[there] <= 4, f"{path} imports {name}"
        assert name.split(".")[0] not in ("models", "tasks", "importlib")


@EVERY
def test_torch_is_imported_where_it_is_used(path: Path) -> None:
    replay = ROOT / "dlobench" / "data" / "replay.py"  # a class of torchrl's, imported by nothing of ours
    if path.parent not in (ROOT / "dlobench" / "nn", ROOT / "models") and path != replay:
        heavy = [name for name in imports(path, nested=False) if name.split(".")[0] in ("torch", "torchrl")]
        assert not heavy


def test_nothing_imports_the_replay_buffer() -> None:
    assert not [path for path in MODULES + PLUGINS if "dlobench.data.replay" in imports(path)]


@EVERY
def test_modules_are_small_and_have_a_docstring(path: Path) -> None:
    source = path.read_text()
    assert len(source.splitlines()) <= 250
    assert not source or ast.get_docstring(ast.parse(source))


@EVERY
def test_modules_are_named_by_a_noun_of_ours(path: Path) -> None:
    assert not {"utils", "util", "common", "helpers", "helper", "base", "misc"} & set(path.with_suffix("").parts[-2:])


def test_the_checks_of_this_file_see_what_they_should(tmp_path: Path) -> None:
    path = tmp_path / "x.py"
    path.write_text("import torch.nn\nfrom dlobench import machine\ndef f():\n    from dlobench.bench import run\n")
    assert list(imports(path)) == ["torch.nn", "dlobench.machine", "dlobench.bench.run"]
    assert list(imports(path, nested=False)) == ["torch.nn", "dlobench.machine"]
