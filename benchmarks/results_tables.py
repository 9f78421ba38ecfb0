"""Put measured figures into docs/results.md: `python benchmarks/results_tables.py`.

Reads what `fd_mitsuba evaluate --all --json runs/evaluate.json`, the same with `--pictures shape` and
`runs/evaluate_shape.json`, and `fd_mitsuba ablate` left in `runs/`, and rewrites the tables of docs/results.md between
their markers, and the sheets of pictures beside it. What is missing leaves its table as it is. Whether a bar is met is
computed here from the runs, failed ones included.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from model_card_tables import filled
from PIL import Image

from fd_mitsuba.evaluation.picture_difference import MOST_DECIBELS
from fd_mitsuba.evaluation.report.score_table import COLUMNS, Column, header, markdown_table, scene_rows

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "results.md"
FINISHED = ("finished", "skipped")
ROUNDING = 1e-9
JUDGED = ("sim", "dir", "dir_cosine", "sim_simple", "dir_simple")
RANKED = (
    "rank",
    "rank_start",
    "rank_base",
    "rank_base_start",
    "rank_dir",
    "rank_dir_start",
    "rank_part",
    "rank_part_start",
)
UNJUDGED = ("psnr", "ssim", "chamfer", "texture", "leakage", "overlap", "valid", "front_in_back", "seconds", "memory")
UNJUDGED_SHAPE = ("chamfer", "texture", "leakage", "overlap", "valid", "front_in_back", "seconds", "memory")


class Bar(NamedTuple):
    """Something that must hold, what was measured, and whether it holds."""

    wanted: str
    found: str
    met: bool

    def cells(self) -> list[str]:
        return [self.wanted, self.found, "yes" if self.met else "**no**"]


def start_rank_by_change(found: dict) -> float | None:
    """Place of the own prompt by the change that the run started with."""
    rank = found.get("retrieval", {}).get("rank_dir_start")
    return None if rank is None else float(rank)


OURS = {**COLUMNS, "rank_dir_start": Column("before the run", start_rank_by_change)}


def scenes_table(runs: Sequence[dict], names: Sequence[str]) -> list[str]:
    """A row a scene, mean and sample standard deviation over its seeds; the last row is over all runs."""
    columns = [OURS[name] for name in names]
    titles = ["runs" if title == "seed" else title for title in header(columns)]
    everything = scene_rows([{**found, "scene": f"all {len(runs)}"} for found in runs], columns)
    return markdown_table(titles, scene_rows(runs, columns) + everything).splitlines()


def preserved(found: dict) -> bool:
    """Whether nothing of the base has changed: exported files and surface, and in lit runs textures and pixels.

    A bare shape is exported without the base's textures, and its pictures have a fillet where the part begins, so that
    their pixels say nothing. 200 dB is a difference of 1e-10: a camera ray through the very edge of two triangles may
    name either, and the last digit follows.
    """
    base = found["base"]
    same = base["identical"] and base["files_identical"] == base["files"]
    same = same and base["chamfer"] is not None and base["chamfer"] < ROUNDING and not base["texture_difference"]
    if found["views"]["kind"] == "lit":
        same = same and not base["missing"] and base["psnr_db"] >= MOST_DECIBELS
    return bool(same)


def front_is_on_the_back(found: dict) -> bool:
    """Whether more than half of the back views are taken for front views, beyond those of the base that are."""
    excess = OURS["front_in_back"].value(found)
    return excess is not None and excess > 0.5


def run_bars(runs: Sequence[dict], failed: int) -> list[Bar]:
    """What is asked of the runs; a failed one counts against each of them, a start that was not measured for none."""
    total, lit = len(runs) + failed, any(found["views"]["kind"] == "lit" for found in runs)

    def rank(name: str) -> Callable[[dict], bool]:
        return lambda found: OURS[name].value(found) == 1

    def share(wanted: str, test: Callable[[dict], bool], least: float = 1.0) -> Bar:
        met = sum(map(test, runs))
        return Bar(wanted, f"{met} of {total} ({met / total:.0%})", met >= least * total)

    def few(wanted: str, test: Callable[[dict], bool], most: float = 0.25) -> Bar:
        met = sum(map(test, runs))
        return Bar(wanted, f"{met} of {len(runs)} ({met / len(runs):.0%})", met <= most * len(runs))

    return [
        share("every run ends", lambda found: True),
        share("prompt ranked first among all edit prompts in ≥ 80 %, by CLIP_sim", rank("rank"), 0.8),
        few("... and for the start in ≤ 25 %", rank("rank_start")),
        share("prompt ranked first among all edit prompts and its own base prompt in ≥ 80 %", rank("rank_base"), 0.8),
        few("... and for the start in ≤ 25 %", rank("rank_base_start")),
        share("prompt ranked first in ≥ 80 %, by the change (CLIP_dir)", rank("rank_dir"), 0.8),
        few("... and for the start in ≤ 25 %", rank("rank_dir_start")),
        share("part ranked first on its own body in ≥ 80 %", rank("rank_part"), 0.8),
        few("... and for the start in ≤ 25 %", rank("rank_part_start")),
        share("CLIP_dir > 0 in all", lambda found: (OURS["dir"].value(found) or 0) > 0),
        share(f"base preserved perfectly in all{'' if lit else ' (its mesh; textures and pixels: lit)'}", preserved),
        share("leakage ≤ 1 % in all", lambda found: found["part"]["leakage"] <= 0.01),
        share("no part lost", lambda found: not any(part["lost"] for part in found["part"]["parts"].values())),
        few("most back views taken for the front in ≤ 5 % of the runs", front_is_on_the_back, 0.05),
        share("all parts closed solids", lambda found: all(p["valid"] for p in found["part"]["parts"].values())),
    ]


def ablation_bars(rows: dict[str, dict]) -> list[Bar]:
    """What the paper's ablations should show, of means over seeds; rows that were not run give no bar."""

    def mean(row: str, name: str, kind: str) -> float | None:
        values = [value for found in rows.get(row, {}).get(kind, ()) if (value := OURS[name].value(found)) is not None]
        return statistics.fmean(values) if values else None

    bars = []

    def compare(wanted: str, row: str, name: str, kind: str, least: float, whole: str = "full") -> None:
        with_it, without = (mean(which, name, kind) for which in (whole, row))
        if with_it is not None and without is not None:
            column = OURS[name]
            text = Column(column.title, column.value, column.digits + 1, column.share).text
            factor = f", {without / with_it:.1f} times" if with_it > 0 else ""
            met = without > with_it and without >= least * with_it
            bars.append(Bar(wanted, f"{text(with_it)} → {text(without)}{factor}", met))

    for whole, prefix, of in (("full", "", ""), ("paper", "paper_", ", the paper's losses alone")):
        compare(f"without L_GF leakage grows ≥ 5 times{of}", f"{prefix}no_focal", "leakage", "shape", 5, whole)
        compare(f"without L_CA overlap grows ≥ 3 times{of}", f"{prefix}no_collision", "overlap", "shape", 3, whole)
    compare("without the dual path the base's colour drifts", "single_path", "drift", "lit", 1)
    compare("without L_SC the boundary step is higher", "no_style", "step", "lit", 1)
    return bars


