"""`RUN/report.html`: one page that shows a run, self-contained: it loads nothing and opens from anywhere."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jinja2 import Environment, FileSystemLoader
from PIL import Image

from fd_mitsuba.backend.collector import long_lived
from fd_mitsuba.errors import Interrupted, RunStopped, UserError
from fd_mitsuba.evaluation.report.curves import stage_curves
from fd_mitsuba.evaluation.report.metric_table import figure_tables
from fd_mitsuba.evaluation.report.run_numbers import Titled, chips, tiles, timings, verdict
from fd_mitsuba.evaluation.report.run_record import RunRecord, changed_settings, read_run
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.glb import glb_content
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.runs.run_folder import TRIES_RECORD
from fd_mitsuba.viewing.film_strip import Strip, common_crop, picture_uri, read_picture, sheet_row, strip, video_frames

PAGE = Path(__file__).with_name("page")
_MOST_GLB_BYTES = 9 << 20
_STEPS_SHOWN = 6
_CLOSE_SIZE = 1024
_SHEETS = {"turntable": "The shape, from eight sides"}
_DOWNLOADS = {
    "export/asset.glb": "GLB, for Blender, browsers and game engines",
    "export/obj/asset.obj": "OBJ with its materials",
    "export/mitsuba/scene.xml": "Mitsuba scene",
    "export/assembled.ply": "PLY of base and part in one piece",
    "images/beauty.png": "photograph",
    "images/closeup.png": "photograph of the part",
    "videos/appearance.mp4": "film all around",
}
"""Files of a run folder that people take away, and what they are."""


class Pair(NamedTuple):
    """Photographs or turntables, after and, with the same views, before."""

    name: str
    title: str
    before: Strip | None
    after: Strip


class Download(NamedTuple):
    """A file, as the page links it, and what it is."""

    link: str
    title: str


class TriedSeed(NamedTuple):
    """A seed that was tried: its picture's data URI, what the evaluator said, and the report of its own."""

    title: str
    line: str
    taken: bool
    uri: str | None
    link: str


def write_report(folder: Path) -> Path:
    """Write the report of a run, finished or not, from what lies in its folder; returns its path.

    Raises:
        UserError: no run there, or the page cannot be written.
    """
    run = read_run(folder)
    try:
        text = _page(run)
    except Exception as error:
        about = " ".join(f"{type(error).__name__}: {error}".split())[:200]
        raise UserError(f"{folder}: cannot be shown ({about}); a file in it was damaged") from error
    path = folder / "report.html"
    write_atomically(path, text.encode(errors="backslashreplace"))
    return path


def _page(run: RunRecord) -> str:
    folder = run.folder
    part = _film(folder, "turntable_part", "turntable", 3)
    glb, glb_note = _glb(folder)
    return page_template("report.html.j2").render(
        run=run,
        css=(PAGE / "page.css").read_text(encoding="utf-8"),
        js=(PAGE / "viewer.js").read_text(encoding="utf-8"),
        chips=chips(run),
        pairs=_pairs(folder),
        part=None if part is None else strip(part, common_crop(part)),
        part_files=", ".join(f"export/{path.name}" for path in sorted((folder / "export").glob("part_*.ply"))),
        tiles=tiles(run),
        verdict=verdict(run),
        tries=_tries(folder),
        closeup=_picture(folder / "images" / "closeup.png", _CLOSE_SIZE),
        channels=_picture(folder / "images" / "channels.png", 1536),
        downloads=_downloads(folder),
        glb=glb,
        glb_note=glb_note,
        viewer_script=viewer_script(),
        steps=_steps(folder),
        sheets=_sheets(folder),
        charts={stage: stage_curves(rows) for stage, rows in run.rows.items()},
        evaluation=figure_tables(run.evaluation, "evaluation"),
        metrics=figure_tables(run.metrics, "geometry"),
        timings=figure_tables(timings(run), "timings"),
        settings=figure_tables(run.settings, "run", settings=True),
        changed=changed_settings(run.settings),
        origin=figure_tables({"scene": run.identity, "environment": run.environment}, "run"),
    )


@contextmanager
def reported(folder: Path, say: Callable[[str], None]) -> Iterator[None]:
    """Around a run: its report is written at the end, also when the run was interrupted or had to stop.

    A report that fails is one line to `say`: it must not fail the run.
    """
    try:
        yield
    except (Interrupted, RunStopped):
        report_or_say(folder, say)
        raise
    report_or_say(folder, say)


def report_or_say(folder: Path, say: Callable[[str], None]) -> None:
    """`write_report` where there is a run; whatever goes wrong becomes one line."""
    if not (folder / "run.json").is_file():
        return
    try:
        with long_lived():  # reading a film back ends with a search for garbage, and there are several
            write_report(folder)
    except Exception as error:
        say(" ".join(f"{folder}: no report ({type(error).__name__}: {error}); the run itself is complete".split()))


@cache
def page_template(name: str):
    """A template of the pages; everything put into it is escaped unless it says `safe`."""
    return Environment(
        loader=FileSystemLoader(PAGE), autoescape=True, trim_blocks=True, lstrip_blocks=True
    ).get_template(name)


