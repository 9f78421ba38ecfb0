"""The prompts of a folder of scenes: what a judge has to tell apart, and which of them the built-in models can read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.similarity import EditPrompt
from fd_mitsuba.guidance.prompt_reader import read_prompt
from fd_mitsuba.guidance.vocabulary import Vocabulary
from fd_mitsuba.scene.plugins import DUAL_PATH
from fd_mitsuba.scene.scene_file import SceneFile


@dataclass(frozen=True)
class ScenePrompts:
    """What a scene file says in words.

    Attributes:
        scene: the file.
        words: edit prompt and base prompt.
        simple: the edit prompt's core; None where the scene gives none.
    """

    scene: Path
    words: EditPrompt
    simple: str | None

    @property
    def name(self) -> str:
        """Of the scene's folder."""
        return self.scene.resolve().parent.name

    def known_to(self, vocabulary: Vocabulary) -> bool:
        """Whether every word is one of the vocabulary's own, and a body and a part among them."""
        reading = read_prompt(self.words.prompt, vocabulary)
        return bool(reading.parts and reading.bodies) and reading.caption == self.words.prompt.lower()


def prompts_of_scenes(folder: Path) -> list[ScenePrompts]:
    """Of every `folder/*/scene.xml`, by name.

    Raises:
        UserError: no scene there, or one that cannot be read.
    """
    files = sorted(folder.glob("*/scene.xml"))
    if not files:
        raise UserError(f"{folder}: holds no */scene.xml; give the folder of the shipped scenes by --scenes")
    return [found for file in files if (found := prompts_of_scene(file)) is not None]


def prompts_of_scene(path: Path, parameters: dict[str, str] | None = None) -> ScenePrompts | None:
    """Of one scene; None if it has no prompt of its own.

    Raises:
        UserError: the file cannot be read.
    """
    for element in SceneFile(path, parameters or {}).top_level("integrator"):
        if element.plugin == DUAL_PATH and element.properties.get("prompt"):
            prompt, base, simple = (
                " ".join(str(element.properties.get(name, "")).split())
                for name in ("prompt", "base_prompt", "simple_prompt")
            )
            return ScenePrompts(path, EditPrompt(prompt, base), simple or None)
    return None


def other_parts(prompt: str, vocabulary: Vocabulary) -> tuple[list[EditPrompt], int] | None:
    """Sentences about the prompt's body with every part of the vocabulary, and which of them is the prompt's.

    None if the prompt names no known body or part. "a cat with a crown" -> "a cat with wings", "a cat with a horn", ...
    """
    reading = read_prompt(prompt, vocabulary)
    if not reading.bodies or not reading.parts:
        return None
    body = vocabulary.bodies[reading.bodies[0]][0]
    sentences = [EditPrompt(f"a {body} with {phrases[0]}", f"a {body}") for phrases in vocabulary.parts.values()]
    return sentences, list(vocabulary.parts).index(reading.parts[0])
