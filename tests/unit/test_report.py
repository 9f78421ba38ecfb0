"""Reports and galleries: what they show, that they hold everything themselves, and that no run is too unfinished."""

from __future__ import annotations

import base64
import io
import json
import re
import struct
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image
from report_setup import PROMPT, film, make_run

from fd_mitsuba.cli.main import main
from fd_mitsuba.errors import Interrupted, UserError
from fd_mitsuba.evaluation.report import run_page as report_module
from fd_mitsuba.evaluation.report.curves import curve_svg, stage_curves
from fd_mitsuba.evaluation.report.gallery import write_gallery
from fd_mitsuba.evaluation.report.metric_table import duration, figure_tables
from fd_mitsuba.evaluation.report.run_page import PAGE, reported, viewer_script, write_report
from fd_mitsuba.evaluation.report.run_record import changed_settings, read_run
from fd_mitsuba.viewing.film_strip import common_crop, sheet_row, strip
from fd_mitsuba.viewing.turntable import write_sheet

VOID = {"meta", "link", "input", "img", "br"}


class Page(HTMLParser):
    """Tags by name with their attributes, text outside scripts and styles, and whether all tags are closed in order."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict]] = []
        self.text = self.scripts = self.styles = ""
        self._open: list[str] = []
        self.feed(path.read_text(encoding="utf-8"))
        assert self._open == []

    def handle_starttag(self, tag: str, attributes: list) -> None:
        self.tags.append((tag, dict(attributes)))
        if tag not in VOID and not (self._open and self._open[-1] == "svg" and tag == "path"):
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attributes: list) -> None:
        self.tags.append((tag, dict(attributes)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        inside = self._open[-1] if self._open else ""
        if inside == "script":
            self.scripts += data
        elif inside == "style":
            self.styles += data
        else:
            self.text += data

    def all(self, tag: str) -> list[dict]:
        return [attributes for name, attributes in self.tags if name == tag]


def loads(page: Page) -> list[str]:
    """Addresses that the page makes a browser load."""
    found = [a[key] for name, a in page.tags for key in ("src", "poster", "srcset", "data") if key in a and name != "a"]
    found += [a["href"] for a in page.all("link")]
    for style in [page.styles, *(a.get("style", "") for _, a in page.tags)]:
        found += re.findall(r"url\(([^)]*)\)", style) + re.findall(r"@import\s+(\S+)", style)
    return found


def whole_glb() -> bytes:
    text = b'{"asset": {"version": "2.0"}, "x": "' + b"y" * 200 + b'"}'
    text += b" " * (-len(text) % 4)
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text), len(text), 0x4E4F534A) + text


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = make_run(tmp_path_factory.mktemp("runs") / "cat")
    (run / "export").mkdir()
    (run / "export" / "asset.glb").write_bytes(whole_glb())
    (run / "evaluation.json").write_text(json.dumps({"clip": {"judge": "tiny", "sim": 0.31, "dir_dot": 0.05}}))
    write_report(run)
    return run


def test_the_verdict_and_the_tried_seeds_are_shown(tmp_path: Path) -> None:
    folder = make_run(tmp_path / "run")
    assert not any(attributes.get("id") in ("verdict", "tries") for _, attributes in Page(write_report(folder)).tags)
    metrics = json.loads((folder / "metrics.json").read_text())
    verdict = {"line": "does NOT look like <glasses>", "looks_like": False}
    (folder / "metrics.json").write_text(json.dumps({**metrics, "verdict": verdict}))
    make_run(folder / "tries" / "seed_4", ("geometry",))
    (folder / "tries" / "seed_4" / "report.html").write_text("x")
    tries = [{"seed": seed, "folder": f"tries/seed_{seed}", "line": f"line of {seed}"} for seed in (3, 4)]
    (folder / "tries.json").write_text(json.dumps({"taken": 4, "tries": [*tries, "damaged"]}))
    page = Page(write_report(folder))
    (chip,) = [attributes for _, attributes in page.tags if attributes.get("id") == "verdict"]
    assert chip["class"] == "bad" and "does NOT look like <glasses>" in page.text
    assert "seed 4, taken" in page.text and "seed 3: line of 3" in page.text and "line of 4" in page.text
    links = [attributes["href"] for attributes in page.all("a") if attributes["href"].startswith("tries")]
    assert links == ["tries/seed_4/report.html"]
    pictures = [attributes for tag, attributes in page.tags if tag == "img" and attributes["alt"].startswith("seed")]
    assert [picture["alt"] for picture in pictures] == ["seed 4, taken"]  # the other seed left no picture
    assert pictures[0]["src"].startswith("data:image/webp")


def test_the_page_holds_everything_itself(finished: Path) -> None:
    path = finished / "report.html"
    page = Page(path)
    addresses = loads(page)
    assert len(addresses) >= 6 and all(address.startswith("data:") for address in addresses)
    assert [a.get("src") for a in page.all("script")] == [None] * len(page.all("script"))
    policy = next(a["content"] for a in page.all("meta") if a.get("http-equiv"))
    assert "default-src 'none'" in policy and "http" not in policy
    assert path.stat().st_size < 2 << 20


def test_the_page_shows_the_run(finished: Path) -> None:
    page = Page(finished / "report.html")
    assert PROMPT in page.text and "grown on: a cat" in page.text  # escaped on the way in, read back on the way out
    assert page.all("b") and not any("crown" in a for a in map(str, page.all("b")))
    assert "fd_mitsuba run scene.xml -D prompt='</script>'" in page.text
    for words in ("finished", "seed 3", "99.5%", "exact", "1,234", "CLIP similarity, judge tiny", "40 s"):
        assert words in page.text, words
    assert [a["data-name"] for a in page.all("button") if "data-name" in a] == ["photograph", "appearance", "turntable"]
    assert (
        len([a for a in page.all("div") if a.get("class") == "layer"]) == 5
    )  # photographs, the film all around, and the shape before and after
    model = page.all("model-viewer")[0]["src"].partition("base64,")[2]
    assert base64.b64decode(model) == (finished / "export" / "asset.glb").read_bytes()
    assert len(page.all("svg")) == 4
    assert {"closeup", "sheet"} <= {a.get("class") for a in page.all("img")}
    links = [a["href"] for a in page.all("a")]
    assert links == ["export/asset.glb", "images/beauty.png", "images/closeup.png", "videos/appearance.mp4"]


def test_frames_are_in_their_places(finished: Path) -> None:
    page = Page(finished / "report.html")
    layer = [a for a in page.all("div") if a.get("class") == "layer"][2]
    data = re.search(r"base64,([^)]*)\)", layer["style"])
    pixels = np.asarray(Image.open(io.BytesIO(base64.b64decode(data[1])))).astype(int)
    columns, rows = int(layer["data-columns"]), int(layer["data-rows"])
    assert int(layer["data-count"]) == 12 and columns * rows >= 12
    height, width = len(pixels) // rows, pixels.shape[1] // columns
    for number, frame in enumerate(film(12, 48, (200, 60, 60), 150).astype(int)):
        y, x = divmod(number, columns)
        shown = pixels[y * height : (y + 1) * height, x * width : (x + 1) * width]
        assert shown.shape[:2] == frame.shape[:2] or abs(height - len(frame)) <= 4
        # The square is where it was: red above blue there, grey elsewhere.
        red = np.argwhere(shown[..., 0] - shown[..., 2] > 60).mean(axis=0)
        assert np.abs(red - np.argwhere(frame[..., 0] - frame[..., 2] > 60).mean(axis=0)).max() < 2.5


def test_unfinished_runs_have_a_page_too(tmp_path: Path) -> None:
    shape = make_run(tmp_path / "shape", ("geometry",))
    page = Page(write_report(shape))
    assert "finished: shape only" in page.text and page.all("model-viewer") == []
    stopped = make_run(tmp_path / "stopped", ("geometry",), finished=False)
    page = Page(write_report(stopped))
    assert "unfinished: geometry stage, step 20 of" in page.text and len(page.all("svg")) == 2
    later = make_run(tmp_path / "later", finished=False)
    page = Page(write_report(later))
    assert "unfinished: appearance stage, step 20 of" in page.text
    assert [a for a in page.all("div") if a.get("class") == "layer"]
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "run.json").write_text("{}")
    assert "no step finished yet" in Page(write_report(bare)).text
    (bare / "metrics.jsonl").write_text('{"stage": "geometry", "step": 1, "loss_sds": NaN}\n{"stage"')
    (bare / "config.json").write_text('{"geometry": 3}')
    write_report(bare)


def test_without_the_viewer_the_page_says_so(finished: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(report_module, "viewer_script", lambda: None)
    before = (finished / "report.html").read_bytes()
    page = Page(write_report(finished))
    (finished / "report.html").write_bytes(before)
    assert "no copy of model-viewer" in page.text and page.all("model-viewer") == []


def test_the_viewer_is_shipped_with_its_licence() -> None:
    script = viewer_script()
    assert script and "</script" not in script and "sourceMappingURL" not in script
    assert "Apache License" in (PAGE / "model_viewer" / "LICENSE").read_text()
    notices = (PAGE / "model_viewer" / "NOTICES.md").read_text()
    assert all(name in notices for name in ("4.4.0", "three", "lit", "gainmap", "fflate"))


def test_a_report_never_fails_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, said = make_run(tmp_path / "run", ("geometry",)), []
    with pytest.raises(Interrupted), reported(run, said.append):
        raise Interrupted("stopped")
    assert (run / "report.html").is_file() and said == []
    monkeypatch.setattr(report_module, "write_report", lambda folder: 1 / 0)
    with reported(run, said.append):
        pass
    assert len(said) == 1 and "ZeroDivisionError" in said[0]
    with pytest.raises(UserError), reported(tmp_path / "nothing", said.append):
        raise UserError("no scene")
    assert len(said) == 1 and not (tmp_path / "nothing").exists()


def test_gallery(finished: Path, tmp_path: Path) -> None:
    other = make_run(finished.parent / "dog", ("geometry",), finished=False)
    path = write_gallery([finished, other], finished.parent / "pages" / "all.html")
    page = Page(path)
    assert all(address.startswith("data:") for address in loads(page))
    links = [a["href"] for a in page.all("a")]
    assert links == ["../cat/report.html"] and (path.parent / links[0]).is_file()
    values = [a["data-value"] for a in page.all("td") if "data-value" in a]
    assert "0.31" in values and "0.995" in values and "" in values
    assert "judge" not in page.text or "tiny" in page.text
    assert "2 runs, 1 finished" in page.text and "unfinished" in page.text


def test_command_line(finished: Path, capfd: pytest.CaptureFixture[str]) -> None:
    gallery = finished.parent / "gallery.html"
    assert main(["report", str(finished), "--gallery", str(gallery)]) == 0
    assert capfd.readouterr().out.split() == [str(finished / "report.html"), str(gallery)]
    assert main(["report", str(finished.parent / "none")]) == 1
    assert "no such run folder" in capfd.readouterr().err
    assert main(["report", str(finished.parent)]) == 1
    assert "not a run" in capfd.readouterr().err


@pytest.mark.parametrize(("span", "logarithmic"), [(10.0, False), (1e4, True)])
def test_curves(span: float, logarithmic: bool) -> None:
    points = [(step, span ** (1 - (step - 1) / 99), "coarse" if step < 50 else "refined") for step in range(1, 101)]
    root = ElementTree.fromstring(curve_svg(points, "a < b"))
    (line,) = (e for e in root if e.get("class") == "mean")
    xy = np.array([[float(v) for v in pair.split(",")] for pair in line.get("points").split()])
    assert (np.diff(xy[:, 0]) > 0).all() and (np.diff(xy[:, 1]) > 0).all()  # downwards on the page
    bend = abs(xy[len(xy) // 2, 1] - (xy[0, 1] + xy[-1, 1]) / 2)
    assert (bend < 1.5) == logarithmic and any("(log)" in (e.text or "") for e in root) == logarithmic
    assert [e.text for e in root if e.tag == "text" and e.text == "refined"] == ["refined"]


def test_curves_of_a_stage() -> None:
    rows = [{"stage": "g", "step": s, "seconds": s, "loss_a": s, "same": 1.0, "text": "x"} for s in range(1, 1001)]
    (curve,) = stage_curves(rows)
    assert curve.name == "loss_a" and curve.last == 1000 and len(curve.svg) < 12_000


def test_crop_and_sheet(tmp_path: Path) -> None:
    frames = film(8, 40, (255, 255, 255))
    rows, columns = common_crop(frames)
    outside = np.ones((40, 40), bool)
    outside[rows, columns] = False
    assert not frames[:, outside].any() and (rows.stop - rows.start) < 40
    write_sheet({"a": frames, "b": frames[::-1]}, tmp_path / "sheet.png")
    assert np.array_equal(sheet_row(tmp_path / "sheet.png", 1), frames[::-1])
    assert sheet_row(tmp_path / "sheet.png", 2) is None and sheet_row(tmp_path / "none.png", 0) is None
    small = strip(frames, size=20)
    assert small.count == 8 and small.columns * small.rows >= 8 and small.aspect == 1.0


def test_records(finished: Path) -> None:
    run = read_run(finished)
    assert run.finished and run.lit and run.seconds() == {"geometry": 20.0, "appearance": 20.0}
    assert changed_settings(run.settings) == {"seed"}
    tables = figure_tables({"a": 1, "group": {"leakage": 0.5, "list": [1, 2]}, "none": None}, "run")
    assert [table.title for table in tables] == ["run", "group"]
    assert [row.text for table in tables for row in table.rows] == ["1", "none", "50.00%", "1, 2"]
    assert [duration(s) for s in (5.2, 60, 185, 7800)] == ["5 s", "1 min", "3 min 5 s", "2 h 10 min"]
