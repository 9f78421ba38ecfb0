"""Does a part that was grown look like what the prompt says? The built-in prior on meshes that it was not made from.

    python benchmarks/prior_in_3d.py                              # 24 runs, about 90 s each on a quiet core
    python benchmarks/prior_in_3d.py --pairs cat+crown,mug+handle # some of them
    python benchmarks/prior_in_3d.py --pairs new --classifier src/fd_mitsuba/weights/part_judge    # 16 more words
    python benchmarks/prior_in_3d.py --judge-only                 # judge the runs that are there once more

Each case of `prior_pairs` is a geometry run in a process of its own. Eight ring views of the finished object, and of
the base with its starting regions, are judged by `part_classifier`, which was trained apart from the prior. Finished
runs are kept: call it again after a kill. Writes `results.json` and `sheet.png` (starting regions left, result right).
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

import numpy as np  # noqa: E402
import torch  # noqa: E402
import trimesh  # noqa: E402
from prior_pairs import CASES, Case, chosen_cases, regions_xml  # noqa: E402

from fd_mitsuba.errors import UserError  # noqa: E402
from fd_mitsuba.evaluation.before_and_after import judged_views  # noqa: E402
from fd_mitsuba.evaluation.part_judge import LEAST_PIXELS, PartJudge, changed_pixels, load_judge  # noqa: E402
from fd_mitsuba.io.json_object import write_json  # noqa: E402
from fd_mitsuba.prior.data.fine.bodies import BODIES  # noqa: E402
from fd_mitsuba.runs.geometry_outcome import load_finished_stage  # noqa: E402
from fd_mitsuba.runs.saved_run import saved_run  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402
from fd_mitsuba.scene.usual_regions import HEADLESS, usual_place  # noqa: E402
from fd_mitsuba.viewing.turntable import render_ring, write_sheet  # noqa: E402

VIEWS, SHEET_SIZE = 8, 112
ELEVATION_DEG, HALF_WIDTH = 15.0, 1.25
"""In the middle of what the classifier was trained on: elevations of -10 to 45 degrees, half widths of 1.05 to 1.5."""
MADE_SEED = 1000
LEAST_FOUND, MOST_AT_START = 0.80, 0.20
Mesh = tuple[torch.Tensor, torch.Tensor]


def write_scene(case: Case, folder: Path) -> Path:
    """What a case starts from: the shipped scene, a copy with the case's ellipsoids, or the mesh of a made body."""
    if not case.scene:
        path = folder / "scenes" / f"{case.body}.ply"
        path.parent.mkdir(parents=True, exist_ok=True)
        solid = BODIES[case.body](np.random.default_rng(MADE_SEED)).solid
        trimesh.Trimesh(solid.vertices, solid.faces, process=False).export(path)
        return path
    shipped = ROOT / "scenes" / case.scene / "scene.xml"
    if not case.ellipsoids:
        return shipped
    tree = ET.parse(shipped)
    root = tree.getroot()
    for shape in [shape for shape in root.findall("shape") if shape.get("type") == "focal_region"]:
        root.remove(shape)
    for element in root.iter():
        value = element.get("value")
        if element.get("name") in ("filename", "light") and value and not value.startswith("$"):
            element.set("value", str((shipped.parent / value).resolve()))
    frame = load_edit_scene(shipped).frame
    root.extend(ET.fromstring(text) for text in regions_xml(case, frame))
    path = folder / "scenes" / f"{case.name}.xml"
    path.parent.mkdir(parents=True, exist_ok=True)
    text = ET.tostring(root, encoding="unicode") + "\n"
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")
    return path


def grow(case: Case, folder: Path, config: Path, settings: list[str], cores: str) -> str | None:
    """Run a case unless it is finished; returns what went wrong, or None."""
    run = folder / case.name
    if (run / "metrics.json").is_file():
        return None
    command = [sys.executable, "-m", "fd_mitsuba", "run", str(write_scene(case, folder)), "--prompt", case.prompt]
    command += ["-c", str(config), "-o", str(run), "--stage", "geometry", "-q"]
    if case.by_words:
        command += ["--at", usual_place(case.part, case.body in HEADLESS)]
        command += [] if case.scene else ["--up", "y", "--front", "z"]
    command += [argument for setting in settings for argument in ("--set", setting)]
    command += ["--resume"] if (run / "run.json").is_file() else []
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src")}
    pinned = ["taskset", "-c", cores] if cores else []
    done = subprocess.run([*pinned, *command], env=environment, capture_output=True, text=True)
    if done.returncode == 130:
        raise KeyboardInterrupt
    return None if done.returncode == 0 else (done.stderr.strip().splitlines() or ["ended without a message"])[-1]


def judge_run(case: Case, folder: Path, judge: PartJudge) -> tuple[dict, np.ndarray]:
    """Figures of a finished run, and its row of the sheet: (16, S, S, 3) start and result."""
    scene, config = saved_run(folder / case.name)
    stage = load_finished_stage(scene, config, folder / case.name)
    with torch.no_grad():
        grown = stage.surface()
    start, base = stage.start_surface(), stage.base_surface
    meshes = [(surface.vertices, surface.faces) for surface in (base, start, grown)]
    before, *others = (judged_views(*mesh, stage.aim, ELEVATION_DEG, HALF_WIDTH) for mesh in meshes)
    figures = {
        name: judged(judge, case.part, before, views) for name, views in zip(("start", "end"), others, strict=True)
    }
    pictures = [render_ring(mesh, VIEWS, SHEET_SIZE, stage.aim) for mesh in meshes[1:]]
    return figures, np.concatenate(pictures)


