"""Tests that every command and every piece of Python in the README and on the site's pages can be called as it is told.

They are called page by page, from top to bottom, in one folder and on data of random walks: what comes out is not
judged here, that it ends well is. What takes long is shortened, and how stands in `ADDED` and `INSTEAD`, so that a verb
or option that is renamed, on either side, fails. Of what other tests call for real, verb and options are parsed here
(`PARSED`); what no test can call stands in `NOT_HERE`, with the reason. A command that is in none of the lists fails.
"""

from __future__ import annotations

import importlib.metadata
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import typer
from test_render import drawing  # noqa: F401
from test_store import write

from dlobench.bench.plugins import Kind, find
from dlobench.cli import app, main
from dlobench.data.sets import SETS
from dlobench.data.store import Store
from dlobench.errors import RunError

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    *sorted(str(path.relative_to(ROOT)) for path in (ROOT / "docs").glob("*.md")),
    "leaderboard/SUBMITTING.md",
    "CONTRIBUTING.md",
]

STEPS = "--max-steps 2"
AS_IT_STANDS = {
    "dlobench check my_model.py",
    "dlobench check still.py",
    "dlobench compare maml multitask --task meta",
    "dlobench compare maml multitask --task meta --metric euclidean",
    "dlobench compare maml multitask --task meta --results runs",
    "dlobench compare maml multitask --task meta --results runs --out compare.png",
    "dlobench data card meta-learning --out card",
    "dlobench data export meta-learning --original meta_learn",
    "dlobench data export meta-learning --parquet tables",
    "dlobench data import --original meta_learn --name owned",
    "dlobench data repair meta-learning",
    "dlobench data status",
    "dlobench data status meta-learning --data here",
    "dlobench data status meta-learning --data there",
    "dlobench data verify",
    "dlobench generate meta-learning",
    "dlobench generate meta-learning --domains 2 --data here",
    "dlobench generate meta-learning --domains 21",
    "dlobench leaderboard build --results runs",
    "dlobench leaderboard verify my_model-*.zip",
    "dlobench list models",
    "dlobench list sets",
    "dlobench new model my_model",
    "dlobench render --domain meta-learning/2700 --trajectory 0 --out flexible.png",
    "dlobench render --domain meta-learning/4800 --trajectory 0 --out elastoplastic.png",
    "dlobench render --domain meta-learning/600 --trajectory 2 --out rope.gif",
    "dlobench render --domain meta-learning/600 --trajectory 2 --out rope.png",
    "dlobench render --domain meta-learning/600 --trajectory 2 --out soft.png",
    "dlobench run --task held_wires.py --model ridge",
    "dlobench run --task meta --model my_model.py",
    "dlobench run --task meta --model persistence",
    "dlobench run --task meta --model ridge --on owned",
}
ADDED = {
    "dlobench generate meta-learning --scale small": "--domains 1",
    "dlobench run --task horizon_sweep --model mlp": STEPS + " --horizon 1",
    "dlobench run --task meta --model maml --K 10": STEPS,
    "dlobench run --task meta --model maml --K 10 --set N=10 --out trials": STEPS,
    "dlobench run --task meta --model multitask": STEPS + " --K 10",
    "dlobench validate": "--only weight",
    "dlobench validate --quick": "--only weight",
}
INSTEAD = {
    "dlobench leaderboard verify --results runs": "dlobench leaderboard verify --results others",  # not of own tasks
    "dlobench generate meta-learning --scale paper --data /shared/dlobench --executor slurm "
    "--slurm partition=batch --slurm time=4:00:00 --workers 64 --dry-run": (
        "dlobench generate meta-learning --scale paper --data shared --executor slurm "
        "--slurm partition=batch --slurm time=4:00:00 --workers 64 --dry-run"
    ),
    "dlobench submit my_model.py --task meta --scale small --seeds 0-4": (
        "dlobench submit my_model.py --task meta --scale mini --seeds 0-1"
    ),
}
PARSED = {
    "dlobench render --domain meta-learning/600 --trajectory 2 --camera oblique --out soft.mp4": "test_render.py",
    "dlobench list tasks": "test_cli.py",
    "dlobench data plan meta-learning --scale paper": "test_plan.py",
    "dlobench generate meta-learning --domains 2 --data there --executor ray --address 127.0.0.1:6379": "test_ray.py",
    "dlobench run --task horizon_sweep --model mlp --executor ray": "test_ray.py",
    "dlobench run --task meta --model maml --K 10 --wandb offline": "test_tracking.py",
}
MAKES_RUN = "dlobench run --task meta --model maml --K 10"  # what `make run` calls
NOT_HERE = {
    ".venv/bin/pre-commit install": "writes into .git",
    "export RAY_AUTH_MODE=token": "is the shell's",
    "ray get-auth-token --generate > /dev/null": "writes into the user's home",
    "ray start --head --port 6379": "leaves processes behind; test_ray.py has its own",
    "ray stop": "ends every Ray of the user",
    "source .venv/bin/activate": "is the shell's",
}


