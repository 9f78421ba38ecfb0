"""`compare.html`: the table and the figures of a comparison as one page that loads nothing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from fd_mitsuba.baselines.jobs import FAILED, JobOutcome
from fd_mitsuba.evaluation.report.run_numbers import Titled
from fd_mitsuba.evaluation.report.run_page import PAGE, page_template
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.viewing.film_strip import picture_uri, read_picture

_FIGURES = {
    "compare.png": "By scene and method, two views: three quarters from the front, and from behind",
    "compare_2d.png": "Editors of single images: three views before and after, and their consistency",
}
_WIDEST = 4096


def write_page(
    outcomes: Sequence[JobOutcome], header: Sequence[str], rows: Sequence[Sequence[str]], note: str, folder: Path
) -> None:
    """Write `compare.html` beside the figures that lie in `folder`.

    Args:
        header, rows: of the table. note: what stands above it.
    """
    figures = []
    for name, title in _FIGURES.items():
        if (image := read_picture(folder / name)) is not None:
            figures.append(Titled(title, picture_uri(image, _WIDEST)))
    text = page_template("compare.html.j2").render(
        title="Comparison of methods",
        css=(PAGE / "page.css").read_text(encoding="utf-8"),
        note=note,
        header=header,
        rows=rows,
        figures=figures,
        failed=[outcome for outcome in outcomes if outcome.state == FAILED],
    )
    write_atomically(folder / "compare.html", text.encode(errors="backslashreplace"))