def judged(judge: PartJudge, part: str, before: np.ndarray, after: np.ndarray) -> dict:
    """What the classifier says of ring views.

    `found` is the share of all views in which the part is its first choice, `found_where_seen` that of the views that
    changed at all: from the front a tail cannot be seen. `named` is the first choice by the mean over the latter. As in
    the verdict of a run, a top hat is a hat.
    """
    said = judge(before, after)
    names = [judge.classes[label] for label in said.argmax(1)]
    seen = changed_pixels(before, after) >= LEAST_PIXELS
    right = np.array([is_a(name, part) for name in names]) & seen
    return {
        "found": float(right.mean()),
        "found_where_seen": float(right[seen].mean()) if seen.any() else 0.0,
        "views_seen": int(seen.sum()),
        "named": judge.classes[int(said[seen].mean(0).argmax())] if seen.any() else "none",
        "probability": round(float(said[:, judge.classes.index(part)].mean()), 4),
        "views": names,
    }


def is_a(name: str, part: str) -> bool:
    """Whether what a judge names is the part or a kind of it."""
    return name == part or name.endswith(f" {part}")


def mean_of(values: Sequence[float]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def summary(results: dict[str, dict]) -> dict:
    """Means over cases; a run that failed has found nothing."""

    def mean(rows: list[dict], when: str, key: str) -> float | None:
        return mean_of([row[when][key] if when in row else 0.0 for row in rows])

    groups = {
        "all": list(results.values()),
        "trained": [row for row in results.values() if not row["untrained"]],
        "untrained": [row for row in results.values() if row["untrained"]],
    }
    figures = {
        name: {
            "cases": len(rows),
            "found": mean(rows, "end", "found"),
            "found_where_seen": mean(rows, "end", "found_where_seen"),
            "found_at_start": mean(rows, "start", "found"),
            "named_right": mean_of([is_a(row.get("end", {}).get("named", ""), row["part"]) for row in rows]),
        }
        for name, rows in groups.items()
    }
    bars = {
        "found": (figures["all"]["found"], LEAST_FOUND),
        "found_at_start": (figures["all"]["found_at_start"], MOST_AT_START),
    }
    met = {"found": bars["found"][0] is not None and bars["found"][0] >= LEAST_FOUND}
    met["found_at_start"] = bars["found_at_start"][0] is not None and bars["found_at_start"][0] <= MOST_AT_START
    return {**figures, "bars": {name: {"measured": m, "wanted": w, "met": met[name]} for name, (m, w) in bars.items()}}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "prior_in_3d", metavar="FOLDER")
    parser.add_argument("--pairs", default="all", help=f"all, new, or some of {', '.join(case.name for case in CASES)}")
    parser.add_argument("--config", type=Path, default=ROOT / "configs" / "quick.toml")
    parser.add_argument("--set", dest="settings", action="append", default=[], metavar="SECTION.KEY=VALUE")
    parser.add_argument("--cores", default="", metavar="LIST", help="pin the runs to these cores, as taskset has them")
    parser.add_argument("--classifier", type=Path, default=ROOT / "benchmarks" / "part_classifier", metavar="FOLDER")
    parser.add_argument("--judge-only", action="store_true", help="start no runs")
    options = parser.parse_args()
    try:
        return _measure(options)
    except UserError as error:
        print(f"prior_in_3d: error: {error}", file=sys.stderr)
        return 1


def _measure(options: argparse.Namespace) -> int:
    cases = chosen_cases(options.pairs)
    judge = load_judge(options.classifier)
    torch.set_num_threads(1)
    results: dict[str, dict] = {}
    rows: dict[str, np.ndarray] = {}
    for case in cases:
        name = case.name
        folder = options.output / name
        problem = None
        if not options.judge_only:
            problem = grow(case, options.output, options.config, options.settings, options.cores)
        row: dict = {"prompt": case.prompt, "part": case.part, "untrained": case.untrained}
        if (folder / "metrics.json").is_file():
            figures, pictures = judge_run(case, options.output, judge)
            row |= figures
            caption = f"{case.prompt}{' (untrained)' if case.untrained else ''}: found in {row['end']['found']:.0%} of "
            caption += f"views (start {row['start']['found']:.0%}), named {row['end']['named']}"
            rows[caption] = pictures
        elif options.judge_only:
            continue
        else:
            row["problem"], caption = problem, f"{case.prompt}: {problem}"
        results[name] = row
        print(caption, flush=True)
        report = {"config": str(options.config), "settings": options.settings, **summary(results), "cases": results}
        write_json(options.output / "results.json", report)
        if rows:
            write_sheet(rows, options.output / "sheet.png")
    if not results:
        raise UserError(f"{options.output}: holds no finished run; call without --judge-only")
    print(json.dumps(report["all"] | {"bars": report["bars"]}, indent=2))
    return 0


if __name__ == "__main__":
    sys.exit(main())
