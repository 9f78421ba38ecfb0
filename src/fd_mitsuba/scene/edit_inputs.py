"""The files that say what to edit: a scene, and if it does not say where itself, a file of regions in its frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.part_stack import UNITS, read_stack
from fd_mitsuba.scene.plugins import DUAL_PATH, FOCAL_REGION
from fd_mitsuba.scene.prompt_text import length_fault, one_line_of
from fd_mitsuba.scene.scene_file import SceneElement, SceneFile
from fd_mitsuba.scene.xml_guard import scan_scene, uses


@dataclass(frozen=True)
class EditInputs:
    """A scene file, and the file given with `--regions`.

    Of the latter only the focal regions, the `dual_path` integrator and `<bsdf id="part">` count. Its regions come
    after the scene's own, or take their place where its integrator has `only_these_regions`; its integrator, if it has
    a prompt, and its BSDF take the place of the scene's.
    """

    scene: SceneFile
    regions: SceneFile | None = None

    @classmethod
    def open(cls, scene: Path, parameters: dict[str, str], regions: Path | None) -> EditInputs:
        """Read both; a `-D` name may be used by either of them.

        Raises:
            UserError: see `SceneFile`.
        """
        if regions is None:
            return cls(SceneFile(scene, parameters))
        texts = [scan_scene(path, parameters, all_used=False) for path in (scene, regions)]
        known = [{name for name in parameters if uses(text, name)} for text in texts]
        ours = {name: value for name, value in parameters.items() if name in known[0] or name not in known[1]}
        theirs = {name: value for name, value in parameters.items() if name in known[1]}
        return cls(SceneFile(scene, ours), SceneFile(regions, theirs))

    @property
    def parameters(self) -> dict[str, str]:
        """All `-D` values."""
        return self.scene.parameters | (self.regions.parameters if self.regions else {})

    @property
    def sources(self) -> tuple[SceneFile, ...]:
        """The scene, then the file of regions."""
        return (self.scene,) if self.regions is None else (self.scene, self.regions)

    @property
    def files(self) -> tuple[Path, ...]:
        """Every file that is read, the scene file and its includes first."""
        found = [*self.scene.text.files, *self.scene.files.values()]
        if self.regions is not None:
            found += self.regions.text.files
            names = [element.properties.get("filename") for _, element in self.region_elements()]
            found += [path for name, path in self.regions.files.items() if name in names]
        return tuple(dict.fromkeys(found))

    def region_elements(self) -> list[tuple[SceneFile, SceneElement]]:
        """The focal regions, each with the file that it is in."""
        return [
            (file, element)
            for file in (self.sources[-1:] if self.replaces_regions else self.sources)
            for element in file.top_level("shape")
            if element.plugin == FOCAL_REGION
        ]

    @property
    def replaces_regions(self) -> bool:
        """Whether the scene's own regions do not count."""
        integrators = [] if self.regions is None else self.regions.top_level("integrator")
        return any(item.plugin == DUAL_PATH and item.properties.get("only_these_regions") for item in integrators)

    @property
    def has_prompt(self) -> bool:
        """Whether there is an integrator to give one."""
        return any(item.plugin == DUAL_PATH for file in self.sources for item in file.top_level("integrator"))

    def unit(self) -> str | None:
        """What a unit of the scene is, "mm", "cm" or "m"; None where neither its integrator nor, for a scene that was
        exported, `stack.json` beside it says it.

        Raises:
            UserError: the integrator says something else; `stack.json` is damaged.
        """
        for element in self.scene.top_level("integrator"):
            unit = element.properties.get("unit") if element.plugin == DUAL_PATH else None
            if unit and unit not in UNITS:
                raise element.error(f"unit {unit!r} is not known; write one of {', '.join(UNITS)}")
            if unit:
                return str(unit)
        return read_stack(self.scene.path.parent)[1].get("unit")

    def base_names(self) -> tuple[SceneElement, list[str]] | None:
        """The ids of the shapes to edit and the integrator that names them; None where none does.

        Raises:
            UserError: it names nothing.
        """
        for file in reversed(self.sources):
            for element in file.top_level("integrator"):
                text = element.properties.get("base", "") if element.plugin == DUAL_PATH else ""
                if not isinstance(text, str):
                    raise element.error('base is not text; write <string name="base" value="ids of shapes"/>')
                names = [name.strip() for name in text.split(",") if name.strip()]
                if "base" in element.properties and element.plugin == DUAL_PATH and not names:
                    raise element.error("base is blank; name the shapes to edit, separated by commas, or leave it out")
                if names:
                    return element, names
        return None

    def part_bsdf(self) -> tuple[SceneFile, SceneElement | None]:
        """`<bsdf id="part">` and the file that it is in; None and the scene where there is none."""
        for file in reversed(self.sources):
            for element in file.top_level("bsdf"):
                if element.id == DEFAULT_PART_NAME:
                    return file, element
        return self.scene, None

    def prompts(self, prompt: str | None, base_prompt: str) -> tuple[str, str, str]:
        """Prompt, base prompt and negative prompt.

        Args:
            prompt: takes the place of the integrator's; None: that is required.
            base_prompt: where no integrator gives one.

        Raises:
            UserError: no prompt, or several integrators that give one.
        """
        integrators: list[SceneElement] = []
        for file in reversed(self.sources):
            found = [e for e in file.top_level("integrator") if e.plugin == DUAL_PATH]
            silent = file is self.regions and self.replaces_regions
            if not silent or any("prompt" in element.properties for element in found):
                integrators = integrators or found
        if not integrators and prompt is None:
            raise UserError(
                f'{self.scene.path}: no <integrator type="{DUAL_PATH}">; add it with <string name="prompt" .../>, or '
                'give --prompt "what the edited object shall look like"'
            )
        if len(integrators) > 1:
            raise integrators[1].error("there are several; keep one")
        if not integrators:
            return prompt or "", base_prompt, ""
        values = []
        for name in ("prompt", "base_prompt", "negative_prompt"):
            value = integrators[0].properties.get(name, "")
            if not isinstance(value, str):
                raise integrators[0].error(f'{name} is not text; write <string name="{name}" value="..."/>')
            values.append(one_line_of(value))
            if fault := length_fault(values[-1]):
                raise integrators[0].error(f"{name} {fault}")
        values[0] = prompt or values[0]
        if not values[0]:
            example = 'add <string name="prompt" value="a horse with wings"/>, or give --prompt'
            raise integrators[0].error(f"prompt is missing or blank; {example}")
        return values[0], values[1] or base_prompt, values[2]