class Block(NamedTuple):
    """Holds a fenced block of a page."""

    language: str
    title: str  # of the file that it is, if it is one
    text: str


def blocks(page: str) -> list[Block]:
    """Returns the `sh` and `python` blocks of a page, in their order."""
    found = re.finditer(
        r'^( *)```(sh|python)(?: title="(.*?)")?\n(.*?)^\1```$', (ROOT / page).read_text(), re.DOTALL | re.MULTILINE
    )
    return [
        Block(m[2], m[3] or "", "\n".join(line.removeprefix(m[1]) for line in m[4].splitlines()) + "\n") for m in found
    ]


def commands(block: str) -> list[str]:
    """Returns the commands of a shell block, without comments and line breaks."""
    lines = (re.sub(r"\s*(^|\s)#.*", "", line) for line in block.replace("\\\n", " ").splitlines())
    return [" ".join(line.split()) for line in lines if line.strip()]


ALL = {command for page in PAGES for b in blocks(page) if b.language == "sh" for command in commands(b.text)}


def words(command: str) -> list[str]:
    """Returns what the shell makes of a command here, stars replaced."""
    split = shlex.split(command)
    return [found for word in split for found in (sorted(map(str, Path().glob(word))) if "*" in word else [word])]


def options(command: str) -> set[str]:
    """Returns the options that a command names."""
    return {word for word in shlex.split(command) if word.startswith("--")}


def parsed(command: str) -> None:
    """Parses a command as the command line does, and calls nothing; raises where a verb or an option is unknown."""
    _, *words = shlex.split(command)
    group: Any = typer.main.get_command(app)
    context = group.make_context("dlobench", words, resilient_parsing=False)
    while hasattr(group, "commands"):
        _, group, words = group.resolve_command(context, [*context._protected_args, *context.args])
        context = group.make_context(group.name, words, parent=context)


def dlobench(command: str) -> None:
    """Calls the command line in this process."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", words(command))
        with pytest.raises(SystemExit) as exit_:
            main()
    assert exit_.value.code == 0, command


def call(command: str, called: set[str]) -> None:
    """Calls a command as the lists say, once; `called` holds what was called before."""
    if command in called:
        return
    called.add(command)
    first, *rest = words(command)
    if command in NOT_HERE:
        return
    if first == "make":
        made = subprocess.run(["make", "--dry-run", *rest], cwd=ROOT, check=True, capture_output=True, text=True)
        if rest == ["run"]:
            assert f"/{MAKES_RUN}" in made.stdout
            call(MAKES_RUN, called)
    elif first == "python":  # scripts have tests of their own; here they have to be there, and to know their options
        assert (ROOT / rest[0]).exists(), command
        if asked := options(command):
            told = subprocess.run(
                [sys.executable, rest[0], "--help"], cwd=ROOT, capture_output=True, text=True, check=True
            )
            assert all(option in told.stdout for option in asked), command
    elif first == "pip":
        (extra,) = re.findall(r"^pip install 'dlobench\[(\w+)\]'$", command)
        assert extra in (importlib.metadata.metadata("dlobench").get_all("Provides-Extra") or [])
    elif command in PARSED:
        parsed(command)
    else:
        assert command in {*AS_IT_STANDS, *ADDED, *INSTEAD}, f"no test knows `{command}`"
        dlobench(INSTEAD.get(command, f"{command} {ADDED.get(command, '')}"))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Returns a data folder of random walks: two sets at scale mini, and a domain at scale small."""
    store, meta, large = Store(tmp_path_factory.mktemp("data")), SETS["meta-learning"], SETS["single-domain-large"]
    begun = meta.spans("small")[0].domain  # what `--scale small --domains 1` takes
    spans = [*meta.spans("mini"), *(span for span in meta.spans("small") if span.domain == begun)]
    for unit in dict.fromkeys(meta.units(spans)):
        write(store, meta, unit)
    for unit in large.units(large.spans("mini")):
        write(store, large, unit)
    return store.root


@dataclass
class Desk:
    """Holds the folder where a reader sits, and what has been called there."""

    folder: Path
    called: set[str] = field(default_factory=set)


