"""Wraps the prose of Markdown files at 120 columns; headings, tables, code, HTML and link definitions stay as they are.

    python tools/wrap_markdown.py [--check] [FILE...]      # default: all of the repository's

A paragraph or list item is laid anew only if one of its lines is too long; all others keep their line breaks. `--check`
writes nothing. What stays too long is listed: lines of code, and with `--tables` rows of tables.
"""

from __future__ import annotations

import argparse
import re
import sys
import textwrap
from pathlib import Path

ROOT = Path(__file__).parents[1]
WIDTH = 120
FOLDERS = ("benchmarks", "docs", "examples", "scenes", "src", "tests", "tools")
_ITEM = re.compile(r"^(\s*)([-*+]|\d+[.)])\s+")
_FENCE = re.compile(r"^\s*(```|~~~)")
_BEGINS = re.compile(r"^\s*(#{1,6}\s|\||<|>|:::|\[[^\]]+\]:\s|!\[.*\)$|\$\$|---+\s*$)")
"""Lines that are no prose, or that a break must not be moved across."""


def wrapped(text: str) -> str:
    """The same Markdown with too long paragraphs laid anew."""
    out: list[str] = []
    block: list[str] = []
    fenced = False
    for line in text.split("\n"):
        fence = bool(_FENCE.match(line))
        plain = fenced or fence or not line.strip() or _BEGINS.match(line)
        indented = not block and _is_code(line, out)
        if plain or indented or (block and _ITEM.match(line)):
            out += _laid(block)
            block = []
        if plain or indented:
            out.append(line)
        else:
            block.append(line)
        fenced ^= fence
    return "\n".join([*out, *_laid(block)])


def too_long(text: str, tables: bool = False) -> list[int]:
    """Numbers of the lines beyond the width; rows of tables count if `tables`, lines of a single word never."""
    return [
        number
        for number, line in enumerate(text.split("\n"), 1)
        if len(line) > WIDTH and (tables or not line.lstrip().startswith("|")) and len(line.split()) > 1
    ]


def markdown_files() -> list[Path]:
    """The repository's own Markdown files; the notices of a bundled library keep their form."""
    found = [*ROOT.glob("*.md"), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.md"))]
    return sorted(path for path in found if not {"node_modules", "model_viewer"} & set(path.parts))


def _is_code(line: str, before: list[str]) -> bool:
    """Whether a line is indented code: four blanks, after a blank line, and not below a list item."""
    if not line.startswith("    "):
        return False
    above = [known for known in before if known.strip()]
    above = [known for known in above if not known.startswith("    ")] if above else []
    return not (above and _ITEM.match(above[-1]))


def _laid(block: list[str]) -> list[str]:
    if all(len(line) <= WIDTH for line in block):
        return block
    item = _ITEM.match(block[0])
    first = item[0] if item else block[0][: len(block[0]) - len(block[0].lstrip())]
    later = " " * len(first) if item else first
    words = " ".join(line.strip() for line in block)[len(first.lstrip()) :] if item else " ".join(map(str.strip, block))
    lines = textwrap.wrap(
        _glued(words),
        WIDTH,
        initial_indent=first,
        subsequent_indent=later,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return [line.replace("\0", " ") for line in lines]


def _glued(words: str) -> str:
    """Blanks within code and link texts' brackets do not break, nor does one before a word that would begin a list."""
    words = re.sub(r"`[^`]*`", lambda match: match[0].replace(" ", "\0"), words)
    return re.sub(r" (?=(?:[-*+>|]|\d+[.)]) |#)", "\0", words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("files", nargs="*", type=Path, help="default: all of the repository's")
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a line is too long")
    parser.add_argument("--tables", action="store_true", help="rows of tables count, too")
    options = parser.parse_args()
    bad = 0
    for path in options.files or markdown_files():
        text = path.read_text(encoding="utf-8")
        if not options.check:
            path.write_text(text := wrapped(text), encoding="utf-8")
        for number in too_long(text, options.tables):
            print(f"{path}:{number}: longer than {WIDTH} columns")
            bad += 1
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
