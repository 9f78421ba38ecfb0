"""What a run folder says about itself, as far as the run has come; whatever is missing is left out."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from pydantic import ValidationError

from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.training.record import read_metrics

_GROUPS = ("appearance", "stages", "part_faces")
"""Entries of `metrics.json` that are objects."""
_MOST_CHARACTERS = 1 << 18
_BASE_PROMPT = re.compile(r'name="base_prompt"\s+value="([^"$]+)"')


@dataclass(frozen=True)
class RunRecord:
    """A run, finished or not.

    Attributes:
        prompt, base_prompt: empty where they are not known.
        metrics, evaluation: what `metrics.json` and `evaluation.json` hold, or nothing.
        rows: of `metrics.jsonl`, by stage.
        settings: what `config.json` holds.
        state: one line for people; `finished` says whether all is done that the run was asked for.
    """

    folder: Path
    prompt: str
    base_prompt: str
    identity: dict
    metrics: dict
    evaluation: dict
    rows: dict[str, list[dict]]
    settings: dict
    environment: dict
    commands: list[str]
    state: str
    finished: bool

    @property
    def lit(self) -> bool:
        """Whether the appearance stage has written its pictures."""
        return "appearance" in self.metrics

    def seconds(self) -> dict[str, float]:
        """Seconds spent in the steps of each stage; of a resumed run, over all its sessions."""
        found = {}
        for stage, rows in self.rows.items():
            total = before = 0.0
            for row in rows:
                now = row.get("seconds")
                now = float(now) if isinstance(now, int | float) else before
                total += now - before if now >= before else now
                before = now
            found[stage] = total
        return found


def read_run(folder: Path) -> RunRecord:
    """The record of a run folder; UserError if it is none."""
    if not folder.is_dir():
        raise UserError(f"{folder}: no such run folder; give the -o folder of a run")
    if not (folder / "run.json").is_file():
        raise UserError(f"{folder}: not a run (no run.json); give the -o folder of a run")
    names = ("run", "metrics", "evaluation", "config", "environment")
    identity, metrics, evaluation, settings, environment = (
        read_json_object(folder / f"{name}.json") or {} for name in names
    )
    # What is of another type than the run writes was not written by it, and says nothing.
    metrics = {key: value for key, value in metrics.items() if isinstance(value, dict) or key not in _GROUPS}
    rows: dict[str, list[dict]] = {}
    for row in read_metrics(folder / "metrics.jsonl"):
        if isinstance(row.get("stage"), str) and isinstance(row.get("step"), int):
            rows.setdefault(row["stage"], []).append(row)
    lines = _beginning(folder / "command.txt").splitlines()
    state, finished = _state(metrics, rows, settings)
    return RunRecord(
        folder,
        str(identity.get("prompt") or metrics.get("prompt") or ""),
        str(identity.get("base_prompt") or _recorded_base_prompt(folder, str(identity.get("scene", "")))),
        identity,
        metrics,
        evaluation,
        rows,
        settings,
        environment,
        list(dict.fromkeys(line for line in lines if line.strip())),
        state,
        finished,
    )


def changed_settings(settings: dict) -> set[str]:
    """`section.key` of the settings that are not the defaults; none where they are another version's."""
    try:
        now = RunConfig.model_validate(settings).model_dump(mode="json")
    except ValidationError:
        return set()
    usual = RunConfig().model_dump(mode="json")
    changed = set()
    for section, values in now.items():
        if isinstance(values, dict):
            changed |= {f"{section}.{key}" for key, value in values.items() if value != usual[section][key]}
        elif values != usual[section]:
            changed.add(section)
    return changed


def _state(metrics: dict, rows: dict[str, list[dict]], settings: dict) -> tuple[str, bool]:
    stages = metrics.get("stages")
    if isinstance(stages, dict):
        done = [name for name, state in stages.items() if state == "done"]
        return ("finished" if "appearance" in stages else "finished: shape only"), bool(done)
    if metrics and ("appearance" in metrics or "appearance" not in rows):
        return ("finished" if "appearance" in metrics else "shape only"), True
    if not rows:
        return "no step finished yet", False
    stage = "appearance" if "appearance" in rows else "geometry"
    section = settings.get(stage)
    total = section.get("steps") if isinstance(section, dict) else None
    return f"unfinished: {stage} stage, step {rows[stage][-1].get('step')} of {total or '?'}", False


def _beginning(path: Path) -> str:
    """The first part of a text file, as much as is of use; nothing where there is none."""
    try:
        if not path.is_file():
            return ""
        with open(path, encoding="utf-8", errors="replace") as file:
            return file.read(_MOST_CHARACTERS)
    except OSError:
        return ""


def _recorded_base_prompt(folder: Path, scene: str) -> str:
    """From the run's copy of its scene file, where it stands there as it is."""
    found = _BASE_PROMPT.search(_beginning(folder / "scene" / (Path(scene).name or "scene.xml")))
    return found[1] if found else ""
