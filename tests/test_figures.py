"""Tests the figures of scenes: what they show is what their words say, and all scripts are found and called."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from importlib import import_module
from pathlib import Path

import drawing
import fig2
import numpy as np
import pytest
from matplotlib.image import imread

from dlobench.domain import MATERIALS
from dlobench.errors import RunError
from dlobench.world import canvas

FOLDER = Path(__file__).parent.parent / "paper_figures"


@pytest.fixture(autouse=True)
def coarse(monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Draws few pixels, which takes less time."""
    style = tmp_path_factory.mktemp("style") / "coarse.mplstyle"
    style.write_text(drawing.STYLE.read_text().replace("savefig.dpi: 200", "savefig.dpi: 40"))
    monkeypatch.setattr(drawing, "STYLE", style)


@pytest.mark.parametrize("name", ["fig1", "fig2", "fig4", "fig5"])
def test_it_is_drawn_the_same_each_time(name: str, tmp_path: Path) -> None:
    if name == "fig4":
        try:
            canvas.load()
        except RunError as error:
            pytest.skip(str(error))
    for folder in ("one", "other"):
        assert drawing.main(import_module(name).draw, ["--out", str(tmp_path / folder)]) == 0
    one, other = (imread(tmp_path / folder / f"{name}.png") for folder in ("one", "other"))
    assert np.array_equal(one, other)
    assert len(np.unique(one.reshape(-1, one.shape[-1]), axis=0)) > 10, "not one colour"
    assert (tmp_path / "one" / f"{name}.pdf").read_bytes() == (tmp_path / "other" / f"{name}.pdf").read_bytes()


def test_domains_of_fig_2_differ_in_material_alone_and_meet_the_same_pusher() -> None:
    first, *others = fig2.domains()
    assert [each.material for each in (first, *others)] == list(MATERIALS)
    for other in others:
        same = replace(
            other,
            material=first.material,
            bending_stiffness=first.bending_stiffness,
            yield_curvature=first.yield_curvature,
        )
        assert same == first
    seen = [fig2.rolled(domain) for domain in (first, *others)]
    for dlo, pusher in seen:
        np.testing.assert_allclose(pusher, seen[0][1], atol=2e-3, err_msg="the pusher goes where it is told")
        np.testing.assert_allclose(dlo[0], seen[0][0][0], atol=1e-4, err_msg="the same start")
    pushed = len(fig2.WAY) // 2
    for dlo, _ in seen:
        assert np.linalg.norm(dlo[pushed] - dlo[0], axis=-1).mean() > 0.02, "all are pushed"
    soft, flexible, elastoplastic = (np.linalg.norm(dlo[-1] - dlo[pushed], axis=-1).mean() for dlo, _ in seen)
    assert flexible > 10 * max(soft, elastoplastic), "let go, one springs back, one keeps its bend, a rope lies still"


def test_without_opengl_one_sentence_says_so(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(FOLDER / "fig4.py"), "--out", str(tmp_path / "out")],
        env={**os.environ, canvas.VARIABLE: "smoke_signals"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("fig4.py: MuJoCo cannot draw by MUJOCO_GL=smoke_signals"), done.stderr
    assert done.stderr.count("\n") == 1, "one sentence, no traceback"
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("script", ["table1.py", "findings.py"])
def test_where_nothing_can_be_written_one_sentence_says_so(script: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    command = [sys.executable, str(FOLDER / script), "--out", str(tmp_path / "file")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert done.stderr.startswith(f"{script}: ") and str(tmp_path / "file") in done.stderr


def test_one_that_fails_is_named_and_the_others_are_drawn(tmp_path: Path) -> None:
    scripts = {"good": "open('fresh.png', 'w')", "bad": "raise SystemExit(1)", "last": ""}
    for name, code in scripts.items():
        (tmp_path / f"{name}.py").write_text(f'{code}\nif __name__ == "__main__":\n    pass\n')
    (tmp_path / "shared.py").write_text("raise SystemExit(1)")  # no script: it does not end like one
    (tmp_path / "__main__.py").write_text((FOLDER / "__main__.py").read_text())
    out = tmp_path / "out"
    out.mkdir()
    (out / "stale.png").touch()
    os.utime(out / "stale.png", (0, 0))
    command = [sys.executable, str(tmp_path), "--out", str(out)]
    done = subprocess.run(command, cwd=out, capture_output=True, text=True, check=False)
    assert done.returncode == 1 and done.stderr == "not drawn: bad.py\n"
    told = [(line.split()[:2], line.split()[4:]) for line in done.stdout.splitlines()]  # between them, the time
    names = [(["bad.py", "FAILED,"], []), (["good.py", "drawn,"], ["fresh.png"]), (["last.py", "drawn,"], [])]
    assert told == names, "with what each has written"
