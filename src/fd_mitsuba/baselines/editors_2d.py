"""The methods `pix2pix_2d` and `inpaint_2d`: editors of single images, view by view, which have no object behind them.

The paper's "2D Image Editing Comparisons": InstructPix2Pix with an instruction, and ControlNet inpainting of the focal
regions with the edit's prompt. Without a `model` of their own the guidance model stands in, if it knows shapes.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from fd_mitsuba.baselines.image_editors.by_pipeline import PipelineEdit, load_editor
from fd_mitsuba.baselines.image_editors.by_prior import PriorEdit
from fd_mitsuba.baselines.image_editors.views import EditedViews
from fd_mitsuba.baselines.interface import BASELINES, EditedObject, EditTask
from fd_mitsuba.config import Section
from fd_mitsuba.config.bounds import GuidanceScale, ModelName

SamplingSteps = Annotated[int, Field(ge=1, le=1000)]


class Pix2Pix2dSettings(Section):
    """Of `pix2pix_2d`."""

    model: ModelName = ""
    """An InstructPix2Pix pipeline by folder or hub id; none: the guidance model."""
    instruction: str = ""
    """What to do with each image, for a pipeline; none: "put ... on ...", from the scene's prompts."""
    steps: SamplingSteps = 20
    """Of sampling, for each view."""
    guidance_scale: GuidanceScale | None = None
    """Of the text; none: 7.5 with a pipeline, `guidance.guidance_scale` with the guidance model."""
    image_guidance_scale: GuidanceScale | None = None
    """Of the image; none: 1.5 with a pipeline, `guidance.image_guidance_scale` with the guidance model."""


class Inpaint2dSettings(Section):
    """Of `inpaint_2d`."""

    model: ModelName = ""
    """A Stable Diffusion pipeline by folder or hub id, with 4 input channels beside a ControlNet, or 9; none: the
    guidance model, held outside of the regions at every step."""
    controlnet: ModelName = ""
    """A ControlNet for inpainting, by folder or hub id."""
    steps: SamplingSteps = 20
    """Of sampling, for each view."""
    guidance_scale: GuidanceScale | None = None
    """Of the text; none: 7.5 with a pipeline, `guidance.guidance_scale` with the guidance model."""
    margin: Annotated[int, Field(ge=0, le=64)] = 1
    """Cells of the guidance model's image around the regions that may change, too."""


@BASELINES.register("pix2pix_2d", Pix2Pix2dSettings)
def pix2pix_2d(settings: Pix2Pix2dSettings, task: EditTask) -> EditedObject:
    """InstructPix2Pix on every view by itself, or the guidance model in its place; no object, only images."""
    return pix2pix_editor(settings, task)


def pix2pix_editor(settings: Pix2Pix2dSettings, task: EditTask) -> EditedViews:
    """The editor of single images that the settings name.

    Raises:
        UserError: a model that cannot be loaded, or a guidance model that does not edit.
    """
    own = task.config.guidance
    if not settings.model:
        scales = (
            _or(settings.guidance_scale, own.guidance_scale),
            _or(settings.image_guidance_scale, own.image_guidance_scale),
        )
        return PriorEdit(task, settings.steps, *scales)
    pipeline = load_editor(task, "StableDiffusionInstructPix2PixPipeline", settings.model)
    text = settings.instruction or instruction_for(task.scene.prompt, task.scene.base_prompt)
    scales = {
        "guidance_scale": _or(settings.guidance_scale, 7.5),
        "image_guidance_scale": _or(settings.image_guidance_scale, 1.5),
    }
    return PipelineEdit(task, pipeline, settings.steps, text, scales, repaints=False)


@BASELINES.register("inpaint_2d", Inpaint2dSettings)
def inpaint_2d(settings: Inpaint2dSettings, task: EditTask) -> EditedObject:
    """Inpainting of the focal regions on every view by itself; no object, only images."""
    own = task.config.guidance
    if not settings.model:
        scale = _or(settings.guidance_scale, own.guidance_scale)
        return PriorEdit(task, settings.steps, scale, own.image_guidance_scale, True, settings.margin)
    control = bool(settings.controlnet)
    kind = "StableDiffusionControlNetInpaintPipeline" if control else "StableDiffusionInpaintPipeline"
    pipeline = load_editor(task, kind, settings.model, settings.controlnet)
    scales = {"guidance_scale": _or(settings.guidance_scale, 7.5)}
    return PipelineEdit(task, pipeline, settings.steps, task.scene.prompt, scales, repaints=True, sees_control=control)


def instruction_for(prompt: str, base_prompt: str) -> str:
    """An edit as an instruction: "put a crown on a cat"; of a prompt without "with", "turn it into ...".

    >>> instruction_for("a cat with a crown", "a cat")
    'put a crown on a cat'
    """
    body, word, part = prompt.partition(" with ")
    return f"put {part} on {base_prompt or body}" if word else f"turn it into {prompt}"


def _or(value: float | None, default: float) -> float:
    return default if value is None else value
