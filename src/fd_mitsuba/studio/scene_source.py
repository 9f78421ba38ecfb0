"""Which scene file the studio works on: the copy in its work folder, and where that came from."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fd_mitsuba.api import import_asset
from fd_mitsuba.conventions import DEFAULT_PART_NAME
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.opening import Opened
from fd_mitsuba.studio.scene_patch import patched
from fd_mitsuba.studio.work_folder import WorkFolder


@dataclass(frozen=True)
class SceneSource:
    """Attributes:
    work: the work folder.
    copy: the scene file in it; never changed between two openings of its original.
    original: the scene file that `save_scene` writes: the user's own, or `copy` in later rounds.
    first: the user's own.
    parameters: the scene's `-D` values.
    round: 1 for the scene as it was opened, 2 after the first "edit again".
    renewed: whether the original differs from what the work folder knew of it.
    """

    work: WorkFolder
    copy: Path
    original: Path
    first: Path
    parameters: dict[str, str]
    round: int = 1
    renewed: bool = False

    @classmethod
    def opened(cls, opened: Opened, record: dict[str, Any] | None, say: Callable[[str], None]) -> SceneSource:
        """The source that a work folder's record names, or a new one for the scene that was opened.

        Raises:
            UserError: the work folder is another scene's, or its scene is gone.
        """
        work, scene = opened.work, opened.scene
        if record is None:
            if scene is None:
                raise UserError(f"{work.path}: has no record; open the scene again")
            own = scene.path.resolve()
            return cls(work, work.copy_scene(scene), own, own, dict(scene.parameters), renewed=True)
        try:
            known = cls(
                work,
                work.path / str(record["copy"]),
                (work.path.resolve() / str(record["original"])).resolve(),
                (work.path.resolve() / str(record["first"])).resolve(),
                {str(key): str(value) for key, value in record["parameters"].items()},
                int(record["round"]),
            )
        except (KeyError, TypeError, ValueError, AttributeError):
            raise UserError(f"{work.record}: is damaged; choose another -o folder") from None
        if scene is None:
            return known
        if scene.path.resolve() != known.first:
            raise UserError(f"{work.path}: is the work folder of another scene; choose another -o folder")
        if known.round == 1 and (
            scene.path.read_bytes() != known.copy.read_bytes() or scene.parameters != known.parameters
        ):
            say(f"{scene.path}: was changed since the studio saw it last; regions and prompt are taken from it")
            return replace(
                known, copy=work.copy_scene(scene), parameters=dict(scene.parameters), renewed=True
            )  # fmt: skip
        return known

    def to_json(self) -> dict[str, Any]:
        """For the work folder's record."""
        return {
            "copy": self.work.relative(self.copy),
            "original": self.work.relative(self.original),
            "first": self.work.relative(self.first),
            "parameters": self.parameters,
            "round": self.round,
        }

    @property
    def text(self) -> bytes:
        """The scene file as it was opened."""
        return self.copy.read_bytes()

    @property
    def described(self) -> str:
        """The scene file for people who do not know this machine's folders."""
        return self.original.name if self.round == 1 else self.work.relative(self.copy)

    def load(self, prompt: str | None) -> EditScene:
        """The scene, from the work folder's copy; regions may lie wrong. UserError as `load_edit_scene`."""
        if not self.copy.is_file():
            raise UserError(f"{self.copy}: is gone; choose another -o folder")
        return load_edit_scene(self.copy, self.parameters, None, prompt, lambda error: None, needs_region=False)

    def snapshot(self, run: str, text: bytes) -> Path:
        """The scene file of a run, beside the copy, so that it reads the same meshes."""
        path = self.copy.parent / f"run_{run}.xml"
        write_atomically(path, text)
        return path

    def renew(self, scene: EditScene) -> None:
        """Copy the original again, after it was saved."""
        if self.round == 1:
            self.work.copy_scene(scene)

    def next_round(self, run: Path, regions: list[EllipsoidPose], prompt: str, base_prompt: str) -> SceneSource:
        """The exported result of a run as the scene of another round.

        Args:
            regions: to start from; their part gets the first free name, and reads the scene's prompt.
            base_prompt: what the result looks like.
        """
        number = self.work.next_scene(self.round)
        folder = self.work.scene_folder(number)
        shutil.copytree(run / "export" / "mitsuba", folder)
        path = folder / "scene.xml"
        plain = [replace(pose, part=DEFAULT_PART_NAME, prompt="", negative_prompt="") for pose in regions]
        write_atomically(path, patched(path.read_bytes(), path.name, plain, [], (), prompt, base_prompt))
        return SceneSource(self.work, path, path, self.first, {}, number)

    def of_mesh(self, path: Path) -> tuple[SceneSource, list[str]]:
        """A mesh file as the scene of another round, and what was guessed and left out, a line each.

        Raises:
            UserError: it cannot be read or edited.
        """
        number = self.work.next_scene(self.round)
        folder = self.work.scene_folder(number)
        try:
            made = import_asset(path, folder)
        except BaseException:
            shutil.rmtree(folder, ignore_errors=True)
            raise
        # What a guess is followed by is how the command line says otherwise; the page has fields for that.
        guesses = [re.split("; (?:--|give )", line)[0] for line in made.remarks]
        return SceneSource(self.work, made.scene, made.scene, self.first, {}, number), [*guesses, *made.notes]
