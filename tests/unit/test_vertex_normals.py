from __future__ import annotations

import torch
import trimesh

from fd_mitsuba.render.vertex_normals import area_sums, vertex_normals


def bumpy_ball() -> tuple[torch.Tensor, torch.Tensor]:
    ball = trimesh.creation.icosphere(subdivisions=2)
    noise = torch.randn(len(ball.vertices), 3, generator=torch.Generator().manual_seed(0))
    return torch.from_numpy(ball.vertices).float() + 0.05 * noise, torch.from_numpy(ball.faces).long()


def autograd_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    corners = vertices[faces]
    normal = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return torch.nn.functional.normalize(torch.zeros_like(vertices).index_add(0, faces.T.ravel(), normal.repeat(3, 1)))


def test_normals_and_their_gradient_are_those_of_automatic_differentiation() -> None:
    vertices, faces = bumpy_ball()
    weights = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(1))
    ours, exact = vertices.clone().requires_grad_(), vertices.double().requires_grad_()
    found, expected = vertex_normals(ours, faces), autograd_normals(exact, faces)
    torch.testing.assert_close(found, expected.float(), rtol=1e-5, atol=1e-5)
    (found * weights).sum().backward()
    (expected * weights).sum().backward()
    torch.testing.assert_close(ours.grad, exact.grad.float(), rtol=1e-4, atol=1e-4)


def test_faces_that_stay_are_summed_once() -> None:
    vertices, faces = bumpy_ball()
    fixed = (faces < 80).all(dim=1)
    sums = area_sums(vertices[:80], faces[fixed])
    weights = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(1))
    whole, split = vertices.clone().requires_grad_(), vertices.clone().requires_grad_()
    expected, found = vertex_normals(whole, faces), vertex_normals(split, faces[~fixed], sums)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    (expected * weights).sum().backward()
    (found * weights).sum().backward()
    torch.testing.assert_close(split.grad[80:], whole.grad[80:], rtol=1e-4, atol=1e-4)


def test_a_vertex_without_area_has_no_normal_and_no_gradient() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 5, 5]], requires_grad=True)
    normals = vertex_normals(vertices, torch.tensor([[0, 1, 2]]))
    normals.sum().backward()
    assert not normals.any() and not vertices.grad.any()
