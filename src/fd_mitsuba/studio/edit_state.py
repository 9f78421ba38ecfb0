"""What a person edits: the scene that was opened, its regions, the prompt, the settings; kept in the work folder."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fd_mitsuba.assets.placing import prompted_regions
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.prompted_part import prompted_parts
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import ADD
from fd_mitsuba.scene.headroom import frame_with_headroom
from fd_mitsuba.scene.load_scene import load_edit_scene
from fd_mitsuba.scene.part_stack import free_name
from fd_mitsuba.scene.region_words import ObjectPlaces
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.studio.base_glb import base_glb
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose
from fd_mitsuba.studio.opening import Opened
from fd_mitsuba.studio.region_list import RegionList
from fd_mitsuba.studio.run_state import RunState
from fd_mitsuba.studio.scene_light import scene_light
from fd_mitsuba.studio.scene_patch import patched
from fd_mitsuba.studio.scene_source import SceneSource
from fd_mitsuba.studio.settings import StudioSettings


@dataclass
class EditState:
    """Attributes:
    source: where the scene is.
    scene: as its file has it; regions and prompt are those of this object.
    glb: the base as the page shows it, user frame.
    light: the scene's, as the page shows it; None: it has none that comes from all around.
    regions, prompt, settings: as they are now; a prompt may be blank.
    selected: name of the ellipsoid that gizmo and fields are for, "" for none.
    saved: the ellipsoids as the scene's file has them.
    """

    source: SceneSource
    scene: EditScene
    glb: bytes
    light: bytes | None
    regions: RegionList
    prompt: str
    settings: StudioSettings
    selected: str = ""
    saved: list[EllipsoidPose] = field(default_factory=list)

    @classmethod
    def open(cls, opened: Opened, settings: StudioSettings, say: Callable[[str], None]) -> EditState:
        """What the work folder holds, or a new one's beginning; UserError where it or its scene cannot be read."""
        record = opened.work.read()
        source = SceneSource.opened(opened, record, say)
        known = (record or {}).get("prompt")
        prompt = (
            opened.scene.prompt if opened.scene is not None else known if isinstance(known, str) and known else None
        )
        state = cls._of_source(source, prompt, settings)
        if record is not None and not source.renewed:
            state._restore(record, say)
        return state

    @classmethod
    def _of_source(cls, source: SceneSource, prompt: str | None, settings: StudioSettings) -> EditState:
        scene = source.load(prompt)
        regions = RegionList.of_scene(scene)
        saved, first = list(regions.poses.values()), next(iter(regions.poses), "")
        shown = base_glb(scene), scene_light(scene)
        return cls(source, scene, *shown, regions, scene.prompt, settings, first, saved)

    def edited_scene(self) -> EditScene:
        """The scene with the regions and the prompt as they are now, in the frame that a run would have."""
        paper, regions, soup = self.regions.frame, self.regions.focal_regions(), self.scene.base_soup
        frame = frame_with_headroom(paper, soup.vertices[np.unique(soup.faces)], regions)
        change = frame.matrix() @ np.linalg.inv(paper.matrix())
        seen = regions if frame is paper else tuple(region.seen_from(change) for region in regions)
        return replace(self.scene, regions=seen, frame=frame, prompt=self.prompt)

    def follow_prompt(self, before: str) -> bool:
        """Put regions where the prompt's parts usually are, if they are where those of the prompt `before` usually are:
        as an import puts them, and untouched. Whether there are others now.
        """
        poses = list(self.regions.poses.values())
        usual = self._usual_poses(before)
        if self.regions.meshes or not _same_regions(poses, usual):
            return False
        wanted = self._usual_poses(self.prompt)
        if _same_regions(wanted, usual):
            return False
        if len(poses) == len(wanted) == 1:
            wanted = [replace(wanted[0], name=poses[0].name, part=poses[0].part)]
        self.regions.poses = {pose.name: pose for pose in wanted}
        if self.selected not in self.regions.poses:
            self.selected = wanted[0].name
        return True

    def _usual_poses(self, prompt: str) -> list[EllipsoidPose]:
        """The regions that an import with that prompt has."""
        asked = prompted_parts(prompt, self.scene.base_prompt)
        placed, _ = prompted_regions(self._places, asked, (), None, False)
        found = []
        for region in placed:
            pose = EllipsoidPose.of_matrix(region.name, region.to_world())
            part = free_name(region.part, self.regions.taken) if region.part else pose.part
            found.append(replace(pose, part=part, prompt=region.prompt or ""))
        return found

    @cached_property
    def _places(self) -> ObjectPlaces:
        soup = self.scene.base_soup
        return ObjectPlaces(soup.vertices, soup.faces)

    @cached_property
    def base(self) -> TriangleMesh:
        """All of the base's faces, in the frame of `regions`."""
        soup = self.scene.base_soup
        return TriangleMesh(soup.name, self.regions.frame.to_canonical(soup.vertices), soup.faces)

    def scene_text(self, text: bytes) -> bytes:
        """A scene file that has the regions of `saved`, with those and the prompt of now."""
        regions = list(self.regions.poses.values())
        return patched(text, self.source.described, regions, self.saved, list(self.regions.meshes), self.prompt)

    def save_scene(self) -> str:
        """Write regions and prompt into the scene that was opened; a line that says what was done.

        Raises:
            UserError: the prompt is blank; the file's regions were changed meanwhile; the result could not be edited.
        """
        if not self.prompt:
            raise UserError("the prompt is blank; describe the edited object, then save")
        source, regions, prompt = self.source, list(self.regions.poses.values()), self.prompt
        before = source.original.read_bytes()
        after = self.scene_text(before)
        if after == before:
            return f"{source.described} has all that already"
        write_atomically(source.original, after)
        try:
            scene = load_edit_scene(source.original, source.parameters, None, prompt)
            found = RegionList.of_scene(scene).poses
            if set(found) != {pose.name for pose in regions} or not all(found[p.name].lies_on(p) for p in regions):
                raise UserError(f"{source.original}: its regions were changed since it was opened here; open it again")
        except UserError:
            write_atomically(source.original, before)
            raise
        source.renew(scene)
        self.saved = regions
        return f"saved in {source.described}"

    def next_round(self, run: RunState) -> EditState:
        """The state with the result of a run as its base, and the same regions and prompt for a start.

        Raises:
            UserError: the run has no result.
        """
        if not (run.folder / "export" / "mitsuba" / "scene.xml").is_file():
            raise UserError(f"run {run.name}: has no result yet; let it finish first")
        regions, prompt = list(self.regions.poses.values()), self.prompt or run.prompt
        return self._of_source(self.source.next_round(run.folder, regions, prompt, run.prompt), None, self.settings)

    def of_mesh(self, path: Path) -> tuple[EditState, list[str]]:
        """The state with a mesh file as its base, imported, and what is to be said about it; UserError as `import`."""
        source, said = self.source.of_mesh(path)
        return self._of_source(source, None, self.settings), said

    def write(self, adopted: list[str]) -> None:
        """Replace the work folder's record; `adopted` are run folders from elsewhere."""
        self.source.work.write(
            {
                **self.source.to_json(),
                "prompt": self.prompt,
                "regions": [pose.to_json() for pose in self.regions.poses.values()],
                "meshes": list(self.regions.meshes),
                "selected": self.selected,
                "settings": self.settings.to_json(),
                "adopted": adopted,
            }
        )

    def _restore(self, record: dict[str, Any], say: Callable[[str], None]) -> None:
        """What the record says, as far as it can be read: a damaged entry leaves the scene's own."""
        try:
            kept = StudioSettings.of_json(record["settings"])
            # What the command line says now counts more than what it said then.
            overrides = self.settings.overrides
            self.settings = replace(kept, overrides=overrides) if overrides else kept
            self.prompt = str(record["prompt"])
            self.regions.restore(record["regions"], record["meshes"])
            self.selected = next(iter(self.regions.poses), "")
            if record.get("selected") in self.regions.poses:
                self.selected = record["selected"]
        except (KeyError, TypeError, ValueError):
            say(f"{self.source.work.record}: is damaged in part; regions and prompt are taken from the scene")


def _same_regions(poses: Sequence[EllipsoidPose], others: Sequence[EllipsoidPose]) -> bool:
    """Whether as many add the same prompts in the same places."""
    return len(poses) == len(others) and all(
        pose.mode == ADD and pose.prompt == other.prompt and pose.lies_on(other)
        for pose, other in zip(poses, others, strict=True)
    )
