"""The table of a comparison: a row for each method, means and spreads over scenes and seeds, the paper's beside."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from fd_mitsuba.evaluation.report.score_table import COLUMNS, Column, Number, spread_text

PAPER = {
    "focaldreamer": ("0.329", "0.0519"),
    "fantasia3d": ("0.284", "0.0180"),
    "voxe": ("0.293", "0.0178"),
    "voxe_global": ("0.299", "0.0204"),
}
"""The paper's Table 1, CLIP_sim and CLIP_dir: ViT-B/32 over its own fifteen scenes."""


def _of(*path: str, digits: int = 0, share: bool = False, title: str) -> Column:
    def value(record: dict) -> Number:
        found: Any = record
        for key in path:
            found = found.get(key) if isinstance(found, dict) else None
        return None if found is None else float(found)

    return Column(title, value, digits, share)


COMPARED = (
    COLUMNS["sim"],
    COLUMNS["dir"],
    _of("base", "psnr_db", digits=1, title="PSNR outside the regions, dB ↑"),
    _of("base", "chamfer", digits=4, title="Chamfer outside the regions ↓"),
    COLUMNS["leakage"],
    COLUMNS["front_in_back"],
    _of("consistency", "explained", share=True, title="view consistency ↑"),
    COLUMNS["seconds"],
    _of("cost", "guidance_calls", title="guidance calls"),
)


def compare_header() -> list[str]:
    """Titles above `compare_rows`."""
    return ["method", "paper CLIP_sim", "paper CLIP_dir", *(column.title for column in COMPARED), "results"]


def compare_rows(results: Sequence[dict], methods: Sequence[str]) -> list[list[str]]:
    """Text cells: "mean ± standard deviation" of every method's results, "-" where there is nothing to say."""
    rows = []
    for method in methods:
        mine = [found for found in results if found["method"] == method]
        cells = [spread_text(column, [column.value(found) for found in mine]) if mine else "-" for column in COMPARED]
        rows.append([method, *PAPER.get(method, ("-", "-")), *cells, str(len(mine))])
    return rows
