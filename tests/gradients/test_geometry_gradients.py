"""Gradients of the geometry pass against central finite differences and against other ways to compute them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.backend import startup

startup.start()

import drjit as dr  # noqa: E402
import mitsuba as mi  # noqa: E402
from skimage.measure import marching_cubes  # noqa: E402

from fd_mitsuba.backend import bridge  # noqa: E402
from fd_mitsuba.conventions import GEOMETRY_CHANNELS  # noqa: E402
from fd_mitsuba.render.geometry_pass import GeometryPass  # noqa: E402
from fd_mitsuba.render.vertex_normals import vertex_normals  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

SIZE = 32
STEP = 0.01
Mesh = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
Motion = Callable[[torch.Tensor], torch.Tensor]
ONE_VIEW = CameraBatch.around(np.array([20.0]), 15.0, 3.0, 40.0)
AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}


def sphere(subdivisions: int = 3, radius: float = 0.5, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    vertices = torch.tensor(mesh.vertices + np.array(centre), dtype=torch.float32)
    return vertices, torch.tensor(mesh.faces), torch.sigmoid(10 * vertices[:, 0])


def union(cells: int = 24, offset: float = 0.4) -> Mesh:
    """Two overlapping balls as one surface; the part weight rises smoothly to 1 on the smaller one."""
    axis = np.linspace(-1, 1, cells)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    field = np.maximum(0.5 - np.sqrt(x**2 + y**2 + z**2), 0.3 - np.sqrt((x - offset) ** 2 + (y - 0.3) ** 2 + z**2))
    vertices, faces, _, _ = marching_cubes(field, 0.0)
    points = torch.tensor(vertices / (cells - 1) * 2 - 1, dtype=torch.float32)
    triangles = torch.tensor(faces.astype(np.int64))
    a, b, c = points[triangles].unbind(1)
    if (torch.linalg.cross(a, b) * c).sum() < 0:
        triangles = triangles.flip(1)
    depth = 0.3 - (points - torch.tensor([offset, 0.3, 0.0])).norm(dim=1)
    return points, triangles, torch.sigmoid(20 * (depth + 0.1))


def two_balls(distance: float) -> Mesh:
    """A ball (part weight 1) at `distance` towards the camera from a larger one (0), over its outline."""
    towards = ONE_VIEW.position[0] / np.linalg.norm(ONE_VIEW.position[0]) * distance
    right = ONE_VIEW.basis()[0][0]
    large, large_faces, _ = sphere(3, 0.5)
    small, small_faces, _ = sphere(2, 0.25, tuple(towards + 0.4 * right * (3 - distance) / 3))
    faces = torch.cat([large_faces, small_faces + len(large)])
    return torch.cat([large, small]), faces, torch.cat([torch.zeros(len(large)), torch.ones(len(small))])


def assert_gradient(
    mesh: Mesh, motion: Motion, channels: tuple[str, ...] = GEOMETRY_CHANNELS, size: int = SIZE, reach: float = 0.1
) -> None:
    """Every channel's derivative along a motion is within 3 % of central differences with common random numbers.

    The loss compares with the picture after a finite motion, so that it does change, whatever the channel.
    """
    _, faces, weight = mesh
    quiet = GeometryPass(size, spp=1)

    def picture(amount: float, spp: int) -> torch.Tensor:
        return quiet.render_primal(motion(torch.tensor(amount)), faces, weight, ONE_VIEW, seed=5, spp=spp)[0]

    towards = picture(reach, 256) - picture(-reach, 256)
    reference = ((picture(STEP, 2048) - picture(-STEP, 2048)) * towards).sum((1, 2)) / (2 * STEP)
    total = torch.zeros(len(GEOMETRY_CHANNELS))
    rounds = 2
    for seed in range(rounds):
        amount = torch.zeros((), requires_grad=True)
        image = GeometryPass(size, spp=256, silhouette_spp=64).render(motion(amount), faces, weight, ONE_VIEW, seed)[0]
        losses = (image * towards).sum((1, 2))
        for channel, loss in enumerate(losses):
            total[channel] += torch.autograd.grad(loss, amount, retain_graph=True)[0] / rounds
    largest = reference.abs().max()
    for channel, name in enumerate(GEOMETRY_CHANNELS):
        if name in channels:
            error = (total[channel] - reference[channel]).abs() / max(reference[channel].abs(), 0.05 * largest)
            assert error < 0.03, f"{name}: {total[channel]:.3f} instead of {reference[channel]:.3f}"


@pytest.mark.parametrize("axis", AXES)
def test_translation_of_a_sphere(axis: str) -> None:
    mesh = sphere()
    assert_gradient(mesh, lambda t: mesh[0] + t * torch.tensor(AXES[axis]))


def test_scale_of_a_sphere() -> None:
    mesh = sphere()
    assert_gradient(mesh, lambda t: mesh[0] * (1 + t))


@pytest.mark.parametrize("axis", AXES)
def test_translation_of_a_union(axis: str) -> None:
    mesh = union()
    assert_gradient(mesh, lambda t: mesh[0] + t * torch.tensor(AXES[axis]))


def test_scale_of_a_union() -> None:
    mesh = union()
    assert_gradient(mesh, lambda t: mesh[0] * (1 + t))


@pytest.mark.parametrize("axis", AXES)
def test_only_the_part_of_a_union_moves(axis: str) -> None:
    mesh = union()
    assert_gradient(mesh, lambda t: mesh[0] + t * mesh[2][:, None] * torch.tensor(AXES[axis]))


@pytest.mark.parametrize("distance", [1.0, -1.0], ids=["part in front", "part behind"])
@pytest.mark.parametrize("moving", [1.0, 0.0], ids=["part moves", "base moves"])
def test_one_piece_hides_another(distance: float, moving: float) -> None:
    mesh = two_balls(distance)
    selected = (mesh[2] == moving).float()[:, None]
    assert_gradient(mesh, lambda t: mesh[0] + t * selected * torch.tensor([1.0, 0.3, 0.0]), reach=0.05)


def test_a_single_vertex() -> None:
    mesh = sphere(1)
    right, up, _ = (axis[0] for axis in ONE_VIEW.basis())
    outwards = torch.tensor(right + 0.3 * up)
    vertex = int((mesh[0] @ outwards).argmax())
    selected = torch.nn.functional.one_hot(torch.tensor(vertex), len(mesh[0])).float()[:, None]
    assert_gradient(mesh, lambda t: mesh[0] + t * selected * outwards)


def test_part_weight() -> None:
    """The picture is linear in the part weight, so one difference is exact."""
    vertices, faces, weight = union()
    view = GeometryPass(SIZE, spp=16)
    direction = torch.rand(len(weight), generator=torch.Generator().manual_seed(1))
    attached = weight.clone().requires_grad_()
    pattern = torch.rand(1, 5, SIZE, SIZE, generator=torch.Generator().manual_seed(2))
    (view.render(vertices, faces, attached, ONE_VIEW, 3) * pattern).sum().backward()
    before, after = (view.render(vertices, faces, w, ONE_VIEW, 3) for w in (weight, weight + direction))
    change = after - before
    torch.testing.assert_close((attached.grad * direction).sum(), (change * pattern).sum(), rtol=1e-4, atol=1e-3)


def test_without_outline_points_the_mask_has_no_gradient() -> None:
    vertices, faces, weight = sphere()
    attached = vertices.clone().requires_grad_()
    GeometryPass(SIZE, silhouette_spp=0).render(attached, faces, weight, ONE_VIEW, 0)[:, 3].sum().backward()
    assert torch.count_nonzero(attached.grad) == 0


# The same gradient by other ways


def gradient(view: GeometryPass, mesh: Mesh, cameras: CameraBatch, seed: int, **more: int) -> tuple[torch.Tensor, ...]:
    vertices, weight = mesh[0].clone().requires_grad_(), mesh[2].clone().requires_grad_()
    image = view.render(vertices, mesh[1], weight, cameras, seed, **more)
    pattern = torch.linspace(-1, 1, view.size) + torch.linspace(0.2, 1.5, view.size)[:, None]
    (image * pattern).sum().backward()
    return image.detach(), vertices.grad, weight.grad


def assert_same(first: tuple[torch.Tensor, ...], second: tuple[torch.Tensor, ...]) -> None:
    for a, b in zip(first, second, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4 * float(b.abs().max()))


FOUR_VIEWS = CameraBatch.around(np.array([20.0, 110.0, 200.0, 300.0]), np.array([15.0, -5.0, 30.0, 45.0]), 3.0, 40.0)


def single(view: int) -> CameraBatch:
    names = ("position", "target", "fov_deg", "azimuth_deg", "elevation_deg")
    return CameraBatch(**{name: getattr(FOUR_VIEWS, name)[view : view + 1] for name in names})


def test_views_add_up() -> None:
    mesh, view = union(), GeometryPass(SIZE)
    image, vertices, weight = gradient(view, mesh, FOUR_VIEWS, 10)
    parts = [gradient(view, mesh, single(b), 10 + b) for b in range(4)]
    assert_same((image,), (torch.cat([part[0] for part in parts]),))
    assert_same((vertices, weight), (sum(part[1] for part in parts), sum(part[2] for part in parts)))


def test_a_changed_topology_gives_the_gradient_of_a_new_object() -> None:
    old, first, second = GeometryPass(SIZE), union(20), union(27, offset=0.3)
    for mesh in (first, second, sphere(), second, first):
        assert_same(gradient(old, mesh, FOUR_VIEWS, 4), gradient(GeometryPass(SIZE), mesh, FOUR_VIEWS, 4))


def test_backward_after_the_scene_has_moved_on() -> None:
    view, mesh, other = GeometryPass(SIZE), union(), sphere()
    expected = gradient(view, mesh, FOUR_VIEWS, 1)
    vertices = mesh[0].clone().requires_grad_()
    pattern = torch.linspace(-1, 1, SIZE) + torch.linspace(0.2, 1.5, SIZE)[:, None]
    loss = (view.render(vertices, mesh[1], mesh[2], FOUR_VIEWS, 1) * pattern).sum()
    view.render(other[0], other[1], other[2], FOUR_VIEWS, 2)
    loss.backward(retain_graph=True)
    assert_same((vertices.grad,), (expected[1],))
    vertices.grad = None
    loss.backward()
    assert_same((vertices.grad,), (expected[1],))


def test_static_faces_change_nothing() -> None:
    vertices, faces, weight = union()
    order = torch.argsort(weight, stable=True)  # vertices, then faces, with the part at the end
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    vertices, weight, faces = vertices[order], weight[order], place[faces]
    far = weight[faces].amax(1) < 0.3
    faces, static = torch.cat([faces[far], faces[~far]]), int(far.sum())
    assert 0.3 < static / len(faces) < 0.9
    view = GeometryPass(SIZE)
    for step in range(3):
        moved = vertices + 0.05 * step * (weight > 0.3).float()[:, None]
        moved[faces[:static].unique()] = vertices[faces[:static].unique()]
        mesh = (moved, faces, weight)
        expected = gradient(GeometryPass(SIZE), mesh, FOUR_VIEWS, 4)
        assert_same(gradient(view, mesh, FOUR_VIEWS, 4, static_faces=static), expected)
        constant = int(faces[:static].max()) + 1
        image, of_vertices, of_weight = gradient(
            view, mesh, FOUR_VIEWS, 4, static_faces=static, static_vertices=constant
        )
        assert_same((image, of_vertices[constant:], of_weight), (expected[0], expected[1][constant:], expected[2]))
    assert view.static_builds == 1
    mesh = (vertices * 0.9, faces, weight)  # a broken promise
    expected = gradient(GeometryPass(SIZE), mesh, FOUR_VIEWS, 4)
    assert_same(gradient(view, mesh, FOUR_VIEWS, 4, static_faces=static), expected)
    assert view.static_builds == 2


def test_torch_and_dr_jit_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, view, calls = union(), GeometryPass(SIZE), []
    original = bridge.differentiable

    def record(function: bridge.DrJitFunction, *tensors: torch.Tensor) -> torch.Tensor:
        calls.append((function, tensors))
        return original(function, *tensors)

    monkeypatch.setattr(bridge, "differentiable", record)
    image, vertices, weight = gradient(view, mesh, FOUR_VIEWS, 9)
    function, tensors = calls[0]
    inputs = [bridge.to_drjit(tensor) for tensor in tensors]
    dr.enable_grad(inputs)
    output = function(*inputs)
    pattern = torch.linspace(-1, 1, SIZE) + torch.linspace(0.2, 1.5, SIZE)[:, None]
    dr.backward(dr.sum(output * bridge.to_drjit(pattern.expand(5, 4, SIZE, SIZE))))
    assert_same((image.transpose(0, 1).reshape(-1),), (bridge.to_torch(dr.detach(output)),))
    direct, of_weight, of_normals = (bridge.to_torch(dr.grad(array)) for array in inputs)
    attached = mesh[0].clone().requires_grad_()
    (through_normals,) = torch.autograd.grad(vertex_normals(attached, mesh[1]), attached, of_normals.view(-1, 3))
    assert_same((vertices, weight), (direct.view(-1, 3) + through_normals, of_weight))


# Steadiness


@pytest.fixture
def one_thread() -> Iterator[None]:
    before = dr.thread_count()
    dr.set_thread_count(1)
    yield
    dr.set_thread_count(before)


def test_same_seed_same_bytes(one_thread: None) -> None:
    mesh = union()
    first, again, other = (gradient(GeometryPass(SIZE), mesh, FOUR_VIEWS, seed) for seed in (3, 3, 4))
    for a, b, c in zip(first, again, other, strict=True):
        assert torch.equal(a, b) and not torch.equal(a, c)


def test_nothing_is_compiled_after_the_first_steps() -> None:
    meshes, view = [union(cells) for cells in (16, 19, 22, 25, 17, 20)], GeometryPass(24)
    for step in range(3):
        gradient(view, meshes[step], FOUR_VIEWS, step)
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for step in range(18):
            gradient(view, meshes[step % 6], FOUR_VIEWS, 100 * step, static_faces=0)
        kernels = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    dr.kernel_history_clear()
    assert len(kernels) > 100
    assert [entry["operation_count"] for entry in kernels if not entry["cache_hit"]] == []


def resident_megabytes() -> float:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


@pytest.mark.parametrize(("steps", "limit"), [(60, 15.0), pytest.param(1000, 50.0, marks=pytest.mark.slow)])
def test_memory_stays(steps: int, limit: float) -> None:
    meshes, view = [union(cells) for cells in range(14, 26)], GeometryPass(24)
    for step in range(36):
        gradient(view, meshes[step % 12], FOUR_VIEWS, step)
    before = resident_megabytes()
    for step in range(steps):
        gradient(view, meshes[step % 12], FOUR_VIEWS, step)
        if step % 3 == 0:  # pictures that nobody differentiates must be freed too
            view.render(meshes[0][0].clone().requires_grad_(), meshes[0][1], meshes[0][2], FOUR_VIEWS, step)
    assert resident_megabytes() - before < limit


def test_the_bridge_leaves_torch_free_to_write_in_place() -> None:
    tensor = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    result = bridge.differentiable(lambda x: x * x, tensor)
    with torch.no_grad():
        tensor.mul_(10)
    result.sum().backward()
    assert torch.equal(result.detach(), torch.tensor([1.0, 4.0, 9.0]))
    assert torch.equal(tensor.grad, torch.tensor([2.0, 4.0, 6.0]))


def test_the_bridge_keeps_shape_and_dtype_and_takes_parameters() -> None:
    parameter = torch.nn.Parameter(torch.ones(2, 3, dtype=torch.float64))
    constant = torch.full((6,), 2.0)
    bridge.differentiable(lambda x, y: x * y, parameter, constant).sum().backward()
    assert parameter.grad.dtype == torch.float64 and torch.equal(parameter.grad, torch.full((2, 3), 2.0).double())
    assert constant.grad is None


def test_an_unused_input_has_zero_gradient() -> None:
    used, unused = torch.ones(2, requires_grad=True), torch.ones(3, requires_grad=True)
    bridge.differentiable(lambda x, y: 3 * x + mi.Float(0), used, unused).sum().backward()
    assert torch.equal(unused.grad, torch.zeros(3)) and torch.equal(used.grad, torch.full((2,), 3.0))
