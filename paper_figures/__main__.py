"""Draws every figure and table: `python paper_figures`, one script after the other, past those that cannot be drawn."""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import time
from pathlib import Path

from PIL import Image

HERE = Path(__file__).parent
PAGES = HERE.parent / "docs"
SHOWN = re.compile(r"\(pictures/(\w+\.png)\)")  # how a page shows a picture
COLOURS = 128  # which nobody tells from all, at a third of the size
SCRIPT = 'if __name__ == "__main__":'  # what a script ends with, and what scripts share does not


def scripts() -> list[Path]:
    """Returns the scripts of this folder, by name."""
    return [path for path in sorted(HERE.glob("*.py")) if path.stem != "__main__" and SCRIPT in path.read_text()]


def renew(drawn: list[Path], pages: Path) -> None:
    """Puts figures that pages show, with fewer colours, into the folder `pictures` beside the pages."""
    shown = {name for page in pages.glob("*.md") for name in SHOWN.findall(page.read_text())}
    for path in drawn:
        if path.name not in shown:
            continue
        picture = Image.open(path).convert("RGB")
        picture.quantize(COLOURS, dither=Image.Dither.NONE).save(pages / "pictures" / path.name, optimize=True)


def main(arguments: list[str]) -> int:
    """Runs all scripts with the same options, tells how long each took and what it wrote; returns 1 if one failed."""
    parser = argparse.ArgumentParser(prog="paper_figures", description=__doc__)
    parser.add_argument("--out", type=Path, default=HERE / "out", help="folder of the figures")
    parser.add_argument("--results", type=Path, default=HERE.parent / "leaderboard" / "results", help="records")
    parser.add_argument("--pages", action="store_true", help="renew the pictures that docs/ shows, too")
    options = parser.parse_args(arguments)
    out: Path = options.out
    drawn: list[Path] = []
    failed: list[str] = []
    for script in scripts():
        begin = time.time()
        command = [sys.executable, str(script), "--out", str(out), "--results", str(options.results)]
        done = subprocess.run(command, check=False)
        written = sorted(path for path in out.glob("*") if path.stat().st_mtime >= begin)
        verdict = "FAILED" if done.returncode else "drawn"
        names = " ".join(path.name for path in written)
        print(f"{script.name:16} {verdict}, {time.time() - begin:.0f} s {names}".rstrip(), flush=True)
        drawn += written
        failed += [script.name] if done.returncode else []
    if options.pages:
        renew(drawn, PAGES)
    if failed:
        print(f"not drawn: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
