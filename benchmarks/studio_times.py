"""How long a person waits for the studio: `python benchmarks/studio_times.py [--json] [--steps N] [--repeats N]`.

Needs chromium, `npm install` in tools/viewers, and viser. Quick settings, as the page has them.

    page_seconds         from the call of the page until it can be used, by a base of 100,000 faces with a texture of
                         2048 x 2048
    first_part_seconds   from the click on Grow until the part is to be seen, on the shipped cat
    geometry_live_share, appearance_live_share
                         by how much the updates of the page slow a step of each stage, as a share of the step: mean
                         wall time of steps with and without them, in turns; steps that compile kernels do not count
"""

from __future__ import annotations

import argparse
import io
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "tools"), str(ROOT / "src")]

from export_part import lumpy_ball  # noqa: E402
from machine import print_figures  # noqa: E402
from studio_process import driven, served  # noqa: E402

from fd_mitsuba.config import settings_for_run  # noqa: E402
from fd_mitsuba.export.gltf import GltfMesh, glb_bytes  # noqa: E402
from fd_mitsuba.export.material import PbrMaterial  # noqa: E402
from fd_mitsuba.export.pictures import Picture  # noqa: E402
from fd_mitsuba.studio.job import RunOrder  # noqa: E402

CAT = ROOT / "scenes" / "cat" / "scene.xml"
_WARM_UP = 5
"""Steps of each stage that do not count."""
_SILENT = (
    "import sys; from fd_mitsuba.studio import runner; runner.SHOW_EVERY = 10**9; sys.exit(runner.main(sys.argv[1:]))"
)


def textured_ball(path: Path) -> None:
    """A GLB of 100,000 faces with UVs and a texture of 2048 x 2048 that does not compress well."""
    vertices, faces = lumpy_ball(100_000)
    around = np.arctan2(vertices[:, 0], vertices[:, 2]) / (2 * np.pi) + 0.5
    uv = np.stack([around, 0.5 - vertices[:, 1] / 2.4], axis=1)
    noise = np.random.default_rng(0).integers(0, 255, (2048, 2048, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).save(stream, format="JPEG", quality=90)
    material = PbrMaterial("ball", (1.0, 1.0, 1.0), base_picture=Picture("noise", stream.getvalue(), ".jpg"))
    path.write_bytes(glb_bytes([GltfMesh("ball", vertices, faces, material, uv=uv)], {}))


def page(action: str, target: Path, folder: Path, options: dict[str, Any]) -> dict[str, Any]:
    """What the driven page measured of a studio that is started on a scene or mesh file."""
    with served(target, folder / "work", "--prompt", options["prompt"]) as url:
        return driven("studio_page.mjs", action, url, folder, options=options)


def step_seconds(folder: Path, live: bool, steps: int) -> dict[str, float]:
    """Mean wall time of a step of each stage, in a run as the studio starts it."""
    config = settings_for_run("quick", [f"geometry.steps={steps}", f"appearance.steps={steps}"]).config
    RunOrder(str(CAT), "a cat with a crown", config.model_dump(mode="json")).write(folder)
    program = ["-m", "fd_mitsuba.studio.runner"] if live else ["-c", _SILENT]
    subprocess.run([sys.executable, *program, str(folder)], check=True, cwd=ROOT)
    found: dict[str, list[float]] = {"geometry": [], "appearance": []}
    for line in (folder / "metrics.jsonl").read_text().splitlines():
        row = json.loads(line)
        if row.get("stage") in found:
            found[row["stage"]].append(row["seconds"])
    return {stage: float(np.diff(times[_WARM_UP:]).mean()) for stage, times in found.items()}


def measure(steps: int, repeats: int) -> dict[str, Any]:
    """The figures of the module's docstring."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        textured_ball(folder / "ball.glb")
        prompt = {"prompt": "a duck with a hat", "told": "duck with a hat"}
        opened = page("picture", folder / "ball.glb", folder, prompt)
        prompt = {"prompt": "a cat with a crown", "told": "cat with a crown"}
        (folder / "cat").mkdir()
        grown = page("grow", CAT, folder / "cat", prompt)
        found: dict[str, Any] = {
            "page_seconds": opened["interactive_seconds"],
            "first_part_seconds": grown["first_part_seconds"],
        }
        times = [
            {live: step_seconds(folder / f"{number}{live}", live, steps) for live in (True, False)}
            for number in range(repeats)
        ]
    for stage in ("geometry", "appearance"):
        with_, without = (float(np.mean([pair[live][stage] for pair in times])) for live in (True, False))
        found[f"{stage}_step_seconds"], found[f"{stage}_live_share"] = round(without, 4), round(with_ / without - 1, 4)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--steps", type=int, default=65, help="of each stage, for the shares")
    parser.add_argument("--repeats", type=int, default=2)
    options = parser.parse_args()
    print_figures(measure(options.steps, options.repeats), options.json)


if __name__ == "__main__":
    main()
