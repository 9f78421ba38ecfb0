"""What every system that is compared takes and gives: a task in; images from any camera out, a mesh where it has one.

An entry of `BASELINES` is called with its own settings and an `EditTask`, and returns an `EditedObject`. All of them
ask the one guidance of the task, so that model, prompt, views and number of calls are the same for all.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from fd_mitsuba.config import RunConfig
from fd_mitsuba.config.registry import Registry
from fd_mitsuba.errors import UserError
from fd_mitsuba.guidance.interface import Guidance, GuidanceResult
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.runs.geometry_outcome import prepare_geometry
from fd_mitsuba.runs.own_meshes import base_mesh
from fd_mitsuba.scene.edit_scene import EditScene
from fd_mitsuba.scene.triangle_mesh import TriangleMesh
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.geometry_stage import GeometryStage

IMAGE_SPP = 9
"""Samples a pixel, a side of 3, of the images that methods are compared by."""

ImageKind = Literal["normals", "colour"]


@dataclass(frozen=True)
class EditedImages:
    """N views of an object.

    Attributes:
        kind: `normals`: camera-space normals times coverage in [-1, 1]; `colour`: sRGB in [0, 1].
        values: (N, 3, S, S).
        mask: (N, 1, S, S) coverage of the object in [0, 1].
    """

    kind: ImageKind
    values: Tensor
    mask: Tensor

    @property
    def rgb(self) -> Tensor:
        """(N, 3, S, S) in [0, 1]: colours as they are, normals as (n + 1) / 2 on black."""
        return self.values.clamp(0, 1) if self.kind == "colour" else ((self.values + self.mask) / 2).clamp(0, 1)


class CountedGuidance:
    """A guidance that counts how often it is asked; everything else is the inner one's."""

    def __init__(self, inner: Guidance) -> None:
        self.inner, self.calls = inner, 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self.inner, name)

    def guide(self, *views: Any, **settings: Any) -> GuidanceResult:
        """`Guidance.guide` of the inner one."""
        self.calls += 1
        return self.inner.guide(*views, **settings)


@dataclass
class EditTask:
    """One scene to edit by one method.

    Attributes:
        scene: what to edit; adds parts.
        config: how: the budget (`geometry.steps`), guidance, cameras and seed count for every method.
        folder: where a method may keep checkpoints; below it nothing else is written.
        say: takes log lines.
        quiet: no progress display.
    """

    scene: EditScene
    config: RunConfig
    folder: Path
    say: Callable[[str], None] = print
    quiet: bool = True
    extra_calls: int = 0
    """Calls of the network that do not go through `guide`, as methods that sample images count them."""
    _given: Guidance | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.scene.subtracts:
            raise UserError(
                f"{self.scene.path}: cuts something out of its base, as focaldreamer alone can; compare scenes that add"
            )

    @cached_property
    def guidance(self) -> CountedGuidance:
        """The settings' guidance with the scene's prompts; loaded when it is first asked for.

        Raises:
            UserError: a model that cannot be loaded; `geometry.lambda_sds = 0`, which leaves nothing to compare.
        """
        found = prepare_geometry(self.scene, self.config, self.say, self._given)
        if found is None:
            raise UserError("geometry.lambda_sds = 0: nothing guides the methods to compare; give it a weight")
        return CountedGuidance(found)

    @cached_property
    def own(self) -> GeometryStage:
        """Our own method's stage, not trained: the cameras of every step, the base, and the way to ask the guidance.

        Nothing is drafted: the other methods are guided at every step.
        """
        guidance: Any = self.guidance  # what it does not count is the inner one's
        geometry = self.config.geometry.model_copy(update={"draft_fraction": 0.0})
        return GeometryStage(self.scene, self.config.model_copy(update={"geometry": geometry}), guidance)

    @property
    def guidance_calls(self) -> int:
        """How often the guidance was asked by this process."""
        asked = self.guidance.calls if "guidance" in self.__dict__ else 0
        return asked + self.extra_calls


class EditedObject(ABC):
    """What a method made of a scene.

    Attributes:
        scene: what it was made of.
        fit: what the method's own representation loses of the base before any edit, by name; empty where nothing.
        guidance_calls: how often the guidance was asked for it, in all processes that worked on it; None: it counts
            what the task has counted.
    """

    def __init__(self, scene: EditScene, fit: dict[str, float] | None = None) -> None:
        self.scene, self.fit = scene, fit or {}
        self.guidance_calls: int | None = None

    @abstractmethod
    def images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """Images (N, 3, size, size) of the edited object from any cameras, canonical frame; no gradients."""

    def base_images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """The unedited base as `images` shows it: its own mesh, not what a method fitted to it."""
        return mesh_images(base_mesh(self.scene), cameras, size)

    @property
    def mesh(self) -> TriangleMesh | None:
        """The edited object's surface, canonical frame; None where a method has none."""
        return None


class EditedMesh(EditedObject):
    """An edit whose outcome is a triangle mesh.

    Args:
        shown: vertices (V, 3) float32 and faces (F, 3), canonical frame, not necessarily welded.
    """

    def __init__(self, scene: EditScene, shown: tuple[Tensor, Tensor], fit: dict[str, float] | None = None) -> None:
        super().__init__(scene, fit)
        self._shown = shown

    def images(self, cameras: CameraBatch, size: int) -> EditedImages:
        """Ray traced, as `base_images`."""
        return mesh_images(self._shown, cameras, size)

    @property
    def mesh(self) -> TriangleMesh | None:
        """What is shown; None where nothing is left."""
        vertices, faces = self._shown
        return TriangleMesh("edited", vertices.numpy(), faces.numpy()) if len(faces) else None


BASELINES: Registry[Callable[[Any, EditTask], EditedObject]] = Registry("baselines", "method")
"""Called with their settings and the task."""


@torch.no_grad()
def mesh_images(mesh: tuple[Tensor, Tensor], cameras: CameraBatch, size: int) -> EditedImages:
    """Camera-space normals of a canonical mesh (vertices, faces)."""
    vertices, faces = mesh
    found = GeometryPass(size, IMAGE_SPP, silhouette_spp=0).render_primal(
        vertices.float(), faces, torch.zeros(len(vertices)), cameras, seed=0
    )
    return EditedImages("normals", found[:, :3], found[:, 3:4])


def to_camera_space(normals: Tensor, cameras: CameraBatch) -> Tensor:
    """World-space vectors (N, 3, S, S), a view each, as the cameras see them: x right, y up, z to the viewer."""
    axes = torch.from_numpy(np.stack(cameras.basis(), axis=1)).to(normals.dtype)
    return torch.einsum("nij,njhw->nihw", axes, normals)


def to_world_space(normals: Tensor, cameras: CameraBatch) -> Tensor:
    """The inverse of `to_camera_space`."""
    axes = torch.from_numpy(np.stack(cameras.basis(), axis=1)).to(normals.dtype)
    return torch.einsum("nji,njhw->nihw", axes, normals)