@pytest.fixture(scope="module")
def desk(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    """Sits down in a folder with committed records, a record of the reader's own, and data."""
    folder, results = tmp_path_factory.mktemp("desk"), ROOT / "leaderboard" / "results"
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setenv("DLOBENCH_DATA", str(data))
        for name in ("here", "there"):
            Path(name).symlink_to(data)
        Path("leaderboard").mkdir()
        Path("leaderboard", "results").symlink_to(results)
        record = min(results.glob("meta/*/persistence@*"))
        for name in ("runs", "others"):
            shutil.copytree(record, Path(name) / record.relative_to(results))
        yield Desk(folder)


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_tells_can_be_done(page: str, desk: Desk, request: pytest.FixtureRequest) -> None:
    told: dict[str, Any] = {}
    for block in blocks(page):
        if block.title:
            (desk.folder / block.title).write_text(block.text)
        elif block.language == "python":
            exec(block.text, told)  # noqa: S102  # our own text
        for command in commands(block.text) if block.language == "sh" else ():
            if command.startswith("dlobench render"):
                try:
                    request.getfixturevalue("drawing")
                except pytest.skip.Exception:  # test_render.py says what is missing
                    parsed(command)
                    continue
            call(command, desk.called)


def test_what_is_shortened_is_the_same_command() -> None:
    for command, shorter in INSTEAD.items():
        assert command.split()[:2] == shorter.split()[:2]
        assert options(command) <= options(shorter), command


def test_no_list_holds_what_no_page_has() -> None:
    lists = (AS_IT_STANDS, ADDED, INSTEAD, PARSED, NOT_HERE)
    assert set().union(*lists) <= ALL
    assert len(set().union(*lists)) == sum(map(len, lists)), "each command is in one list"
    assert all((ROOT / "tests" / test).exists() for test in PARSED.values())


@pytest.mark.parametrize("command", ["dlobench dance", "dlobench run --task meta --model maml --K 10 --max-step 5"])
def test_a_command_that_no_list_has_fails(command: str) -> None:
    with pytest.raises(AssertionError, match="no test knows"):
        call(command, set())


@pytest.mark.parametrize("command", ["dlobench dance", "dlobench run --moon 1", "dlobench data plan --moon"])
def test_what_the_command_line_does_not_have_is_not_parsed(command: str) -> None:
    with pytest.raises(Exception, match="No such"):
        parsed(command)


def test_every_page_is_in_the_navigation() -> None:
    navigation = tomllib.loads((ROOT / "zensical.toml").read_text())["project"]["nav"]
    pages = {str(path.relative_to(ROOT / "docs")) for path in (ROOT / "docs").rglob("*.md")}
    assert set(re.findall(r"[\w/.-]+\.md", str(navigation))) == pages


def test_the_readme_links_to_what_is_there() -> None:
    links = re.findall(r'(?:\]\(|src=")([^):"]+)[)"]', (ROOT / "README.md").read_text())
    assert len(links) > 10
    assert not [link for link in links if not (ROOT / link).exists()]


@pytest.mark.parametrize("kind", ["models", "tasks"])
def test_a_page_names_every_plugin(kind: Kind) -> None:
    page = (ROOT / "docs" / f"{kind}.md").read_text()
    assert not [name for name in find(kind) if f"`{name}`" not in page]


def test_the_boards_top_is_up_to_date() -> None:
    top = runpy.run_path(str(ROOT / "leaderboard" / "top.py"))
    readme = (ROOT / "README.md").read_text()
    assert top["written"](readme, ROOT / "leaderboard" / "leaderboard.csv") == readme, "python leaderboard/top.py"
    assert readme.count("\n| 1 | `") == 1


@pytest.mark.parametrize("mark", ["start", "end"])
def test_a_readme_that_lost_a_mark_is_not_written(mark: str) -> None:
    top = runpy.run_path(str(ROOT / "leaderboard" / "top.py"))
    broken = (ROOT / "README.md").read_text().replace(f"[{mark}:board]", "")
    with pytest.raises(RunError, match=f"lacks the mark .*{mark}:board"):
        top["written"](broken, ROOT / "leaderboard" / "leaderboard.csv")


@pytest.mark.parametrize("kept", [None, 0, 60, 5000])
def test_no_top_is_made_of_half_a_board(kept: int | None, tmp_path: Path) -> None:
    top, board = runpy.run_path(str(ROOT / "leaderboard" / "top.py")), tmp_path / "leaderboard.csv"
    if kept is not None:
        board.write_bytes((ROOT / "leaderboard" / "leaderboard.csv").read_bytes()[:kept])
    with pytest.raises(RunError, match="dlobench leaderboard build"):
        top["table"](board)
