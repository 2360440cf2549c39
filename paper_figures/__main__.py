"""Draws every figure and table: `python paper_figures`, one script after the other, past those that cannot be drawn."""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
SCRIPT = 'if __name__ == "__main__":'  # what a script ends with, and what scripts share does not


def scripts() -> list[Path]:
    """Returns the scripts of this folder, by name."""
    return [path for path in sorted(HERE.glob("*.py")) if path.stem != "__main__" and SCRIPT in path.read_text()]


def main(arguments: list[str]) -> int:
    """Runs all scripts with the same options, tells how long each took and what it wrote; returns 1 if one failed."""
    options = argparse.ArgumentParser(prog="paper_figures", description=__doc__)
    options.add_argument("--out", type=Path, default=HERE / "out", help="folder of the figures")
    options.add_argument("--results", type=Path, default=HERE.parent / "leaderboard" / "results", help="records")
    out, failed = options.parse_args(arguments).out, []
    for script in scripts():
        begin = time.time()
        done = subprocess.run([sys.executable, str(script), *arguments], check=False)
        written = sorted(path.name for path in out.glob("*") if path.stat().st_mtime >= begin)
        verdict = "FAILED" if done.returncode else "drawn"
        print(f"{script.name:16} {verdict}, {time.time() - begin:.0f} s {' '.join(written)}".rstrip(), flush=True)
        failed += [script.name] if done.returncode else []
    if failed:
        print(f"not drawn: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
