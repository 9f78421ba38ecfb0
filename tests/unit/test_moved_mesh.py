"""A mesh of fixed topology: what may not move stays to the byte, what may goes where the loss wants it."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.baselines.dreameditor import RAMP, MovedMesh, move_weights
from fd_mitsuba.baselines.vertex_map import seen_vertices, vertex_values
from fd_mitsuba.config import FieldConfig
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.views import CameraBatch

SPHERE = trimesh.creation.icosphere(3, 0.6)
VERTICES = torch.from_numpy(np.asarray(SPHERE.vertices, np.float32))
FACES = torch.from_numpy(np.asarray(SPHERE.faces, np.int64))
WEIGHT = ((VERTICES[:, 1] - 0.3) / 0.1).clamp(0, 1)
AROUND = CameraBatch.around(np.arange(4) * 90.0, 10.0, 3.0, 45.0)
NETWORK = FieldConfig(levels=4, finest_resolution=16, log2_table=12)


def capped() -> MovedMesh:
    return MovedMesh(VERTICES, FACES, WEIGHT, NETWORK, 0)


def pictures(mesh: MovedMesh, vertices: torch.Tensor, spp: int = 4, seed: int = 0) -> torch.Tensor:
    render = GeometryPass(32, spp, spp)
    return render.render(
        vertices, mesh.faces, torch.zeros(len(vertices)), AROUND, seed, mesh.fixed_faces, mesh.fixed_vertices
    )


def test_it_starts_as_the_mesh_that_it_is_given() -> None:
    mesh = capped()
    assert mesh.fixed_vertices == int((VERTICES[:, 1] <= 0.3).sum()) and len(mesh.faces) == len(FACES)
    made = trimesh.Trimesh(mesh().detach().numpy(), mesh.faces.numpy(), process=False)
    assert made.volume == pytest.approx(SPHERE.volume, rel=1e-6) and made.is_watertight
    assert (mesh.faces[: mesh.fixed_faces] < mesh.fixed_vertices).all()
    assert (mesh.faces[mesh.fixed_faces :] >= mesh.fixed_vertices).any(dim=1).all()


def test_a_masked_cap_moves_towards_a_target_and_the_rest_stays_to_the_byte(mi: object) -> None:
    mesh = capped()
    target = mesh.start.clone()
    target[:, 1] += 0.3 * mesh.weight
    with torch.no_grad():
        wanted = pictures(mesh, target)
    optimiser = torch.optim.Adam(mesh.parameters(), lr=1e-2)
    for step in range(25):
        vertices = mesh()
        loss = (pictures(mesh, vertices, seed=step) - wanted)[:, :4].square().mean()
        optimiser.zero_grad()
        (loss + 1e-3 * mesh.loss_smooth(vertices)).backward()
        optimiser.step()
    made = mesh().detach()
    fixed = mesh.fixed_vertices
    assert torch.equal(made[:fixed].view(torch.int32), mesh.start[:fixed].view(torch.int32))
    away = (made - target)[fixed:].norm(dim=1)
    assert away.mean() < 0.35 * (mesh.start - target)[fixed:].norm(dim=1).mean()
    assert made[:, 1].max() == pytest.approx(0.9, abs=0.06)


def test_the_gradient_of_a_picture_loss_equals_finite_differences(mi: object) -> None:
    mesh = capped()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        mesh.mlp.weight_out.copy_(0.02 * torch.randn(mesh.mlp.weight_out.shape, generator=generator))
        mesh.grid.table.copy_(0.3 * torch.randn(mesh.grid.table.shape, generator=generator))
    ramp = torch.linspace(0, 1, 32).view(1, 1, -1, 1)  # downwards
    along = torch.randn(mesh.mlp.weight_out.shape, generator=generator)
    along[1] += 2.0

    def value() -> torch.Tensor:
        return (pictures(mesh, mesh(), 64)[:, 3:4] * ramp).sum()

    value().backward()
    wanted, weight = float((mesh.mlp.weight_out.grad * along).sum()), mesh.mlp.weight_out.detach()
    start, found = weight.clone(), []
    for move in (1e-2, -1e-2):
        weight.copy_(start + move * along)
        with torch.no_grad():
            found.append(float(value()))
    assert (found[0] - found[1]) / 2e-2 == pytest.approx(wanted, rel=0.08) and abs(wanted) > 1


def test_neighbours_that_move_together_cost_nothing() -> None:
    mesh = capped()
    assert mesh.loss_smooth(mesh.start + torch.tensor([0.1, 0.2, 0.3])).item() == pytest.approx(0, abs=1e-9)
    # Every edge is half as long again: |difference|^2 / length^2 is a quarter.
    assert mesh.loss_smooth(1.5 * mesh.start).item() == pytest.approx(0.25, rel=1e-4)


def test_a_camera_sees_the_vertices_that_face_it(mi: object) -> None:
    """Closed form for a ball: those with n (eye - v) > 0; not those behind another ball."""
    seen = seen_vertices(VERTICES, FACES, AROUND)
    eye = torch.from_numpy(np.array(AROUND.position))
    facing = (VERTICES[None] * (eye[:, None] - VERTICES[None])).sum(dim=2)
    clear = facing.abs() > 0.25  # near its outline it matters that the ball has faces
    assert torch.equal(seen[clear], facing[clear] > 0)
    hiding = torch.cat([VERTICES, 0.3 * VERTICES])
    hidden = seen_vertices(hiding, torch.cat([FACES, FACES + len(VERTICES)]), AROUND)
    assert not hidden[:, len(VERTICES) :].any()


def test_maps_come_onto_the_vertices_that_are_seen(mi: object) -> None:
    upper = torch.zeros(4, 32, 32)
    upper[:, :16] = 1
    values = vertex_values(VERTICES, FACES, upper, AROUND)
    assert (values[VERTICES[:, 1] > 0.25] == 1).all() and (values[VERTICES[:, 1] < -0.25] == 0).all()
    front = torch.zeros(4, 32, 32)
    front[0] = 1
    values = vertex_values(VERTICES, FACES, front, AROUND)
    assert values[VERTICES[:, 2].argmax()] == 1 and values[VERTICES[:, 2].argmin()] == 0
    weights = move_weights(torch.tensor([0.0, 0.4, 0.4 + 0.8 * RAMP / 2, 0.8]), 0.5)
    assert weights.tolist() == pytest.approx([0.0, 0.0, 0.5, 1.0], abs=1e-6)
