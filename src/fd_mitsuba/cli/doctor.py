"""The command `doctor`."""

from __future__ import annotations

import argparse
import json

from fd_mitsuba.cli.options import say


def add_doctor_command(commands: argparse._SubParsersAction) -> None:
    """Put `doctor` beside the other commands."""
    doctor = commands.add_parser("doctor", help="what this machine offers: LLVM, Mitsuba, torch, the built-in prior")
    doctor.add_argument("--json", action="store_true", help="machine-readable")
    doctor.set_defaults(call=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from fd_mitsuba.runs.doctor import examine

    findings = examine()
    if options.json:
        print(json.dumps({finding.name: {"ok": finding.ok, "found": finding.text} for finding in findings}, indent=2))
    else:
        for finding in findings:
            say(f"{'ok ' if finding.ok else 'BAD'} {finding.name}: {finding.text}")
    return 0 if all(finding.ok for finding in findings) else 1
