"""The method `dreameditor`: a mesh of fixed topology whose vertices move where a map says that the edit is.

After the description of DreamEditor (arXiv 2306.13455). The object is a mesh that is extracted once. What the model
sees in views of the unedited object says which of its vertices belong to the edit; these alone are moved by score
distillation. No vertex and no face is ever added, so that whatever grows is drawn out of the surface that is there.

    v' = v + w(v) d(v),   d(v) = mlp(hash_grid(v)),   w = clamp((m(v) / max m - threshold) / RAMP, 0, 1)
    L = lambda_sds L_SDS + lambda_smooth mean over edges |w d - w' d'|^2 / |v - v'|^2

with m the mean over views of the map at a vertex. Deviates: the mesh comes from the base's signed distance, where the
original distils a neural field into one; bare shapes, so that no colour is learned; the model is not fitted to the
object first (DreamBooth).
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import torch
from pydantic import Field
from torch import Tensor, nn

from fd_mitsuba.baselines.edit_maps import MapSettings, edit_maps, map_source
from fd_mitsuba.baselines.fantasia3d import surface_error
from fd_mitsuba.baselines.guided_stage import GuidedStage
from fd_mitsuba.baselines.interface import BASELINES, EditedMesh, EditTask, mesh_images, to_world_space
from fd_mitsuba.baselines.vertex_map import vertex_values
from fd_mitsuba.baselines.voxels.fitting import fit_cameras
from fd_mitsuba.config import FieldConfig
from fd_mitsuba.config.bounds import Weight
from fd_mitsuba.errors import RunStopped
from fd_mitsuba.fields.hash_grid import HashGrid
from fd_mitsuba.fields.mlp import ColumnMlp
from fd_mitsuba.guidance.interface import Phase
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.training.descent import adamw, descend, fade
from fd_mitsuba.training.geometry_stage import EXPLODED_BEYOND, GeometryStage
from fd_mitsuba.training.loop import run_stage
from fd_mitsuba.training.seeds import Purpose, seed_for
from fd_mitsuba.training.stage import StepRecord
from fd_mitsuba.viewing.sheets import geometry_sheet

RAMP = 0.15
"""Of the map's largest value: how far above the threshold vertices move freely. Without it the mesh would fold."""


class DreameditorSettings(MapSettings):
    """Of `dreameditor`."""

    attention_time: Annotated[float, Field(gt=0, lt=1)] = 0.5
    """The noise level of the maps, as a share of all timesteps. They are made of the unedited object, in which the
    model sees what is not there yet under enough noise alone."""
    threshold: Annotated[float, Field(ge=0, le=0.8)] = 0.5
    """Vertices whose value on the map is above this share of the largest may move."""
    lambda_smooth: Weight = 0.1
    """Weight of the penalty on neighbours that move apart."""

    @property
    def needs(self) -> str:
        """As in `MapSettings`."""
        return "dreameditor needs a diffusion model that sees one whole image"


class MovedMesh(nn.Module):
    """A mesh of fixed topology, some of whose vertices a network moves.

    Args:
        vertices, faces: (V, 3) and (F, 3), canonical frame.
        weight: (V,) in [0, 1]: how freely each vertex moves; those of 0 stay as they are, to the byte.
        settings: of the network. seed: decides where it starts; nothing is moved then.

    Attributes:
        start: (V, 3) the vertices in the order of `forward`: those that stay come first.
        faces: (F, 3) of these; those that cannot move come first.
        fixed_vertices, fixed_faces: how many these are.
    """

    def __init__(self, vertices: Tensor, faces: Tensor, weight: Tensor, settings: FieldConfig, seed: int) -> None:
        super().__init__()
        order = torch.argsort((weight > 0).int(), stable=True)
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order))
        self.start, self.weight = vertices[order].float(), weight[order].float()
        self.fixed_vertices = int((weight <= 0).sum())
        renamed = place[faces]
        moves = (renamed >= self.fixed_vertices).any(dim=1)
        self.faces, self.fixed_faces = torch.cat([renamed[~moves], renamed[moves]]), int((~moves).sum())
        self.grid = HashGrid(
            settings.levels, settings.features, settings.base_resolution, settings.finest_resolution,
            settings.log2_table, seed,
        )  # fmt: skip
        self.mlp = ColumnMlp(self.grid.width, settings.hidden, 3, seed + 1)
        own = self.faces[self.fixed_faces :]
        ends = torch.cat([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]]).sort(dim=1).values.unique(dim=0)
        self._edges = ends
        self._length = (self.start[ends[:, 0]] - self.start[ends[:, 1]]).norm(dim=1).clamp(min=1e-6)

    def moves(self) -> Tensor:
        """(V - fixed_vertices, 3) how far the others are moved, canonical units; gradients flow to the network."""
        free = slice(self.fixed_vertices, None)
        return self.mlp(self.grid(self.start[free]).t()).t() * self.weight[free, None]

    def forward(self) -> Tensor:
        """(V, 3) the vertices where they are now; gradients flow to the network."""
        return torch.cat([self.start[: self.fixed_vertices], self.start[self.fixed_vertices :] + self.moves()])

    def loss_smooth(self, vertices: Tensor) -> Tensor:
        """Mean over the edges that can change of |difference of the ends' moves|^2 / length^2; gradients flow."""
        away = vertices - self.start
        apart = away[self._edges[:, 0]] - away[self._edges[:, 1]]
        return (apart.square().sum(dim=1) / self._length.square()).mean()