def viewer_script() -> str | None:
    """The script of `<model-viewer>`; None where this installation has no copy."""
    path = PAGE / "model_viewer" / "model-viewer.min.js"
    return path.read_text(encoding="utf-8") if path.is_file() else None


def photographs(folder: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The object before and after, (1, H, W, 3) each; None where either is missing."""
    images = [read_picture(folder / "images" / f"{name}.png") for name in ("beauty_base", "beauty")]
    before, after = (None if image is None else np.asarray(image.convert("RGB"))[None] for image in images)
    return None if before is None or after is None or before.shape != after.shape else (before, after)


def shape_films(folder: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """The turntable of the shape before and after, as many frames of each; None where there is none."""
    after, before = (video_frames(folder / "videos" / f"{file}.mp4") for file in ("turntable", "turntable_base"))
    if after is None or before is None or after.shape != before.shape:
        before, after = (sheet_row(folder / "images" / "turntable.png", number) for number in (0, 2))
    return None if before is None or after is None else (before, after)


def _pairs(folder: Path) -> list[Pair]:
    pairs = []
    if (stills := photographs(folder)) is not None:
        pairs.append(Pair("photograph", "Before and after", *map(strip, stills)))
    if (film := video_frames(folder / "videos" / "appearance.mp4")) is not None:
        pairs.append(Pair("appearance", "All around", None, strip(film)))
    if (films := shape_films(folder)) is not None:
        crop = common_crop(*films)
        pairs.append(Pair("turntable", "Shape", *(strip(frames, crop) for frames in films)))
    return pairs


def _downloads(folder: Path) -> list[Download]:
    return [
        Download(name, f"{title}, {_size_of(folder / name)}")
        for name, title in _DOWNLOADS.items()
        if (folder / name).is_file()
    ]


def _size_of(path: Path) -> str:
    size = path.stat().st_size
    return f"{size / 1e6:.1f} MB" if size >= 1e5 else f"{size / 1e3:.0f} kB"


def _film(folder: Path, video: str, sheet: str, row: int) -> np.ndarray | None:
    frames = video_frames(folder / "videos" / f"{video}.mp4")
    return sheet_row(folder / "images" / f"{sheet}.png", row) if frames is None else frames


def _glb(folder: Path) -> tuple[str | None, str]:
    """The asset in base 64, and why not where it is not shown."""
    path = folder / "export" / "asset.glb"
    if not path.is_file():
        return None, ""
    if path.stat().st_size > _MOST_GLB_BYTES:
        return (
            None,
            f"export/asset.glb ({path.stat().st_size >> 20} MB) is too large for this page; open the file itself.",
        )
    data = path.read_bytes()
    if glb_content(data) is None:
        return None, "export/asset.glb is damaged; export the run anew."
    if viewer_script() is None:
        return None, "This installation has no copy of model-viewer; open export/asset.glb in any viewer of glTF."
    return base64.b64encode(data).decode(), ""


def _tries(folder: Path) -> list[TriedSeed]:
    """The seeds of `run --tries`."""
    record = read_json_object(folder / TRIES_RECORD) or {}
    tries = record.get("tries")
    found = []
    for one in (one for one in tries if isinstance(one, dict)) if isinstance(tries, list) else ():
        place = str(one.get("folder", ""))
        frames = sheet_row(folder / place / "images" / "turntable.png", 2)
        picture = None if frames is None else Image.fromarray(np.concatenate(list(frames[::2]), axis=1))
        taken = one.get("seed") == record.get("taken")
        link = f"{place}/report.html" if (folder / place / "report.html").is_file() else ""
        found.append(
            TriedSeed(
                f"seed {one.get('seed')}{', taken' if taken else ''}",
                str(one.get("line", "")),
                taken,
                None if picture is None else picture_uri(picture, 720),
                link,
            )
        )
    return found


def _steps(folder: Path) -> list[Titled]:
    """Contact sheets along the way, evenly chosen, the last of each stage among them."""
    found = []
    for prefix, stage in (("step", "geometry"), ("appearance", "appearance")):
        paths = sorted(p for p in (folder / "images").glob(f"{prefix}_*.png") if re.search(r"_\d{6}$", p.stem))
        chosen = {round(place) for place in np.linspace(0, len(paths) - 1, min(_STEPS_SHOWN, len(paths)))}
        for path in (paths[number] for number in sorted(chosen)):
            if (uri := _picture(path, 720)) is not None:
                found.append(Titled(f"{stage}, step {int(path.stem.rpartition('_')[2])}", uri))
    return found


def _sheets(folder: Path) -> list[Titled]:
    pictures = {title: _picture(folder / "images" / f"{name}.png", 1536) for name, title in _SHEETS.items()}
    return [Titled(title, uri) for title, uri in pictures.items() if uri is not None]


def _picture(path: Path, widest: int) -> str | None:
    image = read_picture(path)
    return None if image is None else picture_uri(image, widest)
