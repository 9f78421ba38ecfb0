"""Checkpoints that a kill cannot spoil: one safetensors file a step, written aside and renamed.

A file holds the field, the optimiser's moments, and in its header the stage, the step, the settings' hash, the format
version, what the stage counts from step to step, and a hash of the tensors: safetensors has no checksum of its own,
and a flipped bit must not train on.
Random numbers depend on (seed, step) only, so no generator state is needed for a resumed run to go on exactly.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from dataclasses import field as dataclass_field
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor, nn

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.json_object import parse_json_object
from fd_mitsuba.training.stage import Stage
from fd_mitsuba.training.weight_average import WeightAverage

FORMAT = 1
_HEADER_KEY = "fd_mitsuba"


@dataclass(frozen=True)
class CheckpointHeader:
    """`step` counts the finished steps; `config_hash` is `RunConfig.content_hash`; `counters` are the stage's own."""

    stage: str
    step: int
    config_hash: str
    format: int = FORMAT
    counters: dict[str, int] = dataclass_field(default_factory=dict)


def checkpoint_folder(run: Path, stage: str) -> Path:
    """Where a run folder keeps the checkpoints of a stage."""
    return run / ("checkpoints" if stage == "geometry" else f"checkpoints_{stage}")


def checkpoint_path(folder: Path, step: int) -> Path:
    """Where the checkpoint after `step` finished steps lies."""
    return folder / f"step_{step:06d}.safetensors"


def save_checkpoint(
    folder: Path,
    header: CheckpointHeader,
    field: nn.Module,
    optimiser: torch.optim.Optimizer,
    keep: int,
    guidance: Any = None,
    average: WeightAverage | None = None,
) -> Path:
    """Write a checkpoint so that it is there whole or not at all, then remove all but the newest `keep`.

    Files of later steps go as well: `load_newest` passed over them as damaged, and they would push out good ones.

    Args:
        guidance: whose `learned_state`, where it has one, is kept too.
        average: of the field, where there is one.

    Raises:
        UserError: the folder cannot be written (full, read-only).
    """
    tensors = {f"field.{name}": value.detach().contiguous() for name, value in field.state_dict().items()}
    for index, state in optimiser.state_dict()["state"].items():
        for name, value in state.items():
            tensors[f"optimiser.{index}.{name}"] = torch.as_tensor(value).contiguous()
    if average is not None:
        tensors |= {f"average.{name}": value.contiguous() for name, value in average.module.state_dict().items()}
    if hasattr(guidance, "learned_state"):
        tensors |= {f"guidance.{name}": value for name, value in guidance.learned_state().items()}
    text = json.dumps({**vars(header), "sha256": _digest(tensors)}, sort_keys=True)
    path = checkpoint_path(folder, header.step)
    write_atomically(path, save(tensors, metadata={_HEADER_KEY: text}))
    files = list_checkpoints(folder)
    place = files.index(path)
    for other in files[: max(place + 1 - keep, 0)] + files[place + 1 :]:
        other.unlink(missing_ok=True)
    return path


def list_checkpoints(folder: Path) -> list[Path]:
    """Checkpoint files, oldest first; strays are ignored."""
    found = [p for p in folder.glob("step_*.safetensors") if p.stem[5:].isdecimal()]
    return sorted(found, key=lambda p: int(p.stem[5:]))


def load_newest(
    folder: Path,
    stage: str,
    config_hash: str,
    field: nn.Module,
    optimiser: torch.optim.Optimizer,
    counters: dict[str, int] | None = None,
    guidance: Any = None,
    average: WeightAverage | None = None,
) -> tuple[int, list[str]]:
    """Load the newest whole checkpoint into the field and the optimiser, and its counters into `counters` if given.

    Args:
        guidance, average: get back what `save_checkpoint` has kept of them.

    Returns:
        The number of finished steps (0 without a checkpoint), and a line for each damaged file that was passed over.

    Raises:
        UserError: the checkpoint is of other settings, another stage, format or shape.
    """
    remarks: list[str] = []
    for path in reversed(list_checkpoints(folder)):
        try:
            with safe_open(path, framework="pt") as file:
                header = parse_json_object((file.metadata() or {}).get(_HEADER_KEY, ""))
                tensors = {name: file.get_tensor(name) for name in file.keys()}
        except (SafetensorError, OSError, ValueError) as error:
            remarks.append(f"{path}: damaged checkpoint passed over ({' '.join(str(error).split())})")
            continue
        header = _checked_header(path, header, stage, config_hash)
        if header.get("sha256") != _digest(tensors):
            remarks.append(f"{path}: damaged checkpoint passed over (its tensors do not fit their hash)")
            continue
        _apply(path, tensors, field, optimiser, average)
        _teach(path, tensors, guidance)
        if counters is not None:
            counters.update(header.get("counters", {}))
        return int(header["step"]), remarks
    return 0, remarks


