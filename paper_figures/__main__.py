"""Draws every figure and table: `python paper_figures`, one script after the other, past those that cannot be drawn."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

HERE = Path(__file__).parent
LIBRARY = ("__main__", "drawing", "recorded", "scenes")  # what scripts share


def scripts() -> list[Path]:
    """Returns the scripts, by name: every other file of this folder."""
    return [path for path in sorted(HERE.glob("*.py")) if path.stem not in LIBRARY]


def main(arguments: list[str]) -> int:
    """Runs all scripts with the same options, tells what each took, and returns 1 if one failed."""
    failed = []
    for script in scripts():
        begin = time.perf_counter()
        done = subprocess.run([sys.executable, str(script), *arguments], check=False)
        print(f"{script.name:16} {'drawn' if done.returncode == 0 else 'FAILED'}, {time.perf_counter() - begin:.0f} s")
        failed += [script.name] if done.returncode else []
    if failed:
        print(f"not drawn: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