class VertexEditStage(GuidedStage):
    """A stage whose field is a `MovedMesh`; see `training.stage.Stage`.

    Args:
        own: our own method's stage of the same scene and settings, with its guidance: gives cameras, base, guidance.
        mesh: not moved yet.
        lambda_smooth: weight of `MovedMesh.loss_smooth`.
    """

    def __init__(self, own: GeometryStage, mesh: MovedMesh, lambda_smooth: float) -> None:
        super().__init__(own)
        self.field, self._lambda = mesh, lambda_smooth
        self.optimiser = adamw(mesh, self.config.geometry)
        self._passes: dict[Phase, GeometryPass] = {}

    def step(self, step: int) -> StepRecord:
        """Run step `step` and move the vertices once; RunStopped if a number is not finite."""
        phase, _, _ = self.own.phase_of(step)
        cameras, closeup = self.own.cameras(step)
        mesh, vertices = self.field, self.field()
        pictures = self._pass(phase).render(
            vertices,
            mesh.faces,
            torch.zeros(len(vertices)),
            cameras,
            seed_for(self.config.seed, Purpose.PIXELS, step),
            static_faces=mesh.fixed_faces,
            static_vertices=mesh.fixed_vertices,
        )
        result = self.own.ask(pictures, cameras, closeup, step)
        losses = {"sds": result.loss, "smooth": mesh.loss_smooth(vertices)}
        weights = {"sds": self.config.geometry.lambda_sds, "smooth": self._lambda}
        remedy = "lower geometry.learning_rate or guidance.guidance_scale"
        fade(self.optimiser, self.config.geometry, step)
        values = result.logs | descend(self.optimiser, losses, weights, step, remedy)
        return StepRecord(values, partial(geometry_sheet, pictures.detach(), result.preview))

    @torch.no_grad()
    def check_field(self, step: int) -> dict[str, float]:
        """How far the vertices were moved at most; RunStopped where that is no shape any more."""
        furthest = float(self.field.moves().norm(dim=1).max())
        if not furthest < EXPLODED_BEYOND:
            raise RunStopped(f"step {step}: the mesh exploded; lower geometry.learning_rate")
        return {"furthest_move": furthest}

    def _pass(self, phase: Phase) -> GeometryPass:
        if phase not in self._passes:
            self._passes = {phase: self.own.new_pass(phase)}
        return self._passes[phase]


@BASELINES.register("dreameditor", DreameditorSettings)
def dreameditor(settings: DreameditorSettings, task: EditTask) -> EditedMesh:
    """DreamEditor: the base as a mesh of fixed topology, whose vertices move where a map of the edit says so."""
    source, surface = map_source(task, settings), task.own.base_surface
    vertices, faces = surface.vertices.detach(), surface.faces

    def shown(cameras: CameraBatch, size: int) -> tuple[Tensor, Tensor]:
        images = mesh_images((vertices, faces), cameras, size)
        in_world = task.config.geometry.normal_space == "world"
        return to_world_space(images.values, cameras) if in_world else images.values, images.mask

    cameras = fit_cameras(settings.attention_views, task.config.cameras.elevation_deg)
    maps = edit_maps(task, settings, source, shown, cameras)
    weight = move_weights(vertex_values(vertices, faces, maps[:, 0], cameras), settings.threshold)
    seed = seed_for(task.config.seed, Purpose.FIELD)
    mesh = MovedMesh(vertices, faces, weight, task.config.field, seed)
    stage = VertexEditStage(task.own, mesh, settings.lambda_smooth)
    run_stage(stage, task.folder, True, task.quiet, task.say)
    with torch.no_grad():
        moved = mesh()
    fit = {"fit_cells": surface_error(task.own, vertices), "moved_share": float((weight > 0).float().mean())}
    edited = EditedMesh(task.scene, (moved, mesh.faces), fit)
    edited.guidance_calls = stage.steps + source.calls(settings.attention_views)
    return edited


def move_weights(values: Tensor, threshold: float) -> Tensor:
    """w(v) of the formula above, of a map's values (V,) at the vertices."""
    return ((values / values.max().clamp(min=1e-12) - threshold) / RAMP).clamp(0, 1)
