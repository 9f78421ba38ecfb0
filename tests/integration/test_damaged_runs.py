"""Damaged run folders: each command ends in one line that names the file, and one bad run does not cost a gallery."""

from __future__ import annotations

import json
import os
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from test_evaluate import SETTINGS, Average
from tiny_runs import ORANGE_PART, write_place

from fd_mitsuba.cli.main import main
from fd_mitsuba.config import RunConfig
from fd_mitsuba.errors import UserError
from fd_mitsuba.evaluation.report.gallery import write_gallery
from fd_mitsuba.evaluation.report.run_page import write_report
from fd_mitsuba.evaluation.run_evaluation import Protocol, evaluate_run
from fd_mitsuba.runs import pipeline
from fd_mitsuba.scene.load_scene import load_edit_scene

ODD = ["3", '"text"', "[]", "null", "true", "Infinity", "-1e999", "9" * 5000, "[" * 50_000, '{"a": ' * 3000, "{", "\0"]
"""What may stand in the place of a value, or of a whole file."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, animal: tuple[np.ndarray, np.ndarray]) -> Path:
    """A finished run of both stages, with all exports."""
    root = write_place(tmp_path_factory.mktemp("damaged"), animal, SETTINGS, part=ORANGE_PART)
    run = root / "run"
    config = RunConfig.load(root / "tiny.toml")
    pipeline.run(load_edit_scene(root / "scene.xml"), config, run, quiet=True, say=lambda line: None)
    (root / "places.json").write_text('[{"position": [0, 1, 0]}]')
    write_report(run)
    return run


@pytest.fixture
def run(whole: Path) -> Path:
    """A copy that may be damaged."""
    copy = whole.with_name("copy")
    shutil.rmtree(copy, ignore_errors=True)
    return shutil.copytree(whole, copy)


def png_of_size(width: int, height: int) -> bytes:
    """A small file that says it is a large picture."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    pixels = chunk(b"IDAT", zlib.compress(b"\0" * 99))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + pixels + chunk(b"IEND", b"")


def mutations(path: Path) -> list[str]:
    """Texts in the place of a JSON file: odd ones, and the own one with an odd value for some of its entries."""
    data, texts = json.loads(path.read_text()), []
    for key, value in data.items():
        for odd in ODD[:8]:
            texts.append(json.dumps({**data, key: "@"}).replace('"@"', odd))
            if isinstance(value, dict):
                for inner in value:
                    texts.append(json.dumps({**data, key: {**value, inner: "@"}}).replace('"@"', odd))
    return [*ODD, *random.Random(0).sample(texts, min(30, len(texts)))]


@pytest.mark.parametrize("name", ["run.json", "config.json", "metrics.json", "environment.json", "evaluation.json"])
def test_reports_and_galleries_of_odd_records(run: Path, name: str, tmp_path: Path) -> None:
    """Whatever a record holds: a page, or one line; and a gallery with the whole run in it."""
    for folder in ("videos", "images", "export"):
        shutil.rmtree(run / folder)
    whole = shutil.copytree(run, tmp_path / "whole")
    (run / "evaluation.json").write_text('{"clip": {"judge": "x", "sim": 0.3}, "part": {"parts": {"a": {"valid": 1}}}}')
    for text in mutations(run / name):
        (run / name).write_text(text)
        try:
            write_report(run)
        except UserError as error:
            assert str(run) in str(error) and "cannot be shown" not in str(error), (text[:99], error)
        page = write_gallery([run, whole], tmp_path / "gallery.html", say=lambda line: None).read_text()
        assert "a pig with two wings" in page


ROWS = [*ODD, '{"stage": "geometry", "step": "x"}', '{"stage": [], "step": 1, "seconds": "a"}']


@pytest.mark.parametrize("line", ROWS)
def test_reports_of_odd_rows(run: Path, line: str) -> None:
    rows = (run / "metrics.jsonl").read_text()
    (run / "metrics.jsonl").write_text(f"{rows}{line}\n{rows}")
    assert write_report(run).is_file()


