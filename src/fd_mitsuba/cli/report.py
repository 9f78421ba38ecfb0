"""The command `report`: pages that show runs."""

from __future__ import annotations

import argparse
from pathlib import Path

from fd_mitsuba.cli.options import remark, say
from fd_mitsuba.errors import UserError


def add_report_commands(commands: argparse._SubParsersAction) -> None:
    """Put `report` beside the other commands."""
    report = commands.add_parser("report", help="write RUN/report.html anew, and a gallery of many runs")
    report.add_argument("runs", nargs="+", metavar="RUN", help="run folders, finished or interrupted")
    report.add_argument("--gallery", metavar="FILE", help="also one page over all of them")
    report.add_argument("--title", default="Runs", help="of the gallery")
    report.add_argument("-v", "--verbose", action="store_true", help="tracebacks")
    report.set_defaults(call=_report)


def _report(options: argparse.Namespace) -> int:
    from fd_mitsuba.evaluation.report.gallery import write_gallery
    from fd_mitsuba.evaluation.report.run_page import write_report

    folders, failed = [Path(run) for run in options.runs], 0
    for folder in folders:
        try:
            say(write_report(folder))
        except UserError as error:
            if len(folders) == 1:
                raise
            failed += 1
            remark(f"error: {error}")
    if options.gallery:
        # What cannot be shown was said above, and the page says it too.
        say(write_gallery(folders, Path(options.gallery), options.title, lambda line: None))
    return 1 if failed else 0
