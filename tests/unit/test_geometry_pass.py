"""What geometry pictures show, what the pass refuses, and the edges it builds."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch
import trimesh

from fd_mitsuba.backend import startup

mi = startup.start()

from fd_mitsuba.backend.upload import upload_floats, upload_indices  # noqa: E402
from fd_mitsuba.render.cameras import FilmCameras  # noqa: E402
from fd_mitsuba.render.enclosing import is_closed, is_outside  # noqa: E402
from fd_mitsuba.render.geometry_pass import GeometryPass  # noqa: E402
from fd_mitsuba.render.mesh_edges import corners, pair_closed, pair_half_edges  # noqa: E402
from fd_mitsuba.render.silhouette import find_outline  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

Mesh = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def views(*azimuth: float, elevation: float = 0.0, radius: float = 3.0, fov: float = 40.0) -> CameraBatch:
    return CameraBatch.around(np.array(azimuth or (0.0,)), elevation, radius, fov)


def ball(subdivisions: int = 4, radius: float = 0.5, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    vertices = torch.tensor(mesh.vertices + np.array(centre), dtype=torch.float32)
    return vertices, torch.tensor(mesh.faces), (vertices[:, 0] > centre[0]).float()


# What is shown


def test_a_ball_covers_the_area_that_geometry_says() -> None:
    picture = GeometryPass(48).render_primal(*ball(), views(), 0, spp=64)[0]
    radius_in_pixels = 24 * np.tan(np.arcsin(0.5 / 3)) / np.tan(np.radians(20))
    assert float(picture[3].sum()) == pytest.approx(np.pi * radius_in_pixels**2, rel=0.005)
    assert picture[3].max() == 1 and picture[:, 0, 0].abs().max() == 0
    assert float(picture[4].sum() / picture[3].sum()) == pytest.approx(0.5, abs=0.03)


def test_directions_in_camera_space() -> None:
    """Right is x, up is row 0, and what faces the camera has z = 1, from every side."""
    for picture in GeometryPass(33).render_primal(*ball(), views(0, 90, 200, elevation=25), 0, spp=16):
        normal, middle = picture[:3], 16
        assert normal[2, middle, middle] > 0.99
        assert normal[0, middle, 22] > 0.6 > -0.6 > normal[0, middle, 10]
        assert normal[1, 10, middle] > 0.6 > -0.6 > normal[1, 22, middle]


def test_world_normals_and_the_side_on_which_the_part_appears() -> None:
    front, right = GeometryPass(33, normal_space="world").render_primal(*ball(), views(0, 90), 0, spp=16)
    assert front[2, 16, 16] > 0.99 and right[0, 16, 16] > 0.99
    assert front[4, 16, 22] == 1 and front[4, 16, 10] == 0  # +x is on the right of a camera on +z
    assert right[4, 16, 16] == 1  # and faces a camera on +x


def test_agrees_with_mitsubas_own_camera_and_normals() -> None:
    size, (vertices, faces, weight) = 40, ball(3, centre=(0.3, 0.2, -0.1))
    cameras = views(35.0, elevation=20.0, fov=30.0)
    mesh = mi.Mesh("ball", len(vertices), len(faces), has_vertex_normals=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = mi.Float(vertices.numpy().ravel())
    parameters["faces"] = mi.UInt32(faces.numpy().astype(np.uint32).ravel())
    parameters.update()
    sensor = {
        "type": "perspective",
        "fov": 30.0,
        "to_world": mi.ScalarTransform4f().look_at(cameras.position[0].tolist(), [0, 0, 0], [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "filter": {"type": "box"}, "pixel_format": "rgb"},
    }
    scene = mi.load_dict({"type": "scene", "mesh": mesh, "sensor": sensor}, optimize=False)
    integrator = mi.load_dict({"type": "aov", "aovs": "n:sh_normal"})
    expected = np.array(mi.render(scene, integrator=integrator, spp=256)).transpose(2, 0, 1)[-3:]
    ours = GeometryPass(size, normal_space="world").render_primal(vertices, faces, weight, cameras, 1, spp=256)[0, :3]
    assert np.abs(ours.numpy() - expected).mean() < 2e-3


def test_the_nearer_piece_is_seen() -> None:
    far, near = ball(3), ball(3, 0.2, (0.0, 0.0, 1.0))
    vertices, faces = torch.cat([far[0], near[0]]), torch.cat([far[1], near[1] + len(far[0])])
    weight = torch.cat([torch.zeros(len(far[0])), torch.ones(len(near[0]))])
    front, back = GeometryPass(33).render_primal(vertices, faces, weight, views(0, 180), 0)
    assert front[4, 16, 16] == 1 and back[4, 16, 16] == 0


def test_portions_do_not_change_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh, cameras, view = ball(3), views(0, 50, 120), GeometryPass(16)
    whole = view.render_primal(*mesh, cameras, 7)
    torch.testing.assert_close(whole, view.render(*mesh, cameras, 7), atol=1e-5, rtol=0)  # drawn, not traced
    monkeypatch.setattr("fd_mitsuba.render.geometry_pass.RAYS_AT_ONCE", 2 * 4 * 16**2)
    assert torch.equal(whole, view.render_primal(*mesh, cameras, 7))
    many = view.render_primal(*mesh, cameras, 7, spp=64)
    assert (many - whole).abs().mean() < 0.02 and many.shape == (3, 5, 16, 16)


def test_drawn_and_traced_faces_give_the_same_pictures_and_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures, gradients = [], []
    for points_per_face in (0, 10**9):
        monkeypatch.setattr("fd_mitsuba.render.mesh_tracer._POINTS_PER_FACE", points_per_face)
        first, second = ball(3), ball(4, 0.3, (0.4, 0.1, 0.2))
        vertices = torch.cat([first[0], second[0]]).requires_grad_()
        faces = torch.cat([first[1], second[1] + len(first[0])])
        weight = torch.cat([torch.zeros(len(first[0])), torch.ones(len(second[0]))])
        picture = GeometryPass(24).render(vertices, faces, weight, views(0, 80), 3, static_faces=len(first[1]))
        (picture * torch.linspace(-1, 1, picture.numel()).view_as(picture)).sum().backward()
        pictures.append(picture.detach())
        gradients.append(vertices.grad)
    torch.testing.assert_close(*pictures, atol=1e-4, rtol=0)
    assert (gradients[0] - gradients[1]).norm() < 0.01 * gradients[0].norm()


@pytest.mark.parametrize("size", [1, 7])
def test_odd_sizes(size: int) -> None:
    vertices, faces, weight = ball(2)
    vertices.requires_grad_()
    picture = GeometryPass(size, spp=3).render(vertices, faces, weight, views(), 0)
    picture.sum().backward()
    assert picture.shape == (1, 5, size, size) and torch.isfinite(vertices.grad).all()


# Nothing to see, and odd meshes


def test_an_empty_mesh_gives_blank_pictures_and_no_gradient() -> None:
    view = GeometryPass(8)
    for count in (0, 5):
        vertices, weight = torch.rand(count, 3, requires_grad=True), torch.rand(count, requires_grad=True)
        picture = view.render(vertices, torch.zeros(0, 3, dtype=torch.int64), weight, views(0, 90), 0)
        picture.sum().backward()
        assert picture.shape == (2, 5, 8, 8) and not picture.any()
        assert not vertices.grad.any() and not weight.grad.any()
        assert not view.render_primal(vertices, torch.zeros(0, 3, dtype=torch.int64), weight, views(), 0).any()


@pytest.mark.parametrize("centre", [(0.0, 0.0, 9.0), (50.0, 0.0, 0.0)], ids=["behind the camera", "out of sight"])
def test_out_of_view(centre: tuple[float, float, float]) -> None:
    vertices, faces, weight = ball(2, centre=centre)
    vertices.requires_grad_()
    picture = GeometryPass(8).render(vertices, faces, weight, views(), 0)
    picture.sum().backward()
    assert not picture.any() and not vertices.grad.any()


@pytest.mark.parametrize("radius", [5.0, 3.0, 1e-5, 1e6], ids=["camera inside", "through the camera", "dot", "huge"])
def test_extreme_sizes_stay_finite(radius: float) -> None:
    vertices, faces, weight = ball(2, radius)
    vertices.requires_grad_()
    picture = GeometryPass(8).render(vertices, faces, weight, views(0, 77), 0)
    picture.sum().backward()
    assert torch.isfinite(picture).all() and torch.isfinite(vertices.grad).all()


def test_degenerate_faces_and_unused_vertices_are_harmless() -> None:
    vertices, faces, weight = ball(2)
    vertices = torch.cat([vertices, vertices[:1], torch.tensor([[9.0, 9.0, 9.0]])]).requires_grad_()
    faces = torch.cat([faces, torch.tensor([[0, 0, 1], [2, 2, 2], [0, 1, len(vertices) - 2]])])
    picture = GeometryPass(16).render(vertices, faces, torch.ones(len(vertices)), views(), 0)
    picture.sum().backward()
    assert torch.isfinite(picture).all() and torch.isfinite(vertices.grad).all() and not vertices.grad[-1].any()


def test_an_open_surface_has_its_border_as_outline() -> None:
    """A square that faces the camera: moving its right side by one pixel adds its height in pixels."""
    vertices = torch.tensor([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], requires_grad=True)
    faces = torch.tensor([[0, 1, 2], [0, 2, 3]])
    picture = GeometryPass(32, silhouette_spp=4).render(vertices, faces, torch.ones(4), views(), 0)
    picture[:, 3].sum().backward()
    per_unit = 16 / (3 * np.tan(np.radians(20)))  # pixels for one unit at the square's distance
    assert float(vertices.grad[1:3, 0].sum()) == pytest.approx(per_unit**2, rel=0.02)
    assert float(vertices.grad[2:4, 1].sum()) == pytest.approx(per_unit**2, rel=0.02)


# What is refused


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v, f, w: (v, f.clone().index_fill_(0, torch.tensor([3]), 10**7), w), "face 3 names vertex"),
        (lambda v, f, w: (v, f - 1, w), "names vertex"),
        (lambda v, f, w: (v.clone().fill_(torch.nan), f, w), "vertices: 486 values are not finite"),
        (lambda v, f, w: (v, f, w / 0), "part_weight: .* not finite"),
        (lambda v, f, w: (v[:, :2], f, w), r"expected a float tensor \(V, 3\)"),
        (lambda v, f, w: (v, f.reshape(-1), w), r"faces: expected an integer tensor \(F, 3\)"),
        (lambda v, f, w: (v, f.float(), w), "integer tensor"),
        (lambda v, f, w: (v, f, w[:-1]), r"part_weight: expected float \(V,\) = \(162,\)"),
        (lambda v, f, w: (v[f].reshape(-1, 3), torch.arange(f.numel()).reshape(-1, 3), w[f].reshape(-1)), "weld"),
        (lambda v, f, w: (v, torch.cat([f[:40].flip(1), f[40:]]), w), "opposite winding"),
    ],
)
def test_bad_meshes_are_refused_before_embree_sees_them(change: object, message: str) -> None:
    vertices, faces, weight = change(*ball(2))  # type: ignore[operator]
    with pytest.raises(ValueError, match=message):
        GeometryPass(8).render(vertices.clone().requires_grad_(), faces, weight, views(), 0)


def test_bad_settings_are_refused() -> None:
    for settings in ({"size": 0}, {"size": 4, "spp": 0}, {"size": 4, "silhouette_spp": -1}):
        with pytest.raises(ValueError, match="must be positive"):
            GeometryPass(**settings)
    with pytest.raises(ValueError, match="camera or world"):
        GeometryPass(4, normal_space="object")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="static_faces = 9999"):
        GeometryPass(4).render(*ball(1), views(), 0, static_faces=9999)


# Edges


def plain_edges(faces: np.ndarray) -> Counter[tuple[int, int]]:
    """How many faces lie at each edge, counted one by one."""
    return Counter(tuple(sorted((int(f[k]), int(f[(k + 1) % 3])))) for f in faces for k in range(3))


def test_edges_of_closed_and_open_meshes() -> None:
    closed = ball(2)[1].numpy()
    for faces in (closed, closed[:100], closed[::2]):
        edges = pair_half_edges(faces)
        start, end, opposite = corners(faces, edges.half_a)
        found = Counter({tuple(sorted(pair)): 1 for pair in zip(start.tolist(), end.tolist(), strict=True)})
        both = edges.half_b >= 0
        other_start, other_end, _ = corners(faces, edges.half_b[both])
        assert (other_start == end[both]).all() and (other_end == start[both]).all()
        for pair, second in zip(zip(start.tolist(), end.tolist(), strict=True), both, strict=True):
            found[tuple(sorted(pair))] += int(second)
        assert found == plain_edges(faces)
        assert (np.sort(np.stack([start, end, opposite], 1)) == np.sort(faces[edges.half_a // 3])).all()


def test_closed_means_that_every_edge_is_run_along_both_ways() -> None:
    faces = ball(2)[1].numpy()
    turned = np.concatenate([faces[:1, ::-1], faces[1:]])
    double, lined = np.concatenate([faces, faces]), np.concatenate([faces, faces[:, ::-1]])
    for closed in (faces, double, lined, faces[:0]):
        assert is_closed(upload_indices(closed))
    for open_ in (turned, faces[1:], faces[:-1], np.concatenate([faces, faces[:1]]), faces[:, ::-1] + (faces > 7)):
        assert not is_closed(upload_indices(open_))


def test_outside_is_beyond_the_box_of_the_vertices() -> None:
    vertices = ball(2)[0].numpy()
    assert is_outside(np.array([[0.6, 0, 0], [0, 0, -0.51]]), vertices)
    assert not is_outside(np.array([[0.6, 0, 0], [0.4, 0.4, 0.4]]), vertices)  # beyond the ball, within its box


def test_pairs_of_a_closed_mesh_are_those_of_any_mesh() -> None:
    faces = ball(2)[1].numpy()
    for mesh in (faces, np.concatenate([faces, faces])):  # in the second, four faces meet in every edge
        half_edges = np.arange(3 * len(mesh))
        start, end, _ = (column.astype(np.int32) for column in corners(mesh, half_edges))
        quick = pair_closed(mesh, half_edges.astype(np.int32), start, end, faces.max() + 1)
        slow = pair_half_edges(mesh)
        assert np.array_equal(quick.half_a, slow.half_a) and np.array_equal(quick.half_b, slow.half_b)


@pytest.mark.parametrize("count", [1, 5, 40])
def test_an_outline_is_the_same_whether_all_edges_are_paired_or_few(count: int) -> None:
    """40 views are more than one number has bits for."""
    vertices, faces, _ = (tensor.numpy() for tensor in ball(3))
    vertices = (vertices * (1 + 0.3 * np.sin(7 * vertices[:, :1]))).astype(np.float32)  # bent in places
    cameras = FilmCameras(views(*range(0, 9 * count, 9)), 32)

    uploaded = upload_floats(vertices), upload_indices(faces)

    def edges(closed: bool) -> list[set[tuple[int, ...]]]:
        found = find_outline(faces, cameras, uploaded, closed)
        pairs = np.sort(found.vertices, axis=1)
        return [set(map(tuple, pairs[found.view == view].tolist())) for view in range(count)]

    few = edges(closed=True)
    assert min(map(len, few)) > 20 and edges(closed=False) == few


def test_three_faces_at_one_edge() -> None:
    edges = pair_half_edges(np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]]))
    assert sorted(edges.half_b[edges.half_a % 3 == 0].tolist()) == [-1, 3]


def test_very_large_indices_take_the_slow_sort() -> None:
    faces = ball(1)[1].numpy() + (1 << 30)
    edges = pair_half_edges(faces)
    assert (edges.half_b >= 0).all() and len(edges.half_a) == 120
