"""Run folders made by hand, for tests of what reads them."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
from PIL import Image

from fd_mitsuba.config import RunConfig
from fd_mitsuba.viewing.turntable import write_sheet, write_video

PROMPT = 'a cat with a <b>"crown"</b> & a hat'


def film(count: int, size: int, colour: tuple[int, int, int], background: int = 0, side: float = 0.3) -> np.ndarray:
    """A square that goes around, frames (count, size, size, 3) uint8."""
    frames = np.full((count, size, size, 3), background, np.uint8)
    edge = round(size * side)
    for number in range(count):
        turn = 2 * math.pi * number / count
        y, x = (round(size * (0.5 + 0.15 * f(turn)) - edge / 2) for f in (math.cos, math.sin))
        frames[number, y : y + edge, x : x + edge] = colour
    return frames


def make_run(folder: Path, stages: tuple[str, ...] = ("geometry", "appearance"), finished: bool = True) -> Path:
    """A run folder as `fd_mitsuba run` leaves it: of some stages, and of the last one all steps or half of them."""
    folder.mkdir(parents=True)
    config = RunConfig(seed=3)

    def write(name: str, data: dict) -> None:
        (folder / name).write_text(json.dumps(data))

    write("run.json", {"scene": "/s/scene.xml", "prompt": PROMPT, "base_prompt": "a cat", "parameters": {}})
    write("config.json", config.model_dump(mode="json"))
    write("environment.json", {"fd_mitsuba": "0.1.0", "python": "3.11"})
    (folder / "command.txt").write_text("fd_mitsuba run scene.xml -D prompt='</script>'\n")
    rows = []
    for stage in stages:
        for step in range(1, 41 if finished or stage != stages[-1] else 21):
            values = {"loss_sds": 500.0 * math.exp(-step / 8), "loss_focal": 0.01 * math.sin(step) + 0.02}
            phase = "coarse" if step < 20 else "refined"
            rows.append({"stage": stage, "phase": phase, "step": step, "seconds": 0.5 * step, **values})
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    metrics = {"inside_fraction": 0.995, "overlap_fraction": 0.01, "base_identical": True, "part_faces": {"part": 1234}}
    after, before, shape = film(12, 48, (200, 60, 60), 150), film(12, 48, (60, 60, 200), 150), film(12, 48, (0, 200, 0))
    if finished or len(stages) > 1:
        write_video(shape, folder / "videos" / "turntable.mp4")
        write_video(film(12, 48, (90, 0, 200)), folder / "videos" / "turntable_base.mp4")
        write_video(shape, folder / "videos" / "turntable_part.mp4")
        write_sheet({name: shape[:8] for name in "abcd"}, folder / "images" / "turntable.png")
        write("metrics.json", metrics)
    if finished and "appearance" in stages:
        write_video(after, folder / "videos" / "appearance.mp4")
        for name, frame in (("beauty_base", before[0]), ("beauty", after[0]), ("closeup", after[3])):
            Image.fromarray(frame).save(folder / "images" / f"{name}.png")
        write_sheet({name: shape[:8] for name in "abcd"}, folder / "images" / "channels.png")
        metrics["appearance"] = {"base_psnr_db": 200.0, "learned": ["base_color"]}
    if finished:
        write("metrics.json", {**metrics, "seconds": 47.5, "stages": dict.fromkeys(stages, "done")})
    return folder
