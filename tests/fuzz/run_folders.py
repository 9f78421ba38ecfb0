"""Faults in run folders, read by the commands that read them."""

from __future__ import annotations

from pathlib import Path
from random import Random

from fuzz.json_values import changed
from fuzz.mutators import spoiled


def run_folder(rng: Random, folder: Path) -> list[str]:
    """A finished run with one to three damaged files, and a command that reads it."""
    run = folder / "run"
    files = sorted(path for path in run.rglob("*") if path.is_file())
    for _ in range(rng.randint(1, 3)):
        path = rng.choice(files)
        kind = rng.randrange(6)
        if kind in (0, 4, 5) and path.suffix in (".json", ".jsonl") and path.exists():
            path.write_text("".join(changed(rng, line) for line in _documents(path)))
        elif kind == 1:
            path.unlink(missing_ok=True)
        elif kind == 2:
            path.unlink(missing_ok=True)
            path.mkdir(exist_ok=True) if rng.random() < 0.5 else path.symlink_to(
                rng.choice(["/dev/zero", path.name, "/"])
            )
        elif path.is_file() and not path.is_symlink():
            path.write_bytes(spoiled(rng, path.read_bytes()))
    command = rng.choice(["report", "report", "gallery", "export", "parts", "instance", "resume"])
    if command == "gallery":
        return ["report", str(run), "--gallery", str(folder / "gallery.html")]
    if command == "export":
        return ["export", str(run), "--format", rng.choice(["obj", "glb", "ply", "mitsuba"]), "--texture-size", "16"]
    if command == "resume":
        given = ["-c", str(folder / "settings.toml"), "-o", str(run), "--stage", "geometry", "--resume", "-q"]
        small = [
            "--set=geometry.spp=1",
            "--set=output.turntable_size=32",
            "--set=output.picture_size=32",
            "--set=output.texture_size=16",
        ]
        return ["run", str(folder / "scene.xml"), *given, *small]
    if command == "instance":
        (folder / "places.json").write_bytes(
            spoiled(rng, b'[{"part": "part", "position": [0, 1, 0], "direction": [0, 1, 0]}]')
        )
        return ["instance", str(run), "--transforms", str(folder / "places.json")]
    return [command, str(run)]


def _documents(path: Path) -> list[str]:
    text = path.read_text(errors="replace")
    return text.splitlines(keepends=True) if path.suffix == ".jsonl" else [text]
