"""The command `prior`: what the built-in prior knows, and for its developers, training and packing."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from fd_mitsuba.errors import UserError


def add_prior_commands(commands: argparse._SubParsersAction) -> None:
    """Put `prior` and its actions beside the other commands."""
    prior = commands.add_parser("prior", help="the words that the built-in prior knows; train and pack a new one")
    prior.add_argument("--json", action="store_true")
    prior.set_defaults(call=_prior)
    actions = prior.add_subparsers(dest="action", metavar="ACTION")
    train = actions.add_parser("train", help="train on fresh pictures; goes on where the folder's checkpoint ends")
    train.add_argument("--kind", default="geometry", help="geometry (normals) or appearance (colours)")
    train.add_argument("-o", "--output", default="runs/prior", metavar="FOLDER", help="checkpoint and log")
    train.add_argument("--steps", type=int, default=4000, help="length of the schedule")
    train.add_argument("--hours", type=float, default=8.0, help="stop after this time at the latest")
    train.add_argument("--init", metavar="FOLDER", help="start from a packed prior instead of random weights")
    train.add_argument("--seed", type=int, default=0)
    train.add_argument("-t", "--threads", type=int, default=0, metavar="N")
    train.set_defaults(call=_prior_train)
    pack = actions.add_parser("pack", help="write a checkpoint as a pipeline folder")
    pack.add_argument("checkpoint", help="checkpoint.pt of a training")
    pack.add_argument("-o", "--output", required=True, metavar="FOLDER")
    pack.set_defaults(call=_prior_pack)
    evaluate = actions.add_parser(
        "evaluate", help="sample the shape prior: a contact sheet beside the truth, and figures"
    )
    evaluate.add_argument("folder", nargs="?", help="packed prior; default: the built-in one")
    evaluate.add_argument("-o", "--output", default="runs/prior_samples.png", metavar="FILE")
    evaluate.add_argument("--bodies", default="horse,cat,snowman,mug", metavar="A,B", help="default: %(default)s")
    evaluate.add_argument("--parts", default="", metavar="A,B", help="default: all")
    evaluate.add_argument("--steps", type=int, default=16, help="of DDIM; default: 16")
    evaluate.add_argument("--seed", type=int, default=0)
    evaluate.set_defaults(call=_prior_evaluate)


def _prior(options: argparse.Namespace) -> int:
    from fd_mitsuba.guidance.builtin import builtin_folder
    from fd_mitsuba.guidance.model_conventions import read_model_conventions

    words = read_model_conventions(builtin_folder()).vocabulary.model_dump(mode="json")
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


def _prior_train(options: argparse.Namespace) -> int:
    from fd_mitsuba.threads import network_threads, share_cores

    share_cores(options.threads)
    from fd_mitsuba.prior.kinds import kind_named
    from fd_mitsuba.prior.train import train

    kind = kind_named(options.kind)
    init = Path(options.init) if options.init else None
    if init is not None and not (init / "model_index.json").is_file():
        raise UserError(f"{init}: not a packed prior; make one with fd_mitsuba prior pack")
    with network_threads():
        train(
            Path(options.output),
            options.hours * 3600,
            kind=kind,
            total_steps=options.steps,
            seed=options.seed,
            init=init,
        )
    print(f"{options.output}: checkpoint.pt and log.jsonl")
    return 0


def _prior_pack(options: argparse.Namespace) -> int:
    from fd_mitsuba.prior.pack import pack

    if not Path(options.checkpoint).is_file():
        raise UserError(f"{options.checkpoint}: no such checkpoint; make one with fd_mitsuba prior train")
    pack(Path(options.checkpoint), Path(options.output))
    print(options.output)
    return 0


def _prior_evaluate(options: argparse.Namespace) -> int:
    from fd_mitsuba.guidance.builtin import builtin_folder
    from fd_mitsuba.prior.evaluate import evaluate
    from fd_mitsuba.prior.parts import PARTS

    folder = Path(options.folder) if options.folder else builtin_folder()
    names = [[name.strip() for name in text.split(",") if name.strip()] for text in (options.bodies, options.parts)]
    figures = evaluate(folder, Path(options.output), names[0], names[1] or list(PARTS), options.seed, options.steps)
    for row in figures:
        held_out = " (combination kept out of training)" if row.held_out else ""
        print(
            f"{row.part or 'no part'}{held_out}: {row.count} samples, body kept in {row.body_kept:.0%}, "
            f"overlap with the true part {row.overlap:.2f}"
        )
    print(options.output)
    return 0