PICTURES: dict[str, Callable[[bytes], bytes]] = {
    "empty": lambda data: b"",
    "cut short": lambda data: data[: len(data) // 2],
    "noise": lambda data: random.Random(3).randbytes(2000),
    "changed bytes": lambda data: bytes(b ^ 0x55 if i % 97 == 50 else b for i, b in enumerate(data)),
    "huge": lambda data: png_of_size(60_000, 60_000),
    "wide": lambda data: png_of_size(2**31 - 1, 1),
}


@pytest.mark.parametrize("damage", PICTURES)
def test_reports_with_damaged_pictures_and_films(run: Path, whole: Path, damage: str, tmp_path: Path) -> None:
    for path in [*run.glob("images/*"), *run.glob("videos/*"), run / "export" / "asset.glb"]:
        path.write_bytes(PICTURES[damage](path.read_bytes()))
    page = write_report(run).read_text()
    assert "model-viewer src" not in page and "asset.glb is damaged" in page
    write_gallery([run, whole], tmp_path / "gallery.html")


def test_pipes_in_the_place_of_files_are_not_waited_for(run: Path, tmp_path: Path) -> None:
    for path in [*run.glob("images/*"), *run.glob("videos/*"), *run.glob("*.json*"), run / "command.txt"]:
        if path.name != "run.json":
            path.unlink()
            os.mkfifo(path)
    write_report(run)
    write_gallery([run], tmp_path / "gallery.html")


def test_one_bad_run_does_not_cost_a_gallery(
    run: Path, whole: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (run / "run.json").unlink()
    missing, page = tmp_path / "nowhere", tmp_path / "all.html"
    words = ["report", str(run), str(whole), str(missing), "--gallery", str(page), "--title", "t"]
    assert main(words) == 1
    out, err = capfd.readouterr()
    assert out.split() == [str(whole / "report.html"), str(page)]
    assert err.count("\n") == 2 and f"{run}: not a run" in err and f"{missing}: no such run folder" in err
    text = page.read_text()
    assert "not a run (no run.json)" in text and "no such run folder" in text and "3 runs, 1 finished" in text
    assert main(["report", str(run), str(missing), "--gallery", str(page)]) == 1
    assert "Traceback" not in capfd.readouterr().err


# name: (file, what becomes of its bytes, commands that must refuse it)
def noise(data: bytes) -> bytes:
    return random.Random(1).randbytes(999)


def cut(data: bytes) -> bytes:
    return data[: len(data) // 3]


def instead(before: bytes, after: bytes) -> Callable[[bytes], bytes]:
    return lambda data: data.replace(before, after, 1)


def only(data: bytes) -> Callable[[bytes], bytes]:
    return lambda _: data


STATE, LOOK = "checkpoints/step_000002.safetensors", "checkpoints_appearance/step_000002.safetensors"
MESH, RECORD, STACK = "export/part_part.ply", "export/part.json", "export/mitsuba/stack.json"
FILES: dict[str, tuple[str, Callable[[bytes], bytes], str]] = {
    "part.json of another type": (RECORD, only(b'{"parts": 3}'), "instance"),
    "part.json with infinity": (RECORD, instead(b'"position": [', b'"position": [1e999,'), "instance"),
    "part.json too deep": (RECORD, only(b"[" * 100_000), "instance"),
    "scene that is no XML": ("export/mitsuba/scene.xml", cut, "instance"),
    "scene that is noise": ("export/mitsuba/scene.xml", noise, "instance"),
    "GLB cut short": ("export/asset.glb", cut, "instance"),
    "GLB of noise": ("export/asset.glb", noise, "instance"),
    "GLB without nodes": ("export/asset.glb", instead(b'"nodes":[{', b'"nodez":[{'), "instance"),
    "part cut short": (MESH, cut, "render export evaluate"),
    "part with a wild index": (MESH, lambda data: data[:-4] + b"\xff\xff\xff\x7f", "render export"),
    "part with NaN": (MESH, lambda data: _with_nan(data), "render export"),
    "part that says it is huge": (MESH, instead(b"vertex ", b"vertex 99"), "render"),
    "checkpoint cut short": (STATE, cut, "export"),
    "checkpoint of noise": (STATE, noise, "export"),
    "material cut short": (LOOK, cut, "render export"),
    "identity of another type": ("run.json", only(b'{"scene": [], "parameters": 3}'), "render export evaluate"),
    "settings of another type": ("config.json", only(b'{"field": 1e999}'), "render export evaluate"),
    "metrics of another type": ("metrics.json", only(b'{"seconds": "x"}'), "evaluate"),
    "metrics without a number": ("metrics.json", instead(b'"inside_fraction"', b'"inside"'), "evaluate"),
    "stack of another type": (STACK, only(b'{"parts": [3]}'), "parts"),
    "stack too deep": (STACK, only(b'{"parts": ' + b"[" * 99_999), "parts"),
    "stack with a path": (STACK, instead(b'"name": "', b'"name": "../../'), "parts"),
    "stack with a text as size": (STACK, instead(b'"texture_size": ', b'"texture_size": "x", "x": '), "parts"),
}


def _with_nan(data: bytes) -> bytes:
    start = data.index(b"end_header\n") + 11
    return data[:start] + struct.pack("<f", float("nan")) + data[start + 4 :]


@pytest.mark.parametrize("name", FILES)
def test_other_commands_end_in_one_line(run: Path, name: str, capfd: pytest.CaptureFixture[str]) -> None:
    file, change, commands = FILES[name]
    path = run / file
    before = path.read_bytes()
    path.write_bytes(change(before))
    assert path.read_bytes() != before
    for command in commands.split():
        if command == "evaluate":
            with pytest.raises(UserError) as caught:
                evaluate_run(run, Average(), say=lambda line: None)
            error = str(caught.value)
        else:
            more = {
                "instance": ["--transforms", str(run.with_name("places.json"))],
                "render": ["--views", "1", "--size", "16", "--spp", "1"],
                "export": ["--texture-size", "16"],
            }
            assert main([command, str(run), *more.get(command, [])]) == 1
            out, error = capfd.readouterr()
            assert out == "" and error.count("\n") == 1, error
        assert Path(file).name in error or (Path(file).parent.name in error and "checkpoint" in error), error
        assert "Traceback" not in error and len(error) < 600


def test_a_damaged_result_is_evaluated_anew(run: Path, whole: Path) -> None:
    judge, few = Average(), Protocol(views=2, size=16, spp=1)
    result = evaluate_run(run, judge, few)
    for odd in ({"key": result["key"]}, {**result, "clip": 3}, {**result, "part": {"parts": 3}}):
        (run / "evaluation.json").write_text(json.dumps(odd))
        again = evaluate_run(run, judge, few)
        assert {**again, "evaluation_seconds": 0} == {**result, "evaluation_seconds": 0}