def load_trained(run: Path, stage: Stage, config_hash: str) -> bool:
    """Put a stage into the state of its newest whole checkpoint in a run folder; False if it has none at all.

    Raises:
        UserError: every checkpoint is damaged, and see `load_newest`.
    """
    folder = checkpoint_folder(run, stage.name)
    if not list_checkpoints(folder):
        return False
    own = stage.field, stage.optimiser, stage.counters
    done, remarks = load_newest(folder, stage.name, config_hash, *own, average=stage.average)
    if not done:
        newest = remarks[0].removeprefix(f"{folder}/") if remarks else ""
        raise UserError(f"{folder}: every checkpoint is damaged ({newest}); run the {stage.name} stage again")
    return True


def _teach(path: Path, tensors: dict[str, Tensor], guidance: Any) -> None:
    learned = {name[9:]: value for name, value in tensors.items() if name.startswith("guidance.")}
    if learned and hasattr(guidance, "load_learned_state"):
        try:
            guidance.load_learned_state(learned)
        except ValueError as error:
            raise UserError(f"{path}: {error}; choose another -o folder") from None


def _digest(tensors: dict[str, Tensor]) -> str:
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}\n".encode())
        digest.update(value.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def _checked_header(path: Path, header: object, stage: str, config_hash: str) -> dict[str, Any]:
    if not isinstance(header, dict):
        raise UserError(f"{path}: not a checkpoint of fd_mitsuba (no header); remove it or choose another -o folder")
    if header.get("format") != FORMAT:
        raise UserError(f"{path}: checkpoint format {header.get('format')}, this version reads {FORMAT}; start anew")
    if header.get("stage") != stage:
        raise UserError(f"{path}: checkpoint of stage {header.get('stage')!r}, not {stage!r}; choose another -o folder")
    if header.get("config_hash") != config_hash:
        raise UserError(
            f"{path}: made with other settings; resume with the run's own -c and --set, or choose another -o"
        )
    if not isinstance(header.get("step"), int) or header["step"] < 0:
        raise UserError(f"{path}: its header has no step; remove this file to resume from an earlier one")
    counters = header.get("counters", {})
    if not isinstance(counters, dict) or not all(isinstance(value, int) for value in counters.values()):
        raise UserError(f"{path}: its header's counters cannot be read; remove this file to resume from an earlier one")
    return header


def _apply(
    path: Path,
    tensors: dict[str, Tensor],
    field: nn.Module,
    optimiser: torch.optim.Optimizer,
    average: WeightAverage | None,
) -> None:
    modules = {"field.": field} | ({} if average is None else {"average.": average.module})
    found = {}
    for start, module in modules.items():
        found[start] = {name[len(start) :]: value for name, value in tensors.items() if name.startswith(start)}
        if {n: v.shape for n, v in module.state_dict().items()} != {n: v.shape for n, v in found[start].items()}:
            raise UserError(f"{path}: its tensors do not fit this field; choose another -o folder")
    bad = [name for name, value in tensors.items() if value.is_floating_point() and not torch.isfinite(value).all()]
    if bad:
        raise UserError(
            f"{path}: {bad[0]} holds values that are not finite; remove this file to resume from an earlier one"
        )
    parameters = {str(i): p for i, p in enumerate(p for group in optimiser.param_groups for p in group["params"])}
    moments: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        if name.startswith("optimiser."):
            _, index, key = name.split(".", 2)
            if index not in parameters or (value.dim() and value.shape != parameters[index].shape):
                raise UserError(f"{path}: {name} does not fit this optimiser; choose another -o folder")
            moments.setdefault(int(index), {})[key] = value
    state = optimiser.state_dict()
    state["state"] = moments
    for start, module in modules.items():
        module.load_state_dict(found[start])
    optimiser.load_state_dict(state)
