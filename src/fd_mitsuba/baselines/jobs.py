"""One scene by one method with one seed: made, measured, and written down, so that it need not be made again."""

from __future__ import annotations

import gc
import hashlib
import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from fd_mitsuba.baselines.interface import EditTask
from fd_mitsuba.baselines.measuring import FORMAT, CompareProtocol, measure
from fd_mitsuba.baselines.methods import BASELINES
from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import Interrupted, UserError, first_line
from fd_mitsuba.evaluation.similarity import Judge
from fd_mitsuba.io.json_object import read_json_object, write_json
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.runs.run_folder import identity
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.viewing.sheets import as_bytes

RESULT_NAME, TASK_NAME, VIEWS_NAME, WORK_NAME = "result.json", "task.json", "views.png", "work"
FINISHED, SKIPPED, FAILED = "finished", "skipped", "failed"


@dataclass(frozen=True)
class CompareJob:
    """What is wanted.

    Attributes:
        scene: what to edit.
        scene_name: of its folder.
        method: name and settings, complete.
        config: settings of the run, with the seed.
        folder: holds `result.json`, `views.png` and `work`, where the method keeps its own files.
    """

    scene: EditScene
    scene_name: str
    method: Choice
    config: RunConfig
    folder: Path

    @property
    def name(self) -> str:
        """Of the folder: `<scene>-<method>-<seed>`."""
        return self.folder.name

    def task_key(self) -> str:
        """Changes with whatever the method's outcome depends on."""
        about = identity(self.scene, self.config, self.folder)
        known = [about[key] for key in ("scene_hash", "prompt", "base_prompt", "parameters", "config_hash")]
        return _digest([FORMAT, known, self.method.kind, self.method.options])


@dataclass(frozen=True)
class JobOutcome:
    """What became of a job: `finished`, `skipped` (it was finished before) or `failed`, and the result if any."""

    job: CompareJob
    state: str
    message: str
    result: dict[str, Any] | None


def perform(
    job: CompareJob, judge: Judge, protocol: CompareProtocol, say: Callable[[str], None], quiet: bool = True
) -> JobOutcome:
    """Do a job, or read what was done before; a failure of the method is an outcome, not an exception.

    Raises:
        Interrupted: SIGINT or SIGTERM; the same call goes on from the last checkpoint.
    """
    try:
        if (known := finished_result(job, judge, protocol)) is not None:
            return JobOutcome(job, SKIPPED, "", known)
        return JobOutcome(job, FINISHED, "", _made(job, judge, protocol, say, quiet))
    except (Interrupted, KeyboardInterrupt):
        raise
    except UserError as error:
        return JobOutcome(job, FAILED, str(error), None)
    except Exception as error:  # a fault of one method must not cost the others' results
        return JobOutcome(job, FAILED, f"{type(error).__name__}: {first_line(error)}", None)
    finally:
        gc.collect()


def finished_result(job: CompareJob, judge: Judge, protocol: CompareProtocol) -> dict[str, Any] | None:
    """What is known of a job that was finished before, with these settings and by this judge; None: it was not."""
    known = read_json_object(job.folder / RESULT_NAME) or {}
    there = known.get("key") == _key(job, judge, protocol) and (job.folder / VIEWS_NAME).is_file()
    return known if there else None


def _key(job: CompareJob, judge: Judge, protocol: CompareProtocol) -> str:
    return _digest([job.task_key(), judge.name, judge.version, protocol.views, protocol.size])


def _made(
    job: CompareJob, judge: Judge, protocol: CompareProtocol, say: Callable[[str], None], quiet: bool
) -> dict[str, Any]:
    task_key = job.task_key()
    before = read_json_object(job.folder / TASK_NAME)
    if before is None and job.folder.exists() and any(job.folder.iterdir()):
        raise UserError(f"{job.folder}: is not empty and holds no comparison; choose another -o folder")
    if before is not None and before.get("key") != task_key:
        raise UserError(f"{job.folder}: was made with other settings or another scene; choose another -o, or delete it")
    spent = float((before or {}).get("seconds") or 0.0)
    done = bool((before or {}).get("done"))
    record = {"key": task_key, "method": job.method.kind, "settings": job.method.options, "seed": job.config.seed}
    write_json(job.folder / TASK_NAME, record | {"seconds": spent, "done": done})
    task = EditTask(job.scene, job.config, job.folder / WORK_NAME, say, quiet)
    started = time.monotonic()
    try:
        edited = BASELINES.make(job.method, "--methods", task)
        measured = measure(edited, task, judge, protocol)
    finally:
        # What was finished before took what it took then.
        spent += 0.0 if done else time.monotonic() - started
        write_json(job.folder / TASK_NAME, record | {"seconds": round(spent, 1), "done": done})
    calls = task.guidance_calls if edited.guidance_calls is None else edited.guidance_calls
    result = {
        "key": _key(job, judge, protocol),
        "scene": job.scene_name,
        "method": job.method.kind,
        "settings": job.method.options,
        "seed": job.config.seed,
        "prompt": job.scene.prompt,
        "base_prompt": job.scene.base_prompt,
        "guidance_model": job.config.guidance.source,
        "steps": job.config.geometry.steps,
        **measured.metrics,
        "cost": {"seconds": round(spent, 1), "guidance_calls": calls},
    }
    rows = [np.concatenate(list(as_bytes(images)), axis=1) for images in (measured.base, measured.edited)]
    write_picture(job.folder / VIEWS_NAME, Image.fromarray(np.concatenate(rows)))
    write_json(job.folder / RESULT_NAME, result)
    write_json(job.folder / TASK_NAME, record | {"seconds": round(spent, 1), "done": True})
    return result


def views_of(folder: Path) -> tuple[np.ndarray, np.ndarray]:
    """The base's and the edited object's images (N, S, S, 3) uint8 of a finished job."""
    sheet = np.asarray(Image.open(folder / VIEWS_NAME).convert("RGB"))
    size = sheet.shape[0] // 2
    rows = sheet.reshape(2, size, -1, size, 3).transpose(0, 2, 1, 3, 4)
    return rows[0], rows[1]


def _digest(values: Sequence[Any]) -> str:
    return hashlib.sha256(json.dumps(list(values), sort_keys=True, default=str).encode()).hexdigest()[:16]
