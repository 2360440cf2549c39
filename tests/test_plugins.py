"""Tests the plugins: one road for names and paths, and a plain error for everything that is no plugin."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path

import pytest

from dlobench.bench.plugins import find, hyperparameters, load_model, load_task, parse_settings
from dlobench.errors import RunError, UsageError

ROOT = Path(__file__).parents[1]

HEAD = """\
\"\"\"Stands still.\"\"\"
from dataclasses import dataclass, field
from typing import Literal
import numpy as np
from dlobench.bench.model import Model
from dlobench.trajectories import Prediction
"""
BODY = """
    def fit(self, train, valid, setting): pass
    def predict(self, query, samples): return Prediction(dlo=query.dlo[None, ..., :2].copy())
"""


def plugin(name: str = "Still", fields: str = "") -> str:
    """Returns the source of a model that keeps the contract."""
    return f"\n@dataclass\nclass {name}(Model):\n    {fields}\n{BODY}"


def write(folder: Path, source: str, name: str = "mine.py") -> str:
    """Writes a plugin and returns its path as a user would type it."""
    folder.mkdir(exist_ok=True)
    (folder / name).write_text(HEAD + source)
    return str(folder / name)


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "models").glob("[!_]*.py")))
def test_a_name_and_a_path_take_the_same_road(name: str, tmp_path: Path) -> None:
    path = ROOT / "models" / f"{name}.py"
    named, pathed = load_model(name), load_model(str(path))
    assert named == pathed
    assert named.path == path
    assert named.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
    copied = tmp_path / path.name
    copied.write_bytes(path.read_bytes())
    elsewhere = load_model(str(copied))
    assert (elsewhere.name, elsewhere.sha256) == (named.name, named.sha256)
    assert elsewhere.model.__name__ == named.model.__name__
    assert elsewhere.model is not named.model
    assert hyperparameters(elsewhere.model) == hyperparameters(named.model)


def test_a_task_is_found_by_name_and_by_path() -> None:
    assert load_task("meta") == load_task(str(ROOT / "tasks" / "meta.py"))


def test_a_relative_path_is_a_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Path(write(tmp_path, plugin()))
    monkeypatch.chdir(tmp_path)
    assert load_model("mine.py").path == load_model("./mine.py").path == path.resolve()


def test_an_unknown_name_is_refused_with_the_choices() -> None:
    with pytest.raises(UsageError, match="unknown model 'moon'") as error:
        load_model("moon")
    assert all(name in str(error.value) for name in find("models"))
    with pytest.raises(UsageError, match=r"unknown task 'moon'.*meta"):
        load_task("moon")


@pytest.mark.parametrize("where", ["absent.py", "folder.py", "absent/", "folder", "text.txt"])
def test_what_is_no_python_file_is_refused(where: str, tmp_path: Path) -> None:
    (tmp_path / "folder.py").mkdir()
    (tmp_path / "folder").mkdir()
    (tmp_path / "text.txt").write_text(HEAD + plugin())
    for load in (load_model, load_task):
        with pytest.raises(UsageError) as error:
            load(f"{tmp_path}/{where}")
        assert str(tmp_path) in str(error.value)


REFUSED = {
    "two": (plugin("One") + plugin("Two"), "exactly one subclass of Model, found 2: One, Two"),
    "none": ("x = 1\n", "exactly one subclass of Model, found 0: none"),
    "imported": ("from dlobench.bench.plugins import Model as Mine\n", "found 0"),
    "abstract": ("\n@dataclass\nclass Half(Model):\n    def fit(self, train, valid, setting): pass\n", "Half.*predict"),
    "no dataclass": (plugin().replace("@dataclass\n", ""), "not a dataclass"),
}
FAILING = {
    "syntax": ("def (:\n", "SyntaxError"),
    "null": ("\0", "SyntaxError|ValueError"),
    "raises": ("1 / 0\n", "ZeroDivisionError"),
    "missing import": ("import no_such_module_at_all\n", "no_such_module_at_all"),
    "exits": ("import sys\nsys.exit(0)\n", "SystemExit"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_no_model_is_refused(what: str, tmp_path: Path) -> None:
    source, message = REFUSED[what]
    path = write(tmp_path, source)
    with pytest.raises(UsageError, match=message) as error:
        load_model(path)
    assert path in str(error.value)


@pytest.mark.parametrize("what", FAILING)
@pytest.mark.parametrize("load", [load_model, load_task])
def test_what_fails_to_load_is_named(what: str, load: object, tmp_path: Path) -> None:
    source, message = FAILING[what]
    path = write(tmp_path, source)
    assert callable(load)
    before = set(sys.modules)
    for _ in range(2):  # a second try meets no half-loaded module
        with pytest.raises(RunError, match=message) as error:
            load(path)
        assert path in str(error.value)
    assert not {name for name in set(sys.modules) - before if "dlobench_plugin" in name}


@pytest.mark.parametrize("content", ["TASK = 1\n", "x = 1\n"])
def test_what_is_no_task_is_refused(content: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="does not define TASK"):
        load_task(write(tmp_path, content))


def test_an_alias_is_no_second_model(tmp_path: Path) -> None:
    assert load_model(write(tmp_path, plugin() + "\nBest = Still\n")).model.__name__ == "Still"


def test_files_of_one_stem_are_not_confused(tmp_path: Path) -> None:
    one = load_model(write(tmp_path / "a", plugin(fields="gain: int = 1")))
    two = load_model(write(tmp_path / "b", plugin(fields="gain: int = 2")))
    assert (one.name, two.name) == ("mine", "mine")
    assert one.sha256 != two.sha256
    assert (hyperparameters(one.model), hyperparameters(two.model)) == ({"gain": 1}, {"gain": 2})
    builtin = load_model(write(tmp_path / "c", plugin(), "maml.py"))
    assert builtin.model is not load_model("maml").model


def test_an_edited_file_is_loaded_anew(tmp_path: Path) -> None:
    first = load_model(write(tmp_path, plugin(fields="gain: int = 1")))
    second = load_model(write(tmp_path, plugin(fields="gain: int = 2")))
    assert hyperparameters(second.model) == {"gain": 2}
    assert first.sha256 != second.sha256


@pytest.mark.parametrize("stem", ["my model", "modèle", "a@b", "a,b"])
def test_a_name_that_no_record_can_carry_is_refused_before_the_run(stem: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=stem):
        load_model(write(tmp_path, plugin(), f"{stem}.py"))


FIELDS = """n: int = 3
    rate: float = 0.5
    K_train: int | None = 4
    deep: bool = False
    target: Literal["absolute", "displacement"] = "absolute"
    note: str = "x"
    inner: list = field(init=False, default_factory=list)
