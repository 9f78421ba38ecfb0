"""The actions `prior train`, `pack` and `build-data`: making a prior, an evaluator or a judge of parts."""

from __future__ import annotations

import argparse
from pathlib import Path

from fd_mitsuba.errors import UserError


def add_training(actions: argparse._SubParsersAction) -> None:
    """Put the three actions beside the others of `prior`."""
    train = actions.add_parser("train", help="train on fresh images; goes on where the folder's checkpoint ends")
    train.add_argument(
        "--kind",
        default="geometry",
        help="geometry (normals), geometry_wide (of 32 parts), appearance (colours), geometry_fine or appearance_fine "
        "(at 64 pixels a view), evaluator (the metrics' CLIP), part_judge (gives a run its verdict) or "
        "part_judge_coarse (that of the benchmarks)",
    )
    train.add_argument("-o", "--output", default="runs/prior", metavar="FOLDER", help="checkpoint and log")
    train.add_argument("--steps", type=int, help="length of the schedule; default: what the kind takes to be good")
    train.add_argument("--hours", type=float, default=8.0, help="stop after this time at the latest")
    train.add_argument("--init", metavar="FOLDER", help="start from a packed prior instead of random weights")
    train.add_argument("--data", metavar="FOLDER", help="train on stored pairs of build-data instead of fresh ones")
    train.add_argument("--bf16", action="store_true", help="bfloat16: faster on a processor that has it (AVX512-BF16)")
    train.add_argument("--batch", type=int, default=8, metavar="N", help="images a step; default: 8")
    train.add_argument("--rate", type=float, metavar="R", help="highest learning rate; default: the kind's own")
    train.add_argument("--device", default="cpu", help="cpu or cuda; with cuda, render by --workers or from --data")
    train.add_argument(
        "--workers", type=int, default=0, metavar="N", help="processes that render; default: the training itself"
    )
    train.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    train.add_argument("-t", "--threads", type=int, default=0, metavar="N", help="threads; default: all cores")
    train.set_defaults(call=_prior_train)
    pack = actions.add_parser("pack", help="write a checkpoint as a pipeline folder")
    pack.add_argument("checkpoint", help="checkpoint.pt of a training")
    pack.add_argument("-o", "--output", required=True, metavar="FOLDER", help="the pipeline folder")
    pack.set_defaults(call=_prior_pack)
    build = actions.add_parser("build-data", help="write training pairs as files; goes on where a killed call ended")
    build.add_argument("-o", "--output", default="runs/prior_data", metavar="FOLDER", help="default: %(default)s")
    build.add_argument(
        "--kind", default="geometry", help="geometry, geometry_fine, appearance (colours) or appearance_fine"
    )
    build.add_argument("--count", type=int, default=2048, help="pairs of four views each; default: 2048")
    build.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    build.add_argument("-t", "--threads", type=int, default=0, metavar="N", help="threads; default: all cores")
    build.set_defaults(call=_prior_build_data)


def _prior_train(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import network_threads, share_cores

    share_cores(options.threads)
    if options.kind == "evaluator":
        return _evaluator_train(options)
    if options.kind.startswith("part_judge"):
        return _part_judge_train(options)
    from fd_mitsuba.guidance.device import require_device
    from fd_mitsuba.prior.training.dataset import StoredPairs
    from fd_mitsuba.prior.training.kinds import kind_named
    from fd_mitsuba.prior.training.train import train

    if options.batch < 1 or options.workers < 0:
        raise UserError(f"--batch {options.batch}, --workers {options.workers}: at least 1 and at least 0")
    kind, device = kind_named(options.kind), require_device(options.device, "--device")
    init = Path(options.init) if options.init else None
    if init is not None and not (init / "model_index.json").is_file():
        raise UserError(f"{init}: not a packed prior; make one with fd_mitsuba prior pack")
    with network_threads():
        train(
            Path(options.output),
            options.hours * 3600,
            kind=kind,
            total_steps=options.steps,
            rate=options.rate,
            seed=options.seed,
            init=init,
            pairs=StoredPairs(Path(options.data), kind, options.seed) if options.data else None,
            half=options.bf16,
            batch_size=options.batch,
            device=str(device),
            workers=options.workers,
        )
    print(f"{options.output}: checkpoint.pt and log.jsonl")
    return 0


def _evaluator_train(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import network_threads
    from fd_mitsuba.prior.training.clip_train import DATA, STEPS, train_evaluator

    if options.init:
        raise UserError("--init: an evaluator starts from random weights; leave it out")
    data = Path(options.data) if options.data else DATA
    with network_threads():
        steps = STEPS if options.steps is None else options.steps
        train_evaluator(Path(options.output), options.hours * 3600, total_steps=steps, seed=options.seed, data=data)
    print(f"{options.output}: checkpoint.pt and log.jsonl; {data}: its images")
    return 0


def _part_judge_train(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import network_threads
    from fd_mitsuba.prior.training.part_judge_train import judge_kind, train_part_judge

    if options.init:
        raise UserError("--init: a judge of parts starts from random weights; leave it out")
    output = Path(options.output)
    with network_threads():
        train_part_judge(output, judge_kind(options.kind), options.hours * 3600, options.steps)
    print(f"{output}: weights.safetensors, classes.json; checkpoint.pt, log.jsonl and views may go")
    return 0


def _prior_pack(options: argparse.Namespace) -> int:
    from fd_mitsuba.prior.training.pack import pack

    if not Path(options.checkpoint).is_file():
        raise UserError(f"{options.checkpoint}: no such checkpoint; make one with fd_mitsuba prior train")
    pack(Path(options.checkpoint), Path(options.output))
    print(options.output)
    return 0


def _prior_build_data(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import share_cores

    share_cores(options.threads)
    from fd_mitsuba.prior.training.dataset import build_data
    from fd_mitsuba.prior.training.kinds import kind_named

    made = build_data(Path(options.output), options.count, options.seed, kind_named(options.kind), print)
    print(
        f"{options.output}: {made['pairs']} pairs made in {made['seconds']} s, {made['pairs_per_second']} a second, "
        f"or {made['views_per_second']} pairs of single views"
    )
    return 0
