"""Put measured figures into the model card: `python benchmarks/model_card_tables.py`.

Reads what `fd_mitsuba prior evaluate` (both kinds) and `benchmarks/prior_in_3d.py` left in `runs/` and rewrites the
tables of `src/fd_mitsuba/weights/MODEL_CARD.md` between their markers. A missing file leaves its table as it is.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
CARD = ROOT / "src" / "fd_mitsuba" / "weights" / "MODEL_CARD.md"

_SAMPLE_COLUMNS = (
    *("recall", "recall_in_truth", "body_named", "body_named_in_truth"),
    *("body_kept", "body_kept_in_truth", "shape_kept"),
)


def share(value: float | None) -> str:
    """A percentage, or a dash for None."""
    return "-" if value is None else f"{value:.0%}"


def samples_table(report: dict) -> list[str]:
    """Rows a part, then all of them, unseen pairs, and prompts without a part."""
    titles = "part | samples | found | in truth | body named | in truth | its pixels kept | in truth | its shape"
    lines = [f"| {titles} |", "|---" * 9 + "|"]
    named = {**report["per_part"], "all": report["overall"], "pairs kept out of training": report["held_out"]}
    for name, row in named.items():
        cells = [share(row[key]) for key in _SAMPLE_COLUMNS]
        lines.append(f"| {name} | {row['samples']} | {' | '.join(cells)} |")
    plain = report["plain"]
    lines += [
        "",
        f"Prompts without a part leave the base unchanged in {share(plain['unchanged'])} of {plain['samples']}.",
    ]
    return lines


def runs_table(report: dict) -> list[str]:
    """A row a run, then the means."""
    lines = ["| prompt | found | at start | named |", "|---|---|---|---|"]
    for case in report["cases"].values():
        mark = " (untrained)" if case["untrained"] else ""
        if "end" not in case:
            lines.append(f"| {case['prompt']}{mark} | - | - | {case.get('problem')} |")
            continue
        found, start = share(case["end"]["found"]), share(case["start"]["found"])
        lines.append(f"| {case['prompt']}{mark} | {found} | {start} | {case['end']['named']} |")
    for name in ("all", "trained", "untrained"):
        row = report[name]
        cells = [share(row[key]) for key in ("found", "found_at_start", "named_right")]
        lines.append(f"| mean, {name} ({row['cases']}) | {' | '.join(cells)} right |")
    return lines


def colours_table(report: dict) -> list[str]:
    """A row for samples and for painted parts, then how metallic and rough they became."""
    lines = ["| | prompts | nearest | of colours | of materials |", "|---|---|---|---|---|"]
    for name in ("sampled", "painted"):
        row = report[name]
        if row:
            cells = [share(row[key]) for key in ("all", "colours", "materials")]
            lines.append(f"| {name} | {row['prompts']} | {' | '.join(cells)} |")
    if report["painted"]:
        for channel in ("metallic", "roughness"):
            means = ", ".join(f"{name} {value:.2f}" for name, value in report["painted"][channel].items())
            lines += ["", f"Mean {channel} of painted parts: {means}."]
    return lines


TABLES: dict[str, tuple[str, Callable[[dict], list[str]]]] = {
    "samples": ("prior_geometry.json", samples_table),
    "runs": ("prior_in_3d/results.json", runs_table),
    "colours": ("prior_appearance.json", colours_table),
}


def filled(card: str, name: str, lines: list[str]) -> str:
    """The card with other lines between the markers of a table. Raises ValueError if it has no such markers."""
    pattern = re.compile(rf"(<!-- table: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not pattern.search(card):
        raise ValueError(f"no table {name} in the card")
    text = "\n".join(lines) + "\n"
    return pattern.sub(lambda match: match[1] + text + match[2], card)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs", metavar="FOLDER")
    parser.add_argument("--card", type=Path, default=CARD, metavar="FILE")
    options = parser.parse_args()
    card = options.card.read_text(encoding="utf-8")
    for name, (file, table) in TABLES.items():
        path = options.runs / file
        if path.is_file():
            card = filled(card, name, table(json.loads(path.read_text(encoding="utf-8"))))
        print(f"{name}: {path if path.is_file() else f'{path} is missing, left as it is'}")
    options.card.write_text(card, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
