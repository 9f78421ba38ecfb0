"""Normal-map turntables: a video for looking, a contact sheet for comparing."""

from __future__ import annotations

import io
from pathlib import Path

import av
import numpy as np
import torch
from PIL import Image, ImageDraw

from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.render.geometry_pass import GeometryPass
from fd_mitsuba.scene.views import CameraBatch
from fd_mitsuba.viewing.sheets import normal_pictures

_SAME_BYTES = {"threads": "1", "x264-params": "mbtree=0"}
"""x264's threads end in no fixed order, and its tree of macroblocks reads memory that nobody has written."""
Mesh = tuple[torch.Tensor, torch.Tensor]


def render_ring(mesh: Mesh, count: int, size: int, aim: np.ndarray, elevation_deg: float = 20.0) -> np.ndarray:
    """Normal pictures (count, size, size, 3) uint8 of a canonical mesh, from a ring around `aim`, front first."""
    vertices, faces = mesh
    cameras = CameraBatch.around(np.arange(count) * (360.0 / count), elevation_deg, 3.4, 45.0, np.tile(aim, (count, 1)))
    pictures = GeometryPass(size, spp=9, silhouette_spp=0).render_primal(
        vertices.float(), faces, torch.zeros(len(vertices)), cameras, seed=0
    )
    return normal_pictures(pictures)


def write_video(frames: np.ndarray, path: Path, frames_per_second: int = 16) -> None:
    """Write an H.264 video of frames (count, height, width, 3) uint8, whole or not at all.

    The codec wants even sides: an odd one is repeated at its edge. The same frames give the same bytes.
    """
    odd = [(0, side % 2) for side in frames.shape[1:3]]
    frames = np.pad(frames, [(0, 0), *odd, (0, 0)], mode="edge")
    data = io.BytesIO()
    with av.open(data, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=frames_per_second, options=_SAME_BYTES)
        stream.height, stream.width = frames.shape[1:3]
        stream.pix_fmt = "yuv420p"
        for frame in (*(av.VideoFrame.from_ndarray(frame, format="rgb24") for frame in frames), None):  # None: the rest
            container.mux(stream.encode(frame))
    write_atomically(path, data.getvalue())


def write_sheet(rows: dict[str, np.ndarray], path: Path) -> None:
    """A PNG with one captioned row of frames (count, size, size, 3) for each entry."""
    caption = 18
    size = next(iter(rows.values())).shape[1]
    width = max(len(frames) for frames in rows.values()) * size
    sheet = Image.new("RGB", (width, len(rows) * (size + caption)), (24, 24, 24))
    draw = ImageDraw.Draw(sheet)
    for index, (name, frames) in enumerate(rows.items()):
        top = index * (size + caption)
        draw.text((6, top + 3), name, fill=(235, 235, 235))
        sheet.paste(Image.fromarray(np.concatenate(list(frames), axis=1)), (0, top + caption))
    write_picture(path, sheet)
