"""A run folder as an object: its part, its metrics, its exports and images."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fd_mitsuba.backend.threads import own_threads
from fd_mitsuba.config.choice import Choice
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object

if TYPE_CHECKING:
    import trimesh

ALL_FORMATS = ("glb", "obj", "ply", "mitsuba")


class Run:
    """What `edit` returns, and what `Run.open` finds in a run folder.

    Example:
        run = Run.open("runs/cat")
        run.part().volume, run.metrics["inside_fraction"]
        run.export(["obj"], faces=2000)
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    @classmethod
    def open(cls, folder: Path | str) -> Run:
        """The run in a folder, finished or not; UserError if there is none."""
        folder = Path(folder)
        if read_json_object(folder / "run.json") is None:
            raise UserError(f"{folder}: not a run (no run.json that can be read); give the -o folder of a run")
        return cls(folder)

    def __repr__(self) -> str:
        return f"Run({str(self.folder)!r}, prompt={self.prompt!r}, finished={self.finished})"

    @property
    def prompt(self) -> str:
        """What was asked for."""
        return str((read_json_object(self.folder / "run.json") or {}).get("prompt", ""))

    @property
    def metrics(self) -> dict[str, Any]:
        """What `metrics.json` holds: shares, gaps, seconds, settings; empty before the geometry stage is finished."""
        return read_json_object(self.folder / "metrics.json") or {}

    @property
    def finished(self) -> bool:
        """Whether all stages that were asked for have been finished and exported."""
        return "stages" in self.metrics

    @property
    def warnings(self) -> list[str]:
        """What the user should look at, a line each, as logged at the end of the run."""
        return list(self.metrics.get("warnings", []))

    @property
    def parts(self) -> list[str]:
        """Names of the parts that were exported."""
        found = (self.folder / "export").glob("part_*.ply")
        return sorted(path.stem.removeprefix("part_") for path in found)

    def part(self, name: str | None = None) -> trimesh.Trimesh:
        """The mesh of a part in the scene's own units and frame; without a name the only part there is.

        Raises:
            UserError: no such part, or several and no name.
        """
        names = self.parts
        if name is None and len(names) == 1:
            name = names[0]
        if name not in names:
            known = ", ".join(names) or "none yet"
            raise UserError(f"{self.folder}: no part {name!r}; its parts: {known}")
        import trimesh

        return trimesh.load_mesh(self.folder / "export" / f"part_{name}.ply", process=False)

    @own_threads()
    def export(
        self,
        formats: Collection[str | Choice] = ALL_FORMATS,
        *,
        faces: int | Sequence[int] | None = None,
        texture_size: int = 1024,
    ) -> list[Path]:
        """Write the result for other programs below `folder/export`; returns the files.

        Args:
            formats: any of `glb`, `obj`, `ply`, `mitsuba`, or what is registered besides; `Choice.of("mine", {...})`
                for one with options.
            faces: at most so many triangles a part; None: all. Of several, the largest is written as ever and the
                others, as levels of detail, below `folder/export/lod_<faces>`.
            texture_size: texels a side of the parts' textures.

        Raises:
            UserError: no checkpoint there, an unknown format.
        """
        from fd_mitsuba.runs.pipeline import export_run

        written = export_run(self.folder, formats, texture_size, lambda line: None, faces)
        return [self.folder / "export" / name for name in written["files"]]

    @own_threads()
    def render(
        self,
        name: str = "render",
        *,
        values: Mapping[str, str] | None = None,
        views: int = 8,
        size: int = 256,
        spp: int = 128,
        max_depth: int = 3,
        sensor: str | None = None,
    ) -> list[Path]:
        """Render the object all around; returns the sheet's path and those of the single images.

        Args:
            sensor: instead, one image of the exported scene, surroundings included, by the sensor of its own with this
                id; then `views`, `size` and `values` are of no use.
            name: of the images in `folder/renders`.
            values: other values for the scene's `$name`, such as `{"light": "../lighting/sunset.exr"}`.

        Raises:
            UserError: the appearance stage has not begun, a size or count out of range.
        """
        from fd_mitsuba.runs.appearance_outcome import render_run
        from fd_mitsuba.runs.sensor_image import render_by_sensor

        if sensor is not None:
            return render_by_sensor(self.folder, sensor, name, spp, max_depth, dict(values or {}))
        return render_run(self.folder, dict(values or {}), name, views, size, spp, max_depth)

    def show(self) -> Any:
        """In a notebook: the result's image, from all sides. Elsewhere: its path.

        Raises:
            UserError: no image there yet.
        """
        candidates = [self.folder / "images" / f"{name}.png" for name in ("appearance", "turntable")]
        path = next((path for path in candidates if path.is_file()), None)
        if path is None:
            raise UserError(f"{self.folder}: no image yet; the geometry stage is not finished")
        try:
            from IPython.core.getipython import get_ipython
            from IPython.display import Image
        except ImportError:
            return path
        return path if get_ipython() is None else Image(filename=str(path))
