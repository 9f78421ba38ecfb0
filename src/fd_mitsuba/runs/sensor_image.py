"""A run's exported scene as one of the scene's own sensors shows it."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from fd_mitsuba.errors import UserError
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.scene.scene_file import SceneFile
from fd_mitsuba.viewing.own_sensor import seen_by


def render_by_sensor(
    folder: Path, sensor: str, name: str, spp: int, max_depth: int, changed: dict[str, str]
) -> list[Path]:
    """The exported scene of a run, surroundings included, as one of its own sensors shows it.

    Writes `renders/<name>.png` below `folder`, of the film's size.

    Args:
        sensor: its id.
        changed: other values for `$name`, which an exported scene has not any more.

    Raises:
        UserError: no exported scene, no such sensor, a name or a count that cannot be.
    """
    if changed:
        raise UserError(
            f"-D {next(iter(changed))}: the exported scene's values are filled in; leave -D or --sensor out"
        )
    if not 1 <= spp <= 65536 or (max_depth < 2 and max_depth != -1) or max_depth > 1000:
        raise UserError(f"--spp {spp} --depth {max_depth}: give 1 to 65536, and 2 to 1000 or -1")
    if Path(name).name != name:
        raise UserError(f"--output {name}: give a name without folders; images go to {folder / 'renders'}")
    path = folder / "export" / "mitsuba" / "scene.xml"
    if not path.is_file():
        raise UserError(f"{path}: missing; export the run in the format mitsuba first")
    image = seen_by(SceneFile(path), sensor, spp, max_depth)
    target = folder / "renders" / f"{name}.png"
    write_picture(target, Image.fromarray(image))
    return [target]
