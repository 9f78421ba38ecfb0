"""Evaluate finished runs: from a run folder to `evaluation.json`. The figures are defined in docs/evaluation.md."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image

from fd_mitsuba.backend.threads import rendering_threads
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.boundary_step import boundary_step
from fd_mitsuba.evaluation.clip_loading import BUILTIN_NAME
from fd_mitsuba.evaluation.judged_views import VIEWS_TOGETHER, JudgedViews, lit_views, shape_views
from fd_mitsuba.evaluation.protocol import FORMAT, about_views, judged, measured, measured_by_run
from fd_mitsuba.evaluation.report.score_table import COLUMNS
from fd_mitsuba.evaluation.scene_prompts import ScenePrompts, prompts_of_scene
from fd_mitsuba.evaluation.similarity import EditPrompt, Judge
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.io.json_object import read_json_object, write_json
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.runs.appearance_outcome import finished_appearance
from fd_mitsuba.runs.cost_memory import refuse_too_many_samples
from fd_mitsuba.runs.geometry_outcome import load_finished_stage
from fd_mitsuba.runs.saved_run import saved_run
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.viewing.sheets import as_bytes

RESULT_NAME = "evaluation.json"
_SHOWN = 8


@dataclass(frozen=True)
class Protocol:
    """How to look: the paper's 100 views unless said otherwise.

    Attributes:
        views: on the ring.
        size: pixels a side.
        spp: samples a pixel of lit pictures; normals take a fixed number.
        pictures: `auto` is `lit` where the run has an appearance, else `shape`: what the judge wants of a bare shape.
    """

    views: int = 100
    size: int = 96
    spp: int = 16
    pictures: Literal["auto", "lit", "shape"] = "auto"

    def __post_init__(self) -> None:
        if self.views < 1 or self.size < 16 or self.spp < 1:
            raise UserError(f"--views {self.views} --size {self.size} --spp {self.spp}: give at least 1, 16 and 1")
        if self.views > 10_000 or self.size > 2048 or self.spp > 4096:
            raise UserError(
                f"--views {self.views} --size {self.size} --spp {self.spp}: give at most 10000, 2048 and 4096"
            )
        refuse_too_many_samples(
            min(self.views, VIEWS_TOGETHER), self.size, self.spp, f"--size {self.size} --spp {self.spp}"
        )


def evaluate_run(
    folder: Path,
    judge: Judge,
    protocol: Protocol | None = None,
    rivals: Sequence[ScenePrompts] = (),
    again: bool = False,
    say: Callable[[str], None] = print,
) -> dict:
    """The figures of one run, which are also written to `folder/evaluation.json`, or `evaluation_shape.json` where
    pictures of the bare shape were asked for; views are shown in `folder/images` under the same name.

    Args:
        rivals: the scenes whose edit prompts the run's own has to be found among. If the built-in models know every
            word of the run's prompt, only the scenes of which that is true count.
        say: takes a line where the run's scene is gone and its copy is read, or where the scores say nothing.
        again: also if a result of the same run, judge, protocol and rivals is there already.

    Raises:
        UserError: no finished run there, or pictures that it cannot give.
    """
    protocol, started = protocol or Protocol(), time.monotonic()
    if not (folder / "metrics.json").is_file():
        raise UserError(f"{folder}: no metrics.json; give the -o folder of a finished run")
    path = folder / (RESULT_NAME if protocol.pictures != "shape" else "evaluation_shape.json")
    key = _key(folder, judge, protocol, rivals)
    known = read_json_object(path) or {}
    if not again and known.get("key") == key and _is_whole(known):
        return known
    metrics = measured_by_run(folder)  # first: all the rest takes its time
    scene, config = saved_run(folder, say=say)
    appearance = None if protocol.pictures == "shape" else finished_appearance(scene, config, folder)
    if appearance is None and protocol.pictures == "lit":
        raise UserError(f"{folder}: its appearance stage has not begun; evaluate its shape instead")
    if appearance is not None:
        with rendering_threads():
            views = lit_views(appearance, protocol.views, protocol.size, protocol.spp)
    else:
        stage = load_finished_stage(scene, config, folder)
        with rendering_threads():
            views = shape_views(stage, protocol.views, protocol.size, 9, _shape_kind(judge))
    if scene.subtracts and judge.name == BUILTIN_NAME:
        say(f"{folder}: takes a part off, for which the built-in evaluator has no words: its scores do not count")
    vocabulary = builtin_vocabulary()
    own, simple = _words(scene)
    if vocabulary is not None and not ScenePrompts(scene.path, own, simple).known_to(vocabulary):
        vocabulary = None
    among = [rival.words for rival in rivals if vocabulary is None or rival.known_to(vocabulary)]
    result = {
        "format": FORMAT,
        "key": key,
        "run": str(folder),
        "scene": _scene_name(folder, scene),
        "prompt": own.prompt,
        "base_prompt": own.base_prompt,
        "seed": config.seed,
        "guidance_model": config.guidance.source,
        "steps": [config.geometry.steps, None if appearance is None else config.appearance.steps],
        "judge": judge.name,
        "views": about_views(views),
        **judged(views, judge, own, simple, among, vocabulary),
        **measured(scene, folder, views, metrics),
    }
    if appearance is not None and not scene.subtracts:
        reach = config.appearance.boundary_reach
        step = boundary_step(scene, appearance.parts.values(), appearance.field, reach)
        result["boundary"] = {"colour_step": step, "reach": reach}
    result["evaluation_seconds"] = round(time.monotonic() - started, 1)
    write_json(path, result)
    write_picture(folder / "images" / f"{path.stem}.png", Image.fromarray(views_sheet(views)))
    return result


def views_sheet(views: JudgedViews) -> np.ndarray:
    """Eight of the views: rows base, start, edited; (3 S, 8 S, 3) uint8."""
    chosen = np.linspace(0, len(views.edited), min(_SHOWN, len(views.edited)), endpoint=False).astype(int)
    rows = [as_bytes(pictures[chosen]) for pictures in (views.base, views.start, views.edited)]
    return np.concatenate([np.concatenate(list(row), axis=1) for row in rows])


def builtin_vocabulary() -> Vocabulary | None:
    """The words of the built-in prior; None if this installation has none."""
    return vocabulary_of("builtin")


def _is_whole(known: dict) -> bool:
    """Whether a result that was read again has all that tables ask for."""
    texts = all(isinstance(known.get(name), str) for name in ("scene", "prompt", "judge")) and "seed" in known
    groups = all(isinstance(known.get(name), dict) for name in ("views", "clip", "part", "base", "cost"))
    try:
        return texts and groups and "kind" in known["views"] and bool([c.value(known) for c in COLUMNS.values()])
    except (TypeError, ValueError, KeyError, AttributeError):
        return False


def _scene_name(folder: Path, scene: EditScene) -> str:
    """The name of the folder that the scene lay in when it was run; the run's own copy lies in one called `scene`."""
    recorded = (read_json_object(folder / "run.json") or {}).get("scene_name")
    return recorded if isinstance(recorded, str) and recorded else scene.path.resolve().parent.name


def _shape_kind(judge: Judge) -> Literal["normals", "shaded"]:
    return "normals" if judge.geometry_pictures == "normals" else "shaded"


def _words(scene: EditScene) -> tuple[EditPrompt, str | None]:
    """The run's own, and the simplified prompt where the scene's file has one for this very prompt."""
    words = EditPrompt(scene.prompt, scene.base_prompt)
    said = prompts_of_scene(scene.path, scene.parameters)
    return words, said.simple if said is not None and said.words.prompt == scene.prompt else None


def _key(folder: Path, judge: Judge, protocol: Protocol, rivals: Sequence[ScenePrompts]) -> str:
    """Changes with whatever the result depends on."""
    digest = hashlib.sha256((folder / "metrics.json").read_bytes())
    among = [(rival.name, rival.words) for rival in rivals]
    digest.update(repr((FORMAT, judge.name, judge.version, protocol, among)).encode())
    return digest.hexdigest()[:16]
