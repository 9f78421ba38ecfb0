"""What a tracer sees on a card, where it takes other ways, told by the variant; here on the CPU."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fd_mitsuba.backend import startup

mi = startup.start()

from fd_mitsuba.backend.upload import upload_floats, upload_indices  # noqa: E402
from fd_mitsuba.render import mesh_tracer  # noqa: E402
from fd_mitsuba.render.cameras import FilmCameras  # noqa: E402
from fd_mitsuba.scene.views import CameraBatch  # noqa: E402

SIZE = 24


def ball(rings: int = 24) -> tuple[np.ndarray, np.ndarray]:
    polar, turn = np.meshgrid(np.linspace(0.02, np.pi - 0.02, rings), np.linspace(0, 2 * np.pi, rings), indexing="ij")
    points = np.stack([np.sin(polar) * np.sin(turn), np.cos(polar), np.sin(polar) * np.cos(turn)], -1).reshape(-1, 3)
    corner = (np.arange(rings - 1)[:, None] * rings + np.arange(rings - 1)).ravel()
    first = np.stack([corner, corner + rings, corner + 1], axis=1)
    second = np.stack([corner + 1, corner + rings, corner + rings + 1], axis=1)
    return (0.7 * points).astype(np.float32), np.concatenate([first, second])


def test_all_rays_are_traced_on_a_card_and_see_what_is_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    vertices, faces = ball()
    views = FilmCameras(CameraBatch.around(np.array([0.0, 120.0]), 20.0, 2.5, 45.0), SIZE)
    place = np.arange(2 * SIZE**2)
    x, y = place % SIZE + 0.37, place // SIZE % SIZE + 0.61
    film, view = mi.Point2f(upload_floats(x), upload_floats(y)), upload_indices(place // SIZE**2)
    uploaded = upload_floats(vertices), upload_indices(faces)
    drawn: list[int] = []
    draw = mesh_tracer.MeshTracer.draw

    def counted(*given: object) -> mesh_tracer.Hit:
        drawn.append(1)
        return draw(*given)

    monkeypatch.setattr(mesh_tracer.MeshTracer, "draw", counted)
    seen = []
    for on_card in (False, True):
        monkeypatch.setattr(mesh_tracer, "renders_on_card", lambda on_card=on_card: on_card)
        tracer = mesh_tracer.MeshTracer()
        for scale in (1.0, 0.8):  # as from step to step
            tracer.set_mesh(vertices * np.float32(scale), faces, 0)
            hit = tracer.see(views, film, view, (uploaded[0] * scale, uploaded[1]))
            seen.append([np.array(hit.seen), np.array(hit.depth)])
    assert len(drawn) == 2, "drawn on the CPU, in both steps"
    for (by_drawing, near), (by_rays, depth) in zip(seen[:2], seen[2:], strict=True):
        assert (by_drawing != by_rays).mean() < 0.005 and by_rays.mean() > 0.1
        both = by_drawing & by_rays
        torch.testing.assert_close(torch.from_numpy(near[both]), torch.from_numpy(depth[both]), rtol=1e-4, atol=1e-4)
