"""Finds and loads plugins: files that define exactly one model, or one task. Built-ins take the same road."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import importlib.util
import re
import sys
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_type_hints

from dlobench.bench.model import Model
from dlobench.bench.task import Task
from dlobench.errors import RunError, UsageError

Kind = Literal["models", "tasks"]


@dataclass(frozen=True)
class Found:
    """Describes a plugin file without running it."""

    name: str
    path: Path
    about: str  # first line of its docstring


@dataclass(frozen=True)
class ModelPlugin:
    """Holds a loaded model plugin."""

    name: str
    path: Path
    sha256: str  # of the file
    model: type[Model]
    protection: tuple[str, ...] = ("none, it runs in the process of the bench",)  # from the plugin, a phrase each


def find(kind: Kind) -> dict[str, Found]:
    """Returns the plugins that are installed, by name, reading their files only."""
    spec = importlib.util.find_spec(f"dlobench.{kind}")
    folders = list(spec.submodule_search_locations or []) if spec else []
    paths = {path.stem: path for folder in folders for path in sorted(Path(folder).glob("[!_]*.py"))}
    for point in entry_points(group=f"dlobench.{kind}"):  # offered by other installed distributions
        origin = importlib.util.find_spec(point.module)
        if origin and origin.origin:
            paths.setdefault(point.name, Path(origin.origin))
    return {name: Found(name, path, _about(path)) for name, path in sorted(paths.items())}


def load_model(name_or_path: str) -> ModelPlugin:
    """Loads a model by name or by path.

    Raises `UsageError` for what is no plugin, `RunError` for one that fails to load.
    """
    path = resolve("models", name_or_path)
    if not re.fullmatch(r"[A-Za-z0-9_.-]+", path.stem):
        raise UsageError(f"plugin file {path.name!r}: its name goes into records; use letters, digits and any of _ . -")
    module, sha256 = _execute(path, "model")
    classes = [
        value
        for value in {id(value): value for value in vars(module).values()}.values()  # an alias is no second model
        if isinstance(value, type) and issubclass(value, Model) and value.__module__ == module.__name__
    ]
    if len(classes) != 1:
        names = ", ".join(c.__name__ for c in classes) or "none"
        raise UsageError(f"{path} must define exactly one subclass of Model, found {len(classes)}: {names}")
    model = classes[0]
    missing = ", ".join(sorted(getattr(model, "__abstractmethods__", ())))
    if missing:
        raise UsageError(f"model {model.__name__} in {path} does not define {missing}")
    if "__dataclass_fields__" not in vars(model):
        raise UsageError(f"model {model.__name__} in {path} is not a dataclass; decorate it with @dataclass")
    return ModelPlugin(path.stem, path, sha256, model)


def load_task(name_or_path: str) -> Task:
    """Loads a task by name or by path; raises as `load_model` does."""
    path = resolve("tasks", name_or_path)
    task = getattr(_execute(path, "task")[0], "TASK", None)
    if not isinstance(task, Task):
        raise UsageError(f"{path} does not define TASK, a dlobench.bench.task.Task")
    return task


def hyperparameters(model: type[Model]) -> dict[str, Any]:
    """Returns the hyperparameters of a model class with their defaults."""
    return {
        f.name: f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default
        for f in dataclasses.fields(model)
        if f.init and f.name not in ("seed", "device")
    }


def parse_settings(model: type[Model], settings: list[str]) -> dict[str, Any]:
    """Reads `FIELD=VALUE` texts as hyperparameters of a model; raises `UsageError` naming value and choices.

    `preset=NAME` stands for all those of one of its presets; what comes after it goes before it.
    """
    from pydantic import TypeAdapter, ValidationError

    known, hints = hyperparameters(model), get_type_hints(model)
    out: dict[str, Any] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        if equals and name == "preset" and "preset" not in known:
            if text not in model.presets:
                there = ", ".join(model.presets) or "it has none"
                raise UsageError(f"--set {setting!r} names no preset of the model: {there}")
            out |= model.presets[text]
            continue
        if not equals or name not in known:
            fields = ", ".join(f"{k}={v}" for k, v in known.items()) or "it has none"
            raise UsageError(f"--set {setting!r} is not FIELD=VALUE with a hyperparameter of the model: {fields}")
        try:
            adapter = TypeAdapter(hints[name])
            out[name] = adapter.validate_python(None) if text == "None" else adapter.validate_strings(text)
        except ValidationError as error:
            raise UsageError(f"--set {setting!r}: {error.errors()[0]['msg'].lower()}") from error
    return out


def resolve(kind: Kind, name_or_path: str) -> Path:
    """Returns the file of a plugin, by its name or path; raises `UsageError` where there is none."""
    if name_or_path.endswith(".py") or "/" in name_or_path:
        path = Path(name_or_path)
        if not path.is_file():
            raise UsageError(f"no plugin file at {name_or_path}")
        if path.suffix != ".py":
            raise UsageError(f"{name_or_path} is not a Python file")
        return path.resolve()
    found = find(kind)
    if name_or_path not in found:
        raise UsageError(
            f"unknown {kind[:-1]} {name_or_path!r}; there are: {', '.join(found)} (or a path to a .py file)"
        )
    return found[name_or_path].path


def _execute(path: Path, what: str) -> tuple[ModuleType, str]:
    """Runs a plugin file and returns its module and the SHA-256 of its content."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from error
    sha256 = hashlib.sha256(content).hexdigest()
    name = f"dlobench_plugin_{path.stem}_{hashlib.sha256(str(path).encode() + content).hexdigest()[:12]}"
    if name in sys.modules:
        return sys.modules[name], sha256
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise UsageError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up
    try:
        spec.loader.exec_module(module)
    except BaseException as error:
        del sys.modules[name]
        if isinstance(error, KeyboardInterrupt):
            raise
        raise RunError(f"{what} plugin {path} failed to load: {type(error).__name__}: {error}") from error
    return module, sha256


def _about(path: Path) -> str:
    try:
        return (ast.get_docstring(ast.parse(path.read_text())) or "").partition("\n")[0]
    except (OSError, SyntaxError, ValueError) as error:
        return f"(unreadable: {error})"
