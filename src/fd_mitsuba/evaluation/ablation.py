"""Ablations: one scene with single things changed, several seeds each, as the paper's Table 2 and Figure "union"."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.batch.local import Job, run_batch, scene_name
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.run_evaluation import Protocol, evaluate_run
from fd_mitsuba.evaluation.scene_prompts import ScenePrompts
from fd_mitsuba.evaluation.similarity import Judge

FULL = "full"
_FULL_OVERRIDES = ("appearance.style=true",)


@dataclass(frozen=True)
class Row:
    """One line of the table.

    Attributes:
        name: for `--only` and in the names of run folders.
        title: for people.
        overrides: `section.key=value` on top of the full method's.
        stage: the stage that they change. Where it is the geometry, no appearance is learned; where it is the
            appearance, the shape is that of the full method.
        paper: the paper's CLIP_sim and CLIP_dir as it prints them, "" for none.
    """

    name: str
    title: str
    overrides: tuple[str, ...]
    stage: str
    paper: tuple[str, str] = ("", "")


def _k(value: float, name: str) -> Row:
    return Row(name, f"k = {value:g}", (f"geometry.union_k={value:g}",), "geometry")


def _t(low: float, high: float, name: str) -> Row:
    ranges = tuple(f"guidance.timestep_range_{phase}=[{low}, {high}]" for phase in ("coarse", "drafted", "refined"))
    return Row(name, f"t of the shape in {low}..{high}", ranges, "geometry")


def _scale(value: float, name: str) -> Row:
    return Row(name, f"guidance scale of the shape {value:g}", (f"guidance.guidance_scale={value:g}",), "geometry")


def _colour_scale(value: float, name: str) -> Row:
    title = f"guidance scale of the colour {value:g}"
    return Row(name, title, (f"appearance.guidance_scale={value:g}",), "appearance")


_PAPER_LOSSES = (
    *(f"geometry.lambda_{name}=0" for name in ("volume", "presence", "tether", "curvature")),
    "geometry.draft_fraction=0",
)
"""Without our own additions: a price on volume also takes away what hides in the base, where no picture holds it, and
pulls in what leaves the region, so what L_GF and L_CA do by themselves shows only without it."""

ROWS = (
    Row(FULL, "full method", (), "all", ("0.329 (0.319*)", "0.0519 (0.0495*)")),
    Row("no_focal", "without L_GF", ("geometry.lambda_focal=0",), "geometry", ("0.316", "0.0433")),
    Row("no_collision", "without L_CA", ("geometry.lambda_collision=0",), "geometry", ("0.329", "0.0517")),
    Row("no_style", "without L_SC", ("appearance.style=false",), "appearance", ("0.312*", "0.0402*")),
    Row("single_path", "without dual path", ("appearance.single_path=true",), "appearance", ("0.313", "0.0401")),
    Row("paper", "the paper's losses alone", _PAPER_LOSSES, "geometry"),
    Row("paper_no_focal", "... without L_GF", (*_PAPER_LOSSES, "geometry.lambda_focal=0"), "geometry"),
    Row("paper_no_collision", "... without L_CA", (*_PAPER_LOSSES, "geometry.lambda_collision=0"), "geometry"),
    _k(0.0, "k_0"),
    _k(0.05, "k_005"),
    _k(0.15, "k_015"),
    _k(0.3, "k_03"),
    _k(0.5, "k_05"),
    _t(0.02, 0.35, "t_low"),
    _t(0.02, 0.98, "t_all"),
    _t(0.5, 0.98, "t_high"),
    _scale(1.0, "scale_1"),
    _scale(10.0, "scale_10"),
    _scale(50.0, "scale_50"),
    Row("colour_t_low", "t of the colour in 0.02..0.5", ("appearance.timestep_range=[0.02, 0.5]",), "appearance"),
    _colour_scale(3.0, "colour_scale_3"),
    _colour_scale(7.0, "colour_scale_7"),
    _colour_scale(30.0, "colour_scale_30"),
)
"""The paper's starred numbers are over the scenes that need L_SC, its others over all fifteen."""


