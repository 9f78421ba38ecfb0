"""What is kept of a batch: `batch.json`, and the table for the terminal."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from fd_mitsuba.batch.job import FAILED, Job, Outcome
from fd_mitsuba.errors import printable
from fd_mitsuba.io.json_object import read_json_object

_STYLES = {"finished": "green", "skipped": "dim", "failed": "bold red", "interrupted": "yellow"}


def write_record(path: Path, jobs: Sequence[Job], outcomes: Mapping[Job, Outcome]) -> None:
    """Write the file anew: a row for each job, those without an outcome `waiting`; rows of other jobs are kept."""
    rows = [outcomes.get(job, Outcome(job, "waiting")).to_json() for job in jobs]
    names = {row["folder"] for row in rows}
    earlier = [row for row in read_record(path) if row.get("folder") not in names]
    # Not `io.atomic.write_atomically`: a batch waits for hours, and torch need not lie in memory for that.
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    draft.write_text(json.dumps({"jobs": earlier + rows}, indent=2) + "\n", encoding="utf-8")
    os.replace(draft, path)


def read_record(path: Path) -> list[dict]:
    """The rows of a `batch.json`; none where there is none or it is damaged."""
    rows = (read_json_object(path) or {}).get("jobs")
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def print_table(outcomes: Sequence[Outcome], console: Console) -> None:
    """One row a job: name, state, seconds, attempts, and for failures the message and the log."""
    table = Table(box=None, pad_edge=False)
    for title in ("run", "state", "seconds", "attempts", "remark"):
        table.add_column(title, justify="right" if title in ("seconds", "attempts") else "left", overflow="fold")
    for outcome in outcomes:
        log = f" ({outcome.job.log})" if outcome.state == FAILED else ""
        state = f"[{_STYLES.get(outcome.state, '')}]{outcome.state}[/]" if outcome.state in _STYLES else outcome.state
        cells = (f"{outcome.seconds:.0f}" if outcome.seconds else "", str(outcome.attempts or ""))
        name, remark = (Text(printable(text)) for text in (outcome.job.name, outcome.message + log))
        table.add_row(name, state, *cells, remark)
    console.print(table)
