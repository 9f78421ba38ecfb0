"""The command reference, from the parsers of the command line."""

from __future__ import annotations

import argparse

from fd_mitsuba.cli.main import command_parser

HEADER = """# Commands

`fd_mitsuba` is the command that the package installs; `python -m fd_mitsuba` is the same. Every command has `--help`.
Exit codes: 0 done, 1 bad input, 2 wrong usage, 130 interrupted by SIGINT or SIGTERM.

Shell completion: `eval "$(fd_mitsuba --print-completion bash)"` in `~/.bashrc`; `zsh` and `tcsh` likewise.
"""


def commands_page() -> str:
    """The page as Markdown."""
    parser = command_parser()
    return "\n".join([HEADER, *_commands(parser, "##")])


def _commands(parser: argparse.ArgumentParser, level: str) -> list[str]:
    blocks = []
    for group in parser._actions:
        if not isinstance(group, argparse._SubParsersAction):
            continue
        helps = {choice.dest: choice.help for choice in group._choices_actions}
        for name, command in group.choices.items():
            about = command.description or helps.get(name) or ""
            blocks += [f"{level} {command.prog}\n", f"{_sentence(about)}\n", _usage(command), _table(command)]
            blocks += _commands(command, f"{level}#")
    return blocks


def _usage(command: argparse.ArgumentParser) -> str:
    formatter = argparse.HelpFormatter(command.prog, width=100)
    formatter.add_usage(command.usage, command._actions, command._mutually_exclusive_groups)
    return f"```text\n{formatter.format_help().removeprefix('usage: ').strip()}\n```\n"


def _table(command: argparse.ArgumentParser) -> str:
    formatter = command._get_formatter()
    rows = []
    for action in command._actions:
        if isinstance(action, (argparse._HelpAction, argparse._SubParsersAction)):
            continue
        about = formatter._expand_help(action) if action.help else ""
        rows.append(f"| {_written(action)} | {_plain(about)} |")
    return "\n".join(["| argument | meaning |", "|---|---|", *rows]) + "\n" if rows else ""


def _written(action: argparse.Action) -> str:
    value = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices is not None else action.dest.upper()
    )
    if not action.option_strings:
        return f"`{value}`"
    return ", ".join(f"`{option}`" for option in action.option_strings) + ("" if action.nargs == 0 else f" `{value}`")


def _plain(text: str) -> str:
    """Text that Markdown and HTML leave as it is within a table."""
    for mark, written in (("&", "&amp;"), ("<", "&lt;"), (">", "&gt;"), ("|", "\\|"), ("*", "\\*"), ("_", "\\_")):
        text = text.replace(mark, written)
    return text


def _sentence(text: str) -> str:
    text = " ".join(text.split())
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")