@dataclass(frozen=True)
class RowResult:
    """A row with the evaluations of its finished runs, one a seed; `lit` is empty for rows without appearance."""

    row: Row
    folders: tuple[Path, ...]
    lit: tuple[dict, ...]
    shape: tuple[dict, ...]


def chosen_rows(only: Sequence[str] | None, stage: str = "all") -> list[Row]:
    """The rows of these names, in the table's order, the full method always among them; UserError for an unknown name.

    Args:
        only: None: all.
        stage: `geometry` leaves out the rows that change the appearance.
    """
    unknown = [name for name in only or () if name not in {row.name for row in ROWS}]
    if unknown:
        raise UserError(f"--only {unknown[0]}: no such row; known: {', '.join(row.name for row in ROWS)}")
    wanted = [row for row in ROWS if only is None or row.name in only or row.name == FULL]
    return [row for row in wanted if stage != "geometry" or row.stage != "appearance"]


def ablation_jobs(
    scene: Path,
    config: Path | None,
    seeds: Sequence[int],
    rows: Sequence[Row],
    folder: Path,
    overrides: Sequence[str] = (),
    definitions: Sequence[str] = (),
    stage: str = "all",
) -> tuple[list[Job], list[Job]]:
    """Jobs in `folder/<row>-<seed>`: those that grow a shape, and those that need the full method's finished shape.

    Args:
        overrides: for all rows; a row's own come last.
        stage: `geometry`: no appearance, not even for the full method.
    """
    first, second = [], []
    for row in rows:
        for seed in seeds:
            settings = (*_FULL_OVERRIDES, *overrides, *row.overrides)
            source = folder / f"{FULL}-{seed}" if row.stage == "appearance" else None
            what = "all" if stage == "all" and row.stage != "geometry" else "geometry"
            place = folder / f"{row.name}-{seed}"
            job = Job(scene, config, seed, settings, place, tuple(definitions), what, geometry_from=source)
            (first if source is None else second).append(job)
    return first, second


def ablate(
    jobs: tuple[list[Job], list[Job]],
    rows: Sequence[Row],
    judge: Judge,
    protocol: Protocol,
    rivals: Sequence[ScenePrompts],
    workers: int = 1,
    say: Callable[[str], None] = print,
    record: Path | None = None,
) -> list[RowResult]:
    """Run what is missing, evaluate what is finished, and put it together by rows; rows without any run have none.

    Every shape is judged as a bare shape, so that all rows can be compared; an appearance is judged in lit pictures.

    Args:
        jobs: see `ablation_jobs`.
        rivals: see `evaluate_run`.
        record: see `run_batch`.
    """
    grown = run_batch(jobs[0], workers, say, record=record)
    done = {outcome.job.folder for outcome in grown if outcome.state in ("finished", "skipped")}
    ready = [job for job in jobs[1] if job.geometry_from in done]
    if ready:
        coloured = run_batch(ready, workers, say, record=record)
        done |= {outcome.job.folder for outcome in coloured if outcome.state in ("finished", "skipped")}
    results = []
    for row in rows:
        mine = [job for job in (*jobs[0], *jobs[1]) if job.folder in done and _row_name(job) == row.name]
        lit, shape = [], []
        for job in mine:
            say(f"evaluating {job.name} of {scene_name(job.scene)}")
            if row.stage != "appearance":  # there the shape is the full method's
                shape.append(evaluate_run(job.folder, judge, _of_shape(protocol), rivals, say=say))
            if job.stage == "all":
                lit.append(evaluate_run(job.folder, judge, protocol, rivals, say=say))
        results.append(RowResult(row, tuple(job.folder for job in mine), tuple(lit), tuple(shape)))
    return results


def _row_name(job: Job) -> str:
    return job.name.rpartition("-")[0]


def _of_shape(protocol: Protocol) -> Protocol:
    return Protocol(protocol.views, protocol.size, protocol.spp, "shape")
