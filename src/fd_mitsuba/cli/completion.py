"""The option `--print-completion`: a script with which a shell completes commands, options and file names."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

SHELLS = ("bash", "zsh", "tcsh")
_FILES = {"scene", "scenes", "FILE", "FILE|NAME", "SCENE"}
_FOLDERS = {"RUN", "FOLDER"}
"""Names or metavars of arguments for which the shell offers files, or folders only."""


def add_completion_option(parser: argparse.ArgumentParser) -> None:
    """Give the whole command line's parser `--print-completion SHELL`."""
    parser.add_argument(
        "--print-completion",
        action=_PrintCompletion,
        choices=SHELLS,
        metavar="SHELL",
        help=f"print a completion script for {', '.join(SHELLS)} and exit",
    )


class _PrintCompletion(argparse.Action):
    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> None:
        import shtab  # needed for nothing else

        for action in _arguments(parser):
            names = {action.dest, str(action.metavar)}
            offered = shtab.FILE if names & _FILES else shtab.DIRECTORY if names & _FOLDERS else None
            if offered is not None:
                action.complete = offered  # type: ignore[attr-defined]  # where shtab looks for it
        print(shtab.complete(parser, shell=str(values)))
        parser.exit(0)


def _arguments(parser: argparse.ArgumentParser) -> Iterator[argparse.Action]:
    """Options and arguments of a parser and of its commands."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for command in action.choices.values():
                yield from _arguments(command)
        else:
            yield action