def bars_table(bars: Sequence[Bar]) -> list[str]:
    """Wanted, found, met."""
    return markdown_table(["wanted", "found", "met"], [bar.cells() for bar in bars]).splitlines()


def beside_the_paper(runs: Sequence[dict]) -> list[str]:
    """Our means beside the paper's Table 1; the row of ours names its judge."""
    titles = ["edits by", "judge", *(OURS[name].title for name in ("sim", "dir", "sim_simple", "dir_simple"))]
    vit = "ViT-B/32 on photographs"
    ours = scene_rows([{**found, "scene": "here"} for found in runs], [OURS[n] for n in JUDGED if n != "dir_cosine"])
    rows = [[f"ours, built-in prior ({cells[1]} runs)", *cells[2:]] for cells in ours]
    rows += [
        ["FocalDreamer, Stable Diffusion (paper)", vit, "0.329", "0.0519", "0.336", "0.0538"],
        ["Vox-E (paper)", vit, "0.293", "0.0178", "-", "-"],
        ["Vox-E-Global (paper)", vit, "0.299", "0.0204", "-", "-"],
        ["Fantasia3D* (paper)", vit, "0.284", "0.0180", "-", "-"],
    ]
    return markdown_table(titles, rows).splitlines()


def run_tables(runs: Sequence[dict], lost: Sequence[dict], kind: str) -> dict[str, list[str]]:
    """The tables of runs that were judged by one kind of pictures; what does not depend on the pictures comes once."""
    tables = {
        f"bars {kind}": bars_table(run_bars(runs, len(lost))),
        f"judged {kind}": scenes_table(runs, JUDGED),
        f"ranks {kind}": scenes_table(runs, RANKED),
        f"unjudged {kind}": scenes_table(runs, UNJUDGED if kind == "lit" else UNJUDGED_SHAPE),
        "failed": [f"- {job['name']}: {job['message']}" for job in lost] or ["None."],
    }
    return tables | ({"paper": beside_the_paper(runs)} if kind == "lit" else {})


