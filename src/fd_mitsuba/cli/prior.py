"""The command `prior`: what the built-in prior knows, and for its developers, training and packing."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from fd_mitsuba.cli.options import remark
from fd_mitsuba.errors import UserError

ROUNDS_OF_BODIES = 3
"""Unseen random bodies of each name on which a judge of parts is measured."""


def add_prior_commands(commands: argparse._SubParsersAction) -> None:
    """Put `prior` and its actions beside the other commands."""
    prior = commands.add_parser("prior", help="the words that the built-in prior knows; train and pack a new one")
    prior.add_argument("--json", action="store_true", help="machine-readable")
    prior.set_defaults(call=_prior)
    actions = prior.add_subparsers(dest="action", metavar="ACTION")
    train = actions.add_parser("train", help="train on fresh images; goes on where the folder's checkpoint ends")
    train.add_argument(
        "--kind",
        default="geometry",
        help="geometry (normals), geometry_fine (at 64 pixels a view), appearance (colours), evaluator (the metrics' "
        "CLIP), part_judge (gives a run its verdict) or part_judge_coarse (that of the benchmarks)",
    )
    train.add_argument("-o", "--output", default="runs/prior", metavar="FOLDER", help="checkpoint and log")
    train.add_argument("--steps", type=int, help="length of the schedule; default: what the kind takes to be good")
    train.add_argument("--hours", type=float, default=8.0, help="stop after this time at the latest")
    train.add_argument("--init", metavar="FOLDER", help="start from a packed prior instead of random weights")
    train.add_argument("--data", metavar="FOLDER", help="train on stored pairs of build-data instead of fresh ones")
    train.add_argument("--bf16", action="store_true", help="bfloat16: faster on a processor that has it (AVX512-BF16)")
    train.add_argument("--batch", type=int, default=8, metavar="N", help="images a step; default: 8")
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
    build.add_argument("--kind", default="geometry", help="geometry, geometry_fine or appearance (colours)")
    build.add_argument("--count", type=int, default=2048, help="pairs of four views each; default: 2048")
    build.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    build.add_argument("-t", "--threads", type=int, default=0, metavar="N", help="threads; default: all cores")
    build.set_defaults(call=_prior_build_data)
    _add_evaluate(actions)


def _add_evaluate(actions: argparse._SubParsersAction) -> None:
    evaluate = actions.add_parser(
        "evaluate",
        help="sample a prior on unseen bodies and judge what it draws: a contact sheet beside the truth, and metrics",
        description="Sample a prior on unseen bodies and judge what it draws. A shape sample of 16 steps takes about "
        "1.8 s of a core: the default (4 bodies, all parts, overviews and close-ups) 4 minutes, --bodies all about 20. "
        "A colour sample takes 1 s, a painted prompt (--paint) about 5 s.",
    )
    evaluate.add_argument("folder", nargs="?", help="packed prior; default: the built-in one")
    evaluate.add_argument(
        "--kind",
        default="geometry",
        help="geometry (default), geometry_fine, appearance, evaluator, part_judge or part_judge_coarse",
    )
    evaluate.add_argument("-o", "--output", metavar="FILE", help="PNG; the metrics go into a .json beside it")
    evaluate.add_argument(
        "--bodies", default="horse,cat,snowman,mug", metavar="A,B", help="or all; default: %(default)s"
    )
    evaluate.add_argument("--parts", default="all", metavar="A,B", help="default: all")
    evaluate.add_argument(
        "--classifier", metavar="FOLDER", help="a part_judge; default: benchmarks/part_classifier of a checkout"
    )
    evaluate.add_argument("--overviews", action="store_true", help="no views centred on the part: half the time")
    evaluate.add_argument("--steps", type=int, default=16, help="of DDIM; default: 16")
    evaluate.add_argument("--scale", type=float, default=2.0, help="of the text guidance (shapes); default: 2")
    evaluate.add_argument("--count", type=int, default=24, help="colour or material prompts; default: 24")
    evaluate.add_argument(
        "--paint", type=int, default=0, metavar="N", help="paint so many of them through the guidance"
    )
    evaluate.add_argument("--seed", type=int, default=0, metavar="N", help="default: 0")
    evaluate.add_argument("-t", "--threads", type=int, default=0, metavar="N", help="threads; default: all cores")
    evaluate.set_defaults(call=_prior_evaluate)


def _prior(options: argparse.Namespace) -> int:
    from fd_mitsuba.guidance.builtin import builtin_folder
    from fd_mitsuba.guidance.model_conventions import read_model_conventions

    vocabulary = read_model_conventions(builtin_folder()).vocabulary
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


def _prior_evaluate(options: argparse.Namespace) -> int:
    if options.kind == "evaluator":
        return _evaluator_evaluate(options)
    if options.kind.startswith("part_judge"):
        return _part_judge_evaluate(options)
    from fd_mitsuba.backend.threads import share_cores
    from fd_mitsuba.prior.training.kinds import kind_named

    kind = kind_named(options.kind).name
    share_cores(options.threads)
    from fd_mitsuba.guidance.builtin import APPEARANCE_FOLDER, BUILTIN_FOLDER, builtin_folder

    shipped = {"geometry": BUILTIN_FOLDER, "appearance": APPEARANCE_FOLDER}
    if not options.folder and kind not in shipped:
        raise UserError(f"--kind {kind}: no such prior is shipped; name its packed folder")
    folder = Path(options.folder) if options.folder else builtin_folder(shipped[kind])
    output = Path(options.output or f"runs/prior_{kind}.png").with_suffix(".png")
    (_evaluate_colours if kind == "appearance" else _evaluate_shapes)(options, folder, output)
    print(f"{output}, {output.with_suffix('.json')}")
    return 0


def _evaluator_evaluate(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import share_cores

    share_cores(options.threads)
    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.prior.judging.clip_evaluate import report_lines

    for line in report_lines(ClipJudge.load(options.folder), options.seed):
        print(line, flush=True)
    return 0


def _part_judge_evaluate(options: argparse.Namespace) -> int:
    from fd_mitsuba.backend.threads import share_cores

    share_cores(options.threads)
    from fd_mitsuba.evaluation.part_judge import load_judge
    from fd_mitsuba.io.json_object import write_json
    from fd_mitsuba.prior.training.part_judge_train import judge_kind, measure

    kind = judge_kind(options.kind)
    figures = measure(load_judge(Path(options.folder)) if options.folder else load_judge(), kind, ROUNDS_OF_BODIES)
    if options.output:
        write_json(Path(options.output), figures)
    print(json.dumps(figures, indent=2))
    return 0


def _evaluate_shapes(options: argparse.Namespace, folder: Path, output: Path) -> None:
    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.evaluation.part_judge import WEIGHTS_NAME, load_judge
    from fd_mitsuba.prior.judging.body_namer import BodyNamer
    from fd_mitsuba.prior.judging.evaluate_parts import evaluate_parts
    from fd_mitsuba.prior.training.kinds import kind_named

    kind = kind_named(options.kind)
    # One that was trained apart from the judge that is shipped: neither must be measured by itself.
    classifier = Path(options.classifier or Path(__file__).resolve().parents[3] / "benchmarks" / "part_classifier")
    judge = load_judge(classifier) if options.classifier or (classifier / WEIGHTS_NAME).is_file() else None
    if judge is None:
        remark("no classifier of parts here, so recall is left out; give one by --classifier")
    bodies, parts = (
        list(known) if text == "all" else [name.strip() for name in text.split(",") if name.strip()]
        for text, known in (
            (options.bodies, kind.catalogue.body_weights),
            (options.parts, kind.catalogue.part_weights),
        )
    )
    report = evaluate_parts(
        folder,
        output,
        judge,
        bodies,
        parts,
        options.seed,
        options.steps,
        options.scale,
        not options.overviews,
        BodyNamer(ClipJudge.load()),
        remark,
        kind,
    )
    for part, row in {**report["per_part"], "kept out of training": report["held_out"]}.items():
        print(
            f"{part}: {row['samples']} samples, found in {_share(row['recall'])} (in the true images in "
            f"{_share(row['recall_in_truth'])}), body named in {_share(row['body_named'])}, kept pixel by pixel in "
            f"{_share(row['body_kept'])}, its shape in {_share(row['shape_kept'])}"
        )
    if report["removal"]["samples"]:
        print(f"taken off as prompted: {_share(report['removal']['taken_off'])} of {report['removal']['samples']}")
    for name, bar in report["bars"].items():
        print(f"{name}: {_share(bar['measured'])}, wanted {bar['least']:.0%}")


def _evaluate_colours(options: argparse.Namespace, folder: Path, output: Path) -> None:
    from fd_mitsuba.prior.judging.evaluate_paint import evaluate_paint

    report = evaluate_paint(
        folder, output, options.count, options.seed, options.steps, painted=options.paint, say=remark
    )
    for name in ("sampled", "painted"):
        row = report[name]
        if row is not None:
            print(
                f"{name}: {row['prompts']} prompts, the prompted look is the nearest in {_share(row['all'])} "
                f"(colours {_share(row['colours'])}, materials {_share(row['materials'])}), wanted {row['bar']:.0%}"
            )
    if report["painted"] is not None:
        print(f"metallic: {report['painted']['metallic']}")


def _share(value: float | None) -> str:
    return "-" if value is None else f"{value:.1%}"
