"""The regions that a person edits: ellipsoids in the user frame, and meshes that stay as they are."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from fd_mitsuba.errors import UserError
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.focal_region import FocalRegion, PartPrompt
from fd_mitsuba.scene.normalisation import Normalisation
from fd_mitsuba.scene.part_names import is_part_name
from fd_mitsuba.scene.part_stack import free_name
from fd_mitsuba.scene.prompt_text import length_fault
from fd_mitsuba.studio.ellipsoid_pose import EllipsoidPose, turned_to, vector
from fd_mitsuba.studio.picking import Hit

NEW_RADIUS = 0.22
"""Of a new region, canonical units: about what a hat for the base's head takes."""
_SUNK = 0.25
"""How deep a new region reaches into the base, in radii."""
_MOST_REGIONS = 32


@dataclass
class RegionList:
    """Attributes:
    frame: of the base alone, so that it stays when regions move; the canonical frame of what is shown.
    poses: the ellipsoids by name, in the scene's order.
    meshes: regions that are no ellipsoids: shown, kept, and not to be changed here.
    taken: names of parts of earlier rounds.
    """

    frame: Normalisation
    poses: dict[str, EllipsoidPose] = field(default_factory=dict)
    meshes: dict[str, FocalRegion] = field(default_factory=dict)
    taken: tuple[str, ...] = ()

    @classmethod
    def of_scene(cls, scene: EditScene) -> RegionList:
        """The regions as the scene has them."""
        taken = tuple(name for part in scene.earlier for name in (part.name, part.shape))
        soup = scene.base_soup
        found = cls(Normalisation.of_points(soup.vertices[np.unique(soup.faces)]), taken=taken)
        back = np.linalg.inv(scene.frame.matrix())
        for region in scene.regions:
            if region.is_ellipsoid:
                matrix = back @ region.to_canonical
                pose = EllipsoidPose.of_matrix(region.name, matrix, region.part, region.mode)
                found.poses[region.name] = pose if region.prompt is None else replace(pose, **vars(region.prompt))
            else:
                found.meshes[region.name] = region.seen_from(found.frame.matrix() @ back)
        return found

    @property
    def names(self) -> list[str]:
        """Of all regions, ellipsoids first."""
        return [*self.poses, *self.meshes]

    def focal_regions(self) -> tuple[FocalRegion, ...]:
        """As `EditScene` has them, in `frame`."""
        matrix = self.frame.matrix()
        ellipsoids = []
        for pose in self.poses.values():
            own = PartPrompt(pose.prompt, pose.negative_prompt) if pose.prompt else None
            ellipsoids.append(FocalRegion(pose.name, matrix @ pose.matrix, pose.part, None, pose.mode, own))
        return (*ellipsoids, *self.meshes.values())

    def pose(self, name: str) -> EllipsoidPose:
        """The ellipsoid of that name; UserError for a mesh, or where there is none."""
        if name in self.meshes:
            raise UserError(f"region {name}: is a mesh; it can be changed in the scene file only")
        if name not in self.poses:
            raise UserError(f"region {name}: is not there any more")
        return self.poses[name]

    def put(self, pose: EllipsoidPose) -> None:
        """Replace the ellipsoid of the same name; a prompt is that of its part, so the part's other regions follow.

        Raises:
            UserError: no such ellipsoid, a radius that is not positive, a part that cannot be called so, a prompt that
                is far too long, or that contradicts a mesh of the same part.
        """
        before = self.pose(pose.name)
        if min(pose.radii) <= 0:
            raise UserError(f"region {pose.name}: a radius is not positive; enlarge it")
        if not is_part_name(pose.part) or pose.part.lower() in {name.lower() for name in self.taken}:
            raise UserError(
                f"part {pose.part!r}: is taken by an earlier round, or cannot name a file; use letters, digits, "
                "'_' and '-', and not 'base'"
            )
        self._share_prompt(pose, before)

    def _share_prompt(self, pose: EllipsoidPose, before: EllipsoidPose) -> None:
        """Put a region, with the prompt that its part has: the one that was just typed, else that of the others."""
        if fault := length_fault(pose.prompt):
            raise UserError(f"region {pose.name}: its prompt {fault}")
        others = [other for other in self.poses.values() if other.part == pose.part and other.name != pose.name]
        theirs = next((other for other in others if other.prompt), None)
        if pose.part != before.part and pose.prompt == before.prompt and theirs is not None:
            pose = replace(pose, prompt=theirs.prompt, negative_prompt=theirs.negative_prompt)
        if not pose.prompt:
            pose = replace(pose, negative_prompt="")
        mine = PartPrompt(pose.prompt, pose.negative_prompt)
        for mesh in self.meshes.values():
            if pose.prompt and mesh.part == pose.part and mesh.prompt not in (None, mine):
                raise UserError(
                    f"region {pose.name}: {mesh.name}, a mesh of the same part, has the prompt "
                    f"{mesh.prompt.prompt!r}; give the region another part"
                )
        self.poses[pose.name] = pose
        if pose.prompt != before.prompt or pose.part != before.part:
            for other in others:
                if other.prompt:
                    self.poses[other.name] = replace(
                        other, prompt=pose.prompt, negative_prompt=pose.negative_prompt
                    )  # fmt: skip

    def add(self, point: np.ndarray, normal: np.ndarray) -> EllipsoidPose:
        """A new ball that reaches a little into the base at a point (3,) of its surface, canonical frame.

        Its y axis is the surface's normal, so that the second radius is its height.
        """
        if len(self.names) >= _MOST_REGIONS:
            raise UserError(f"there are {_MOST_REGIONS} regions already; remove some")
        centre = self.frame.to_user(np.asarray(point) + (1 - _SUNK) * NEW_RADIUS * np.asarray(normal))
        radius = NEW_RADIUS / self.frame.scale
        like = next(iter(self.focal_regions()), None)
        pose = EllipsoidPose(
            free_name("region", self.names), vector(centre), turned_to(normal), (radius, radius, radius)
        )
        if like is not None:
            pose = replace(pose, part=like.part, mode=like.mode)
        self.poses[pose.name] = pose
        return pose

    def add_at(self, hit: Hit) -> EllipsoidPose:
        """`add` where a ray has met the base."""
        return self.add(hit.point, hit.normal)

    def remove(self, name: str) -> None:
        """Take an ellipsoid away; its part keeps its prompt. UserError for a mesh."""
        gone = self.pose(name)
        del self.poses[name]
        left = [pose for pose in self.poses.values() if pose.part == gone.part]
        if left and not any(pose.prompt for pose in left):
            words = {"prompt": gone.prompt, "negative_prompt": gone.negative_prompt}
            self.poses[left[0].name] = replace(left[0], **words)

    def mirror(self, name: str, axis: int) -> EllipsoidPose:
        """A copy on the other side of the base's middle, of the same part.

        Raises:
            UserError: the region lies on the middle, so that its image is itself.
        """
        pose = self.pose(name)
        image = pose.mirrored(free_name(f"{name}_mirrored", self.names), axis, float(self.frame.centre[axis]))
        if any(image.lies_on(other) for other in self.poses.values()):
            where = "lies on the base's middle, so its image is itself"
            if not image.lies_on(pose):
                where = "has its mirror image already"
            raise UserError(f"region {name}: {where}; move it aside, or mirror along another axis")
        self.poses[image.name] = image
        return image

    def restore(self, rows: Sequence[object], kept: Collection[str]) -> None:
        """The ellipsoids of a record in place of the scene's; ValueError, TypeError or KeyError for a damaged one."""
        poses = [EllipsoidPose.of_json(dict(row)) for row in rows]  # type: ignore[call-overload]
        names = [pose.name for pose in poses]
        if len(set(names)) < len(names) or set(kept) != set(self.meshes):
            raise ValueError("the regions do not fit the scene")
        self.poses = {pose.name: pose for pose in poses}
