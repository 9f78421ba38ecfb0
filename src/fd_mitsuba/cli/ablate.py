"""The command `ablate`: what each piece of the method is worth on one scene."""

from __future__ import annotations

import argparse
import json
import os
from dataclasses import asdict, replace
from pathlib import Path

from fd_mitsuba.cli.evaluate import batch_options, judge_options
from fd_mitsuba.cli.options import machine_options, remark, say, start


def add_ablate_commands(commands: argparse._SubParsersAction) -> None:
    """Put `ablate` beside the other commands."""
    ablate = commands.add_parser("ablate", help="one scene without single pieces of the method, as a table")
    ablate.add_argument("scene", help="Mitsuba scene file (XML)")
    ablate.add_argument(
        "-D", dest="definitions", action="append", default=[], metavar="NAME=VALUE", help="fill $NAME in the scene"
    )
    ablate.add_argument("--only", nargs="+", metavar="ROW", help="these rows and the full method; default: all")
    ablate.add_argument(
        "--stage", choices=("all", "geometry"), default="all", help="geometry: no appearance in any row; default: all"
    )
    judge_options(ablate)
    batch_options(ablate, "runs/ablate_<scene>", None, [0, 1, 2])
    ablate.add_argument(
        "--scenes", metavar="FOLDER", help="whose prompts are the rivals; default: the scene's own folder"
    )
    machine_options(ablate)
    ablate.set_defaults(call=_ablate)


def _ablate(options: argparse.Namespace) -> int:
    start(options)
    from rich.console import Console

    from fd_mitsuba.evaluation.ablation import ablate, ablation_jobs, chosen_rows
    from fd_mitsuba.evaluation.ablation_table import ablation_header, ablation_rows, write_ablation_sheet
    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.evaluation.report.score_table import markdown_table, rich_table
    from fd_mitsuba.evaluation.run_evaluation import Protocol
    from fd_mitsuba.evaluation.scene_prompts import prompts_of_scenes
    from fd_mitsuba.io.atomic import write_atomically

    scene = Path(options.scene)
    folder = Path(options.output or Path("runs") / f"ablate_{scene.resolve().parent.name}")
    rows = chosen_rows(options.only, options.stage)
    protocol = Protocol(options.views, options.size, options.spp)
    judge = ClipJudge.load(options.judge)
    shapes, looks = ablation_jobs(
        scene, Path(options.config), options.seeds, rows, folder, options.overrides, options.definitions, options.stage
    )
    shapes, looks = ([replace(job, plugins=tuple(options.plugins)) for job in jobs] for jobs in (shapes, looks))
    for job in (*shapes, *looks):
        job.settings()
    beside = Path(options.scenes) if options.scenes else scene.resolve().parent.parent
    rivals = prompts_of_scenes(beside) if options.scenes or any(beside.glob("*/scene.xml")) else []
    results = ablate((shapes, looks), rows, judge, protocol, rivals, options.workers, remark, folder / "batch.json")
    cells, titles = ablation_rows(results), ablation_header()
    record = [
        {"row": asdict(result.row), "lit": result.lit, "shape": result.shape, "runs": list(map(str, result.folders))}
        for result in results
    ]
    write_atomically(
        folder / "ablation.json", (json.dumps({"judge": judge.name, "rows": record}, indent=2) + "\n").encode()
    )
    note = f"Judge: {judge.name}; {options.views} views; the paper's numbers are ViT-B/32's over its own scenes.\n\n"
    write_atomically(folder / "ablation.md", (note + markdown_table(titles, cells)).encode())
    write_ablation_sheet(results, folder / "ablation.png")
    Console(width=None if os.isatty(1) else 200).print(rich_table(titles, cells, f"judge: {judge.name}"))
    say(f"{folder}: ablation.json, ablation.md, ablation.png")
    return 0 if all(len(result.folders) == len(options.seeds) for result in results) else 1