def machine_lines() -> list[str]:
    """The machine that this is called on, which should be the one that made the runs."""
    from machine import machine

    from fd_mitsuba.backend.startup import start

    start()
    about = machine()
    memory = next((line.split()[1] for line in open("/proc/meminfo") if line.startswith("MemTotal")), "0")
    versions = ", ".join(f"{name} {about[name]}" for name in ("python", "mitsuba", "drjit", "torch", "numpy"))
    return [f"{about['cpu']}, {about['cores']} cores used, {int(memory) / 2**20:.0f} GB, no GPU; {versions}."]


def scenes_sheet(runs: Sequence[dict], name: str, per_line: int = 2) -> Image.Image | None:
    """Two views each of start and result of every run, from its `images/<name>.png`: a strip a scene."""
    lines: dict[str, list[np.ndarray]] = {}
    for found in runs:
        path = Path(found["run"]) / "images" / f"{name}.png"
        if path.is_file():
            sheet = np.asarray(Image.open(path).convert("RGB"))
            side = sheet.shape[0] // 3
            views = [sheet[:, side * view : side * (view + 1)] for view in (1, 5) if side * view < sheet.shape[1]]
            tiles = [view[row * side : (row + 1) * side] for row in (1, 2) for view in views]
            mine = lines.setdefault(found["scene"], [])
            mine += [np.concatenate(tiles if not mine else tiles[len(views) :], axis=1)]
    if not lines:
        return None
    strips = [np.concatenate(strip, axis=1) for strip in lines.values()]
    width, height = max(strip.shape[1] for strip in strips), max(strip.shape[0] for strip in strips)
    count = -(-len(strips) // per_line)
    sheet = np.full((count * (height + 4), per_line * (width + 8), 3), 24, np.uint8)
    for index, strip in enumerate(strips):
        top, left = index // per_line * (height + 4), index % per_line * (width + 8)
        sheet[top : top + strip.shape[0], left : left + strip.shape[1]] = strip
    return Image.fromarray(sheet)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=Path, default=ROOT / "runs", metavar="FOLDER")
    parser.add_argument("--page", type=Path, default=PAGE, metavar="FILE")
    options = parser.parse_args()
    page, pictures = options.page.read_text(encoding="utf-8"), options.page.parent / "images"
    tables: dict[str, list[str]] = {}
    batch = options.runs / "evaluate" / "batch.json"
    jobs = json.loads(batch.read_text(encoding="utf-8"))["jobs"] if batch.is_file() else []
    for kind, file in {"lit": "evaluate.json", "shape": "evaluate_shape.json"}.items():
        if (options.runs / file).is_file():
            runs = json.loads((options.runs / file).read_text(encoding="utf-8"))["runs"]
            seeds = {found["seed"] for found in runs}  # the two files may have different ones
            lost = [job for job in jobs if job["state"] == "failed" and job["seed"] in seeds]
            tables |= run_tables(runs, lost, kind)
            if sheet := scenes_sheet(runs, "evaluation" if kind == "lit" else "evaluation_shape"):
                sheet.save(pictures / f"results_{kind}.jpg", quality=88)
    if tables:
        tables["machine"] = machine_lines()
    ablations = sorted(options.runs.glob("ablate_*/ablation.json"))
    lines: list[str] = []
    for path in ablations:
        name = path.parent.name.removeprefix("ablate_")
        rows = {row["row"]["name"]: row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
        lines += [f"### {name}", "", *path.with_suffix(".md").read_text(encoding="utf-8").splitlines(), ""]
        lines += bars_table(ablation_bars(rows))
        if path.with_suffix(".png").is_file():
            Image.open(path.with_suffix(".png")).convert("RGB").save(pictures / f"ablation_{name}.jpg", quality=88)
            lines += ["", f"![Ablation of {name}: four views, two of the junction](images/ablation_{name}.jpg)", ""]
    if lines:
        tables["ablation"] = lines
    for name, table in tables.items():
        page = filled(page, name, table)
        print(f"{name}: written")
    if not tables:
        print(f"{options.runs}: neither evaluate.json nor ablate_*/ablation.json; nothing written")
    options.page.write_text(page, encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
