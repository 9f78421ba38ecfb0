"""What a person chooses of a run's settings in the studio; all else comes from the settings' file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fd_mitsuba.config import RunConfig, settings_for_run

PRESETS = ("quick", "smoke")
"""Names of the settings that the page offers, besides one that `-c` has given."""


@dataclass(frozen=True)
class StudioSettings:
    """Attributes:
    preset: as for `-c`.
    seed: of the run.
    steps: of the geometry stage; 0: as many as the preset has.
    overrides: `section.key=value`, as for `--set`; seed and steps come after them.
    """

    preset: str = PRESETS[0]
    seed: int = 0
    steps: int = 0
    overrides: tuple[str, ...] = ()

    def config(self) -> RunConfig:
        """All settings of the run; UserError where one is out of range."""
        chosen = [*self.overrides, f"seed={self.seed}"]
        if self.steps:
            chosen.append(f"geometry.steps={self.steps}")
        return settings_for_run(self.preset, chosen).config

    def to_json(self) -> dict[str, Any]:
        """Plain values for `json.dumps`."""
        return {**vars(self), "overrides": list(self.overrides)}

    @classmethod
    def of_json(cls, data: dict[str, Any]) -> StudioSettings:
        """From `to_json`; KeyError, TypeError or ValueError where it is none."""
        overrides = tuple(str(item) for item in data["overrides"])
        return cls(str(data["preset"]), int(data["seed"]), int(data["steps"]), overrides)
