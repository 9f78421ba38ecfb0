"""Which of the shipped priors a scene's prompts are for."""

from __future__ import annotations

from pathlib import Path

from fd_mitsuba.config import RunConfig
from fd_mitsuba.guidance.model_for_prompt import model_for_prompt
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.scene.edit_scene import EditScene


def model_for_scene(config: RunConfig, scene: EditScene) -> tuple[RunConfig, str | None]:
    """As `model_for_prompt`, for a run of the scene, where a prompt guides it at all."""
    guided = config.geometry.lambda_sds > 0 or config.appearance.lambda_sds > 0
    if config.guidance.kind.kind != "diffusion" or not guided:
        return config, None
    single = [own.prompt for own in scene.part_prompts.values()]
    return model_for_prompt(config, [scene.prompt, *single], scene.base_prompt, scene.subtracts)


def model_for_run(config: RunConfig, scene: EditScene, folder: Path) -> tuple[RunConfig, str | None]:
    """As `model_for_scene`; a folder that holds a run keeps the model that this run has begun with."""
    recorded = (read_json_object(folder / "config.json") or {}).get("guidance")
    begun_with = recorded.get("model") if isinstance(recorded, dict) else None
    return (config, None) if begun_with == config.guidance.model else model_for_scene(config, scene)
