"""The record of a run: rows that survive a kill, pictures whose colours mean what they say."""

from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch
from PIL import Image

from fd_mitsuba.training.record import Recorder, read_metrics
from fd_mitsuba.viewing.sheets import geometry_sheet, normal_pictures
from fd_mitsuba.viewing.turntable import write_sheet, write_video


def write(folder: Path, first: int, last: int, done: int = 0) -> None:
    with Recorder(folder, "geometry", 10, done, quiet=True) as recorder:
        for step in range(first, last + 1):
            recorder.row(step, "coarse", {"loss": step / 3})


def steps(folder: Path) -> list[int]:
    return [row["step"] for row in read_metrics(folder / "metrics.jsonl")]


def test_rows(tmp_path: Path) -> None:
    write(tmp_path, 1, 3)
    rows = read_metrics(tmp_path / "metrics.jsonl")
    assert [set(row) for row in rows] == [{"stage", "phase", "step", "seconds", "loss"}] * 3
    assert rows[2]["loss"] == 1.0 and rows[0]["loss"] == pytest.approx(1 / 3, rel=1e-5)


def test_resume_cuts_rows_after_the_checkpoint(tmp_path: Path) -> None:
    write(tmp_path, 1, 5)
    write(tmp_path, 4, 6, done=3)
    assert steps(tmp_path) == [1, 2, 3, 4, 5, 6]


def test_resume_keeps_other_stages(tmp_path: Path) -> None:
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"stage": "other", "step": 99}\n{"stage": "geometry", "step": 99}\n')
    write(tmp_path, 1, 1)
    assert [(row["stage"], row["step"]) for row in read_metrics(path)] == [("other", 99), ("geometry", 1)]


@pytest.mark.parametrize("tail", ['{"stage": "geometry", "st', "3", "null", "\x00\x00\x00"])
def test_line_that_a_kill_cut_short(tmp_path: Path, tail: str) -> None:
    write(tmp_path, 1, 3)
    with open(tmp_path / "metrics.jsonl", "a") as file:
        file.write(tail)
    write(tmp_path, 4, 4, done=3)
    assert steps(tmp_path) == [1, 2, 3, 4]


def test_rows_are_there_as_soon_as_they_are_written(tmp_path: Path) -> None:
    with Recorder(tmp_path, "geometry", 10, quiet=True) as recorder:
        recorder.row(1, "coarse", {"loss": 1.0})
        assert steps(tmp_path) == [1]


def test_quiet_says_nothing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write(tmp_path, 1, 10)
    assert capfd.readouterr() == ("", "")


def test_plain_line_at_the_end_where_there_is_no_terminal(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path, "geometry", 2) as recorder:
        recorder.row(1, "coarse", {"loss_sds": 1.0})
        recorder.row(2, "refined", {"loss_sds": 2.0})
    out, err = capfd.readouterr()
    assert out == "" and "refined 2/2" in err and "sds 2" in err and "\x1b" not in err


def test_plain_line_is_not_broken(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with Recorder(tmp_path, "geometry", 1) as recorder:
        recorder.row(1, "coarse", {"loss_sds": 1.1e-5, "loss_focal": 2e-5, "loss_collision": 3e-5, "volume_ratio": 0.5})
    assert capfd.readouterr().err.count("\n") == 1


def test_missing_file_has_no_rows(tmp_path: Path) -> None:
    assert read_metrics(tmp_path / "none.jsonl") == []


def test_colours_of_normals() -> None:
    pictures = torch.zeros(1, 5, 1, 3)
    pictures[0, :4, 0, 0] = torch.tensor([0.0, 0.0, 1.0, 1.0])  # facing the camera: the usual light blue
    pictures[0, :4, 0, 1] = torch.tensor([-0.5, 0.0, 0.0, 0.5])  # half covered, pointing left
    assert normal_pictures(pictures)[0, 0].tolist() == [[128, 128, 255], [0, 64, 64], [0, 0, 0]]


@pytest.mark.parametrize("preview", [None, torch.zeros(2, 4, 8, 8)])
def test_contact_sheet(tmp_path: Path, preview: torch.Tensor | None) -> None:
    sheet = geometry_sheet(torch.zeros(2, 5, 16, 16), preview)
    assert sheet is not None
    with Recorder(tmp_path, "geometry", 10, quiet=True) as recorder:
        path = recorder.sheet(3, sheet)
    with Image.open(path) as picture:
        width, height = picture.size
    assert path == tmp_path / "images" / "step_000003.png"
    assert height / width == (1.0 if preview is None else 1.5) and width == 512


def test_sheet_of_rows(tmp_path: Path) -> None:
    rows = {"one": np.full((2, 8, 8, 3), 255, np.uint8), "two": np.zeros((3, 8, 8, 3), np.uint8)}
    write_sheet(rows, tmp_path / "deep" / "sheet.png")
    with Image.open(tmp_path / "deep" / "sheet.png") as image:
        picture = np.asarray(image)
    assert picture.shape == (2 * (8 + 18), 24, 3)
    assert (picture[18:26, :16] == 255).all() and (picture[44:, :] == 0).all()


@pytest.mark.parametrize("size", [32, 33])
def test_video_opens_and_shows_the_frames(tmp_path: Path, size: int) -> None:
    frames = np.zeros((6, size, size, 3), np.uint8)
    frames[3:, :, :, 1] = 200
    write_video(frames, tmp_path / "videos" / "a.mp4")
    seen = imageio.imread(tmp_path / "videos" / "a.mp4", plugin="pyav")
    assert seen.shape == (6, size + size % 2, size + size % 2, 3)
    assert seen[1].mean() < 10 and 150 < seen[4, ..., 1].mean() < 230


def test_the_same_frames_give_the_same_video(tmp_path: Path) -> None:
    """x264 writes down how it worked. Its look-ahead by macroblock trees read what was in the memory before it."""
    frames = np.random.default_rng(0).integers(0, 255, (12, 48, 80, 3), np.uint8)
    for name in ("a.mp4", "b.mp4"):
        write_video(frames, tmp_path / name)
    data = (tmp_path / "a.mp4").read_bytes()
    assert data == (tmp_path / "b.mp4").read_bytes()
    assert b" threads=1 " in data and b" mbtree=0 " in data


def test_numbers_are_json(tmp_path: Path) -> None:
    with Recorder(tmp_path, "geometry", 1, quiet=True) as recorder:
        recorder.row(1, "coarse", {"loss": 0.1234567891})
    assert json.loads((tmp_path / "metrics.jsonl").read_text())["loss"] == 0.123457
