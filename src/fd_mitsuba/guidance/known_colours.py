"""Whether the shipped prior of colours knows what the shipped prior of shapes can grow."""

from __future__ import annotations

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.for_model import is_builtin
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.scene.edit_scene import EditScene


def material_left_out(scene: EditScene, config: RunConfig) -> str | None:
    """Why the appearance stage is left out of a run, in one line; None: it is not, or other guidance takes it."""
    model = config.guidance.model
    by_other = config.guidance.kind.kind != "diffusion" or not is_builtin(model)
    if by_other or scene.subtracts or config.appearance.lambda_sds == 0:
        return None
    shapes, colours = vocabulary_of(model), vocabulary_of(model, appearance=True)
    if shapes is None or colours is None:
        return None
    texts = [scene.prompt, *(own.prompt for own in scene.part_prompts.values())]
    named = dict.fromkeys(part for text in texts for part in read_prompt(text, shapes, scene.base_prompt).parts)
    unknown = [part for part in named if part not in colours.parts]
    if not unknown:
        return None
    return (
        f"the built-in prior of colours does not know {', '.join(unknown)}: only the geometry stage runs, and the part "
        'keeps the material of the scene\'s <bsdf id="part">'
    )
