"""The action `prior evaluate`: how good a prior, an evaluator or a judge of parts is."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from fd_mitsuba.cli.options import remark
from fd_mitsuba.errors import UserError

ROUNDS_OF_BODIES = 3
"""Unseen random bodies of each name on which a judge of parts is measured."""


def add_evaluate(actions: argparse._SubParsersAction) -> None:
    """Put the action beside the others of `prior`."""
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
        help="geometry (default), geometry_fine, appearance, appearance_fine, evaluator, part_judge or "
        "part_judge_coarse",
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


def _prior_evaluate(options: argparse.Namespace) -> int:
    if options.kind == "evaluator":
        return _evaluator_evaluate(options)
    if options.kind.startswith("part_judge"):
        return _part_judge_evaluate(options)
    from fd_mitsuba.backend.threads import share_cores
    from fd_mitsuba.prior.data.catalogue import COARSE
    from fd_mitsuba.prior.training.kinds import GEOMETRY_FINE, kind_named

    kind = kind_named(options.kind)
    share_cores(options.threads)
    from fd_mitsuba.config.for_model import BUILTIN, BUILTIN_WIDE
    from fd_mitsuba.guidance.builtin import builtin_folder, shipped_folder

    of_colours = kind.name.startswith("appearance")
    if kind.name == GEOMETRY_FINE.name and not options.folder:
        raise UserError(f"--kind {kind.name}: no such prior is shipped; name the folder of one")
    shipped = shipped_folder(BUILTIN if kind.catalogue is COARSE else BUILTIN_WIDE, of_colours)
    assert shipped is not None
    folder = Path(options.folder) if options.folder else builtin_folder(shipped)
    output = Path(options.output or f"runs/prior_{kind.name}.png").with_suffix(".png")
    (_evaluate_colours if of_colours else _evaluate_shapes)(options, folder, output)
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
    from fd_mitsuba.prior.training.kinds import kind_named

    report = evaluate_paint(
        folder,
        output,
        options.count,
        options.seed,
        options.steps,
        painted=options.paint,
        say=remark,
        kind=kind_named(options.kind),
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
