"""Evaluations as a table: a row for each run, then mean and spread; for the terminal and for Markdown."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from rich.table import Table
from rich.text import Text

from fd_mitsuba.errors import printable
from fd_mitsuba.evaluation.picture_difference import MOST_DECIBELS

Number = float | None


@dataclass(frozen=True)
class Column:
    """Attributes:
    title: with an arrow that says which way is better.
    value: of one evaluation; None where it has none.
    digits: behind the point.
    share: shown in per cent.
    """

    title: str
    value: Callable[[dict], Number]
    digits: int = 0
    share: bool = False

    def text(self, value: Number) -> str:
        """The number as people read it; "-" for none."""
        if value is None:
            return "-"
        return f"{value:.{self.digits}%}" if self.share else f"{value:.{self.digits}f}"


def _at(*path: str) -> Callable[[dict], Number]:
    def value(record: dict) -> Number:
        found: Any = record
        for key in path:
            found = found.get(key) if isinstance(found, dict) else None
        return None if found is None else float(found)

    return value


def _all_valid(found: dict) -> Number:
    parts = found.get("part", {}).get("parts", {}).values()
    return float(all(part["valid"] for part in parts)) if parts else None


COLUMNS = {
    "sim": Column("CLIP_sim ↑", _at("clip", "sim"), 3),
    "dir": Column("CLIP_dir, dot ↑", _at("clip", "dir_dot"), 4),
    "dir_cosine": Column("CLIP_dir, cosine ↑", _at("clip", "dir_cosine"), 3),
    "sim_simple": Column("CLIP_sim, simplified ↑", _at("clip_simple", "sim"), 3),
    "dir_simple": Column("CLIP_dir, simplified ↑", _at("clip_simple", "dir_dot"), 4),
    "rank": Column("rank of prompt ↓", _at("retrieval", "rank")),
    "rank_start": Column("before the run", _at("retrieval", "rank_start")),
    "rank_base": Column("with the base's ↓", _at("retrieval_with_base", "rank")),
    "rank_base_start": Column("before the run", _at("retrieval_with_base", "rank_start")),
    "rank_dir": Column("rank by change ↓", _at("retrieval", "rank_dir")),
    "rank_part": Column("rank of part ↓", _at("retrieval_parts", "rank")),
    "rank_part_start": Column("before the run ", _at("retrieval_parts", "rank_start")),
    "front_in_back": Column("front in back ↓", _at("multi_face", "excess"), 0, True),
    "psnr": Column("base PSNR, dB ↑", _at("base", "psnr_db"), 0),
    "ssim": Column("base SSIM ↑", _at("base", "ssim"), 4),
    "drift": Column("base colour drift ↓", _at("base", "colour_drift"), 4),
    "chamfer": Column("base Chamfer ↓", _at("base", "chamfer"), 4),
    "texture": Column("texture drift ↓", _at("base", "texture_difference"), 4),
    "step": Column("boundary step ↓", _at("boundary", "colour_step"), 3),
    "leakage": Column("leakage ↓", _at("part", "leakage"), 1, True),
    "overlap": Column("overlap ↓", _at("part", "overlap"), 1, True),
    "valid": Column("part valid ↑", _all_valid, 0, True),
    "seconds": Column("s", _at("cost", "seconds")),
    "memory": Column("MB", _at("cost", "peak_memory_mb")),
}
SHORT = ("sim", "dir", "dir_cosine", "rank", "rank_part", "psnr", "leakage", "overlap", "valid", "seconds")


def mean_and_spread(values: Sequence[Number]) -> tuple[Number, Number]:
    """Mean and sample standard deviation of those that are not None; None for what too few of them give."""
    known = [value for value in values if value is not None]
    if not known:
        return None, None
    return statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None


def spread_text(column: Column, values: Sequence[Number]) -> str:
    """ "mean ± spread", or the mean alone."""
    mean, spread = mean_and_spread(values)
    return column.text(mean) + ("" if spread is None else f" ± {column.text(spread)}")


def score_rows(results: Sequence[dict], columns: Sequence[Column]) -> list[list[str]]:
    """Text cells: scene, seed, judge with the kind of pictures, the columns; the last row is over all runs."""
    rows = []
    for found in results:
        head = [found["scene"], str(found["seed"]), _judge(found)]
        rows.append(head + [column.text(column.value(found)) for column in columns])
    if len(results) > 1:
        head = [f"all {len(results)}", "", ", ".join(dict.fromkeys(map(_judge, results)))]
        rows.append(head + [spread_text(column, [column.value(found) for found in results]) for column in columns])
    return rows


def scene_rows(results: Sequence[dict], columns: Sequence[Column]) -> list[list[str]]:
    """Text cells with "mean ± spread" over the seeds of each scene, and the number of runs in the seed's place."""
    scenes = dict.fromkeys(found["scene"] for found in results)
    rows = []
    for scene in scenes:
        mine = [found for found in results if found["scene"] == scene]
        head = [scene, str(len(mine)), ", ".join(dict.fromkeys(map(_judge, mine)))]
        rows.append(head + [spread_text(column, [column.value(found) for found in mine]) for column in columns])
    return rows


def summary_lines(results: Sequence[dict]) -> list[str]:
    """How many of the runs meet what is expected of every run, a sentence each."""
    lines = []

    def count(text: str, name: str, test: Callable[[float], bool], among: Sequence[dict] = results) -> None:
        values = [value for found in among if (value := COLUMNS[name].value(found)) is not None]
        if values:
            met = sum(map(test, values))
            lines.append(f"{text}: {met} of {len(values)} runs ({met / len(values):.0%})")

    count("own prompt ranked first", "rank", lambda rank: rank == 1)
    count("own prompt ranked first before the run", "rank_start", lambda rank: rank == 1)
    count("own prompt ranked first, and before the base's", "rank_base", lambda rank: rank == 1)
    count("own prompt ranked first, and before the base's, before the run", "rank_base_start", lambda rank: rank == 1)
    count("own prompt ranked first by change", "rank_dir", lambda rank: rank == 1)
    count("own part ranked first on its body", "rank_part", lambda rank: rank == 1)
    count("own part ranked first on its body before the run", "rank_part_start", lambda rank: rank == 1)
    count("CLIP_dir above 0", "dir", lambda value: value > 0)
    lit = [found for found in results if found["views"]["kind"] == "lit"]  # a bare shape has a fillet at its seam
    count("untouched pixels of the base equal", "psnr", lambda value: value >= MOST_DECIBELS, lit)
    count("leakage at most 1 %", "leakage", lambda value: value <= 0.01)
    count("parts valid", "valid", lambda value: value == 1)
    return lines


def rich_table(header: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> Table:
    """The same cells for a terminal."""
    table = Table(title=title or None, box=None, pad_edge=False)
    for name in header:
        table.add_column(name, justify="left" if name in ("scene", "judge", "run") else "right", overflow="fold")
    for row in rows:
        table.add_row(*(Text(printable(cell)) for cell in row))
    return table


def markdown_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """The same cells in Markdown, ready for a document."""
    lines = [header, ["---"] * len(header), *rows]
    return "".join(f"| {' | '.join(cell.replace('|', '/') for cell in line)} |\n" for line in lines)


def header(columns: Sequence[Column]) -> list[str]:
    """Titles above `score_rows`."""
    return ["scene", "seed", "judge", *(column.title.strip() for column in columns)]


def _judge(found: dict) -> str:
    return f"{found['judge']}, {found['views']['kind']}"
