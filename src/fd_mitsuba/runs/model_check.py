"""Why a run would refuse its guidance model, told from files' headers alone."""

from __future__ import annotations

from pathlib import Path

from fd_mitsuba.config import GuidanceConfig, RunConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.guidance.builtin import builtin_folder, shipped_folder
from fd_mitsuba.guidance.control import check_controlnet, local_controlnet
from fd_mitsuba.guidance.image_prompt import asks_for_image_prompt
from fd_mitsuba.guidance.layout import LAYOUT_NAME
from fd_mitsuba.guidance.lora import lora_file, lora_files
from fd_mitsuba.guidance.model_headers import ModelHeaders, read_headers
from fd_mitsuba.guidance.variants import refuse_conflicts
from fd_mitsuba.io.hub import local_folder
from fd_mitsuba.training.step_views import check_views


def check_model(config: RunConfig, geometry: bool, appearance: bool) -> None:
    """What a run asks of its model before it reads weights, in the run's order; nothing is fetched.

    Of a hub id only what the settings alone tell is known, and of another module's guidance nothing.

    Args:
        geometry, appearance: the stages that a model guides.

    Raises:
        UserError: the one line with which the run would end.
    """
    if config.guidance.kind.kind != "diffusion" or not (geometry or appearance):
        return
    shapes = _headers(config.guidance, False) if geometry else None
    colours = shapes
    if appearance and (not geometry or is_builtin(config.guidance.model)):
        colours = _headers(config.guidance, True)
    if appearance and colours is not None:
        check_views("appearance", config, colours)
    if geometry and shapes is not None:
        check_views("geometry", config, shapes)


def _headers(guidance: GuidanceConfig, appearance: bool) -> ModelHeaders | None:
    """None for a hub id."""
    shipped = shipped_folder(guidance.model, appearance)
    folder = builtin_folder(shipped) if shipped else local_folder(guidance.model, "guidance.model", LAYOUT_NAME)
    found = None
    if folder is None:
        asks_for_image_prompt(guidance)
    else:
        found = read_headers(folder, guidance)
        control = local_controlnet(guidance.controlnet) if guidance.controlnet else None
        if control is not None:
            check_controlnet(control, found.configs["unet"])
    lora_files(guidance.lora)
    for path in guidance.words:
        lora_file(Path(path).expanduser(), "guidance.words")
    refuse_conflicts(guidance)
    return found
