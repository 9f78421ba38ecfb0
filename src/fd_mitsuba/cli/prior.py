"""The command `prior`: what the built-in prior knows; its actions, for its developers, are in modules of their own."""

from __future__ import annotations

import argparse
import json

from fd_mitsuba.cli.prior_evaluate import add_evaluate
from fd_mitsuba.cli.prior_train import add_training


def add_prior_commands(commands: argparse._SubParsersAction) -> None:
    """Put `prior` and its actions beside the other commands."""
    prior = commands.add_parser("prior", help="the words that the built-in prior knows; train and pack a new one")
    prior.add_argument("--json", action="store_true", help="machine-readable")
    prior.set_defaults(call=_prior)
    actions = prior.add_subparsers(dest="action", metavar="ACTION")
    add_training(actions)
    add_evaluate(actions)


def _prior(options: argparse.Namespace) -> int:
    from fd_mitsuba.guidance.builtin import WIDE_FOLDER, builtin_folder
    from fd_mitsuba.guidance.model_conventions import read_model_conventions

    vocabulary = read_model_conventions(builtin_folder(WIDE_FOLDER)).vocabulary
    assert vocabulary is not None  # the shipped prior's
    words = vocabulary.model_dump(mode="json")
    if options.json:
        print(json.dumps(words, indent=2))
        return 0
    for group in ("bodies", "parts"):
        print(f"{group}:")
        for synonyms in words[group].values():
            print(f"  {', '.join(synonyms)}")
    print(f"wholes: {', '.join(words['wholes'])}")
    print(f"other words: {', '.join(words['words'])}")
    print('a prompt is a sentence such as "a horse with two wings"; for anything else set guidance.model to the')
    print("folder or hub id of a Stable Diffusion model")
    return 0
