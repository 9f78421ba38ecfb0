"""A caller's own guidance before a scene whose parts have prompts of their own."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.geometry_outcome import with_prompt
from fd_mitsuba.scene.focal_region import PartPrompt


class Plain:
    def set_prompt(self, prompt: str, negative_prompt: str) -> list[str]:
        return []


class WithParts(Plain):
    def set_part_prompts(self, prompts: dict[str, tuple[str, str]]) -> None:
        self.told = prompts


def scene(**parts: PartPrompt) -> SimpleNamespace:
    return SimpleNamespace(path="scene.xml", prompt="a cat", negative_prompt="", part_prompts=parts)


def test_a_guidance_that_takes_prompts_of_parts_gets_them() -> None:
    guidance = WithParts()
    with_prompt(guidance, scene(hat=PartPrompt("a hat", "blurry")), print)
    assert guidance.told == {"hat": ("a hat", "blurry")}
    with_prompt(guidance, scene(), print)
    assert guidance.told == {}, "those of an earlier scene do not stay"


def test_one_that_does_not_is_refused_rather_than_left_uninformed() -> None:
    with_prompt(Plain(), scene(), print)
    with pytest.raises(UserError, match="scene.xml: part 'hat' has a prompt of its own, which Plain cannot take"):
        with_prompt(Plain(), scene(hat=PartPrompt("a hat")), print)