"""


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("n=50", 50),
        ("rate=1e-3", 1e-3),
        ("rate=2", 2.0),
        ("K_train=None", None),
        ("K_train=7", 7),
        ("deep=true", True),
        ("target=displacement", "displacement"),
        ("note=a=b", "a=b"),
        ("note=", ""),
    ],
)
def test_settings_are_read_as_the_type_of_their_field(text: str, value: object, tmp_path: Path) -> None:
    model = load_model(write(tmp_path, plugin(fields=FIELDS))).model
    read = parse_settings(model, [text])
    assert read == {text.partition("=")[0]: value}
    assert type(next(iter(read.values()))) is type(value)


@pytest.mark.parametrize("text", ["n", "n:5", "nonsense=1", "=5", "", "seed=3", "device=cpu", "inner=1", "N=5"])
def test_unknown_settings_are_refused_with_the_choices(text: str, tmp_path: Path) -> None:
    model = load_model(write(tmp_path, plugin(fields=FIELDS))).model
    with pytest.raises(UsageError) as error:
        parse_settings(model, [text])
    assert repr(text) in str(error.value)
    assert "n=3" in str(error.value)
    assert "target=absolute" in str(error.value)


@pytest.mark.parametrize("text", ["n=1.5", "n=many", "n=", "n=None", "rate=fast", "deep=perhaps", "target=moon"])
def test_settings_of_the_wrong_type_are_refused(text: str, tmp_path: Path) -> None:
    model = load_model(write(tmp_path, plugin(fields=FIELDS))).model
    with pytest.raises(UsageError) as error:
        parse_settings(model, [text])
    assert text in str(error.value)


def test_a_preset_stands_for_its_settings(tmp_path: Path) -> None:
    presets = "presets = {'big': {'n': 9, 'deep': True}}\n    " + FIELDS
    model = load_model(write(tmp_path, plugin(fields=presets))).model
    assert parse_settings(model, ["preset=big"]) == {"n": 9, "deep": True}
    assert parse_settings(model, ["rate=2", "preset=big", "n=5"]) == {"rate": 2.0, "n": 5, "deep": True}
    with pytest.raises(UsageError, match="'preset=huge' names no preset of the model: big"):
        parse_settings(model, ["preset=huge"])
    with pytest.raises(UsageError, match="it has none"):
        parse_settings(load_model("persistence").model, ["preset=huge"])


@pytest.mark.parametrize("name", sorted(path.stem for path in (ROOT / "models").glob("[!_]*.py")))
def test_presets_of_our_models_can_be_built(name: str) -> None:
    model = load_model(name).model
    for preset in model.presets:
        model(**parse_settings(model, [f"preset={preset}"]))


def test_a_model_without_hyperparameters_says_so() -> None:
    with pytest.raises(UsageError, match="it has none"):
        parse_settings(load_model("persistence").model, ["n=1"])


def test_listing_reads_files_and_imports_none() -> None:
    found = find("models")
    assert {"persistence", "mlp", "multitask", "maml"} <= set(found)
    assert all(each.about.endswith((".", ").")) and each.path.is_file() for each in found.values())
    code = "import sys; from dlobench.bench.plugins import find; find('models'); find('tasks'); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    loaded = done.stdout.split()
    assert "torch" not in loaded
    assert not [name for name in loaded if name.startswith(("dlobench_plugin", "dlobench.models.", "dlobench.tasks."))]
