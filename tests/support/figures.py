"""Writes figures of merit in docs/figures.md anew: what stands between two marks is a command's last lines.

    python tests/support/figures.py                 every figure, half an hour
    python tests/support/figures.py traced_slots    those of commands that hold this text

A mark is ``<!-- figures: LINES COMMAND -->``, its end ``<!-- end -->``; nothing outside of marks is changed.
"""

import argparse
import re
import shlex
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "figures.md"
_BLOCK = re.compile(r"(<!-- figures: (\d+) (.+?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def measured(command: str, count: int) -> str:
    # Return the last lines of what a command prints, as rows of a table or as text
    words = shlex.split(command)
    words[0] = sys.executable if words[0] == "python" else words[0]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    lines = [line.rstrip() for line in done.stdout.rstrip().splitlines()[-count:]]
    # 1 says that a goal was missed; anything else, that it did not come to its end
    if not lines or done.returncode not in (0, 1) or "Traceback" in done.stderr:
        raise SystemExit(f"{command}: exit {done.returncode}\n{done.stderr[-2000:]}")
    body = "\n".join(lines)
    print(f"{command}\n{body}\n", flush=True)
    return f"{body}\n" if lines[0].startswith("|") else f"```\n{body}\n```\n"


def main() -> int:
    # Run the commands one after another, and write the page after each
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("wanted", nargs="?", default="", help="part of a command")
    wanted = parser.parse_args().wanted
    commands = [block[3] for block in _BLOCK.finditer(PAGE.read_text(encoding="utf-8"))]
    for command in (each for each in commands if wanted in each):
        page = PAGE.read_text(encoding="utf-8")
        block = next(block for block in _BLOCK.finditer(page) if block[3] == command)
        text = f"{block[1]}{measured(command, int(block[2]))}{block[5]}"
        PAGE.write_text(page.replace(block[0], text), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
