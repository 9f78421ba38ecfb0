"""The prompt of a focal region: what its own part is to be, where the scene's prompt speaks of several."""

from __future__ import annotations

from fd_mitsuba.scene.focal_region import FocalRegion, PartPrompt
from fd_mitsuba.scene.prompt_text import length_fault, one_line_of
from fd_mitsuba.scene.scene_file import SceneElement

PROMPT, NEGATIVE = "prompt", "negative_prompt"


def region_prompt(element: SceneElement) -> PartPrompt | None:
    """The region's `prompt` and `negative_prompt`; None where it has neither.

    Raises:
        UserError: one of them is blank or far too long, or there is a negative prompt alone.
    """
    given = {name: element.properties[name] for name in (PROMPT, NEGATIVE) if name in element.properties}
    texts = {name: one_line_of(str(value)) for name, value in given.items()}
    for name, text in texts.items():
        if not text:
            raise element.error(f"{name} is blank; write what the part is to be, or remove it")
        if fault := length_fault(text):
            raise element.error(f"{name} {fault}")
    if not texts:
        return None
    if PROMPT not in texts:
        raise element.error('negative_prompt without a prompt; add <string name="prompt" value="a hat"/>')
    return PartPrompt(texts[PROMPT], texts.get(NEGATIVE, ""))


def part_prompts(regions: tuple[FocalRegion, ...]) -> dict[str, PartPrompt]:
    """Part -> its prompt, of the parts that have one; a region without a prompt takes that of its part."""
    return {region.part: region.prompt for region in regions if region.prompt is not None}


def check_prompts(elements: list[SceneElement], regions: tuple[FocalRegion, ...]) -> None:
    """UserError where two regions of one part have different prompts.

    Args:
        elements: of the regions, in their order.
    """
    first: dict[str, FocalRegion] = {}
    for element, region in zip(elements, regions, strict=True):
        if region.prompt is None:
            continue
        other = first.setdefault(region.part, region)
        if other.prompt is not None and other.prompt != region.prompt:
            raise element.error(
                f"{region.name!r} and {other.name!r} grow one part, {region.part!r}, by different prompts "
                f"({region.prompt.prompt!r}, {other.prompt.prompt!r}); give one of them another part"
            )
