"""The method `focaldreamer`: our own run, seen through the interface of the comparison."""

from __future__ import annotations

from fd_mitsuba.baselines.interface import BASELINES, EditedMesh, EditTask
from fd_mitsuba.config.registry import NoSettings
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.runs.own_meshes import as_mesh, base_mesh, joined
from fd_mitsuba.runs.pipeline import run
from fd_mitsuba.runs.run import Run


@BASELINES.register("focaldreamer")
def focaldreamer(settings: NoSettings, task: EditTask) -> EditedMesh:
    """This package's own method: the base's mesh as it is, beside it the part that a run exports."""
    folder, scene = task.folder, task.scene
    if not Run(folder).finished:
        resume = (folder / "run.json").is_file()
        run(scene, task.config, folder, resume, "", task.quiet, task.say, ("geometry",))
    made = Run(folder)
    meshes = [base_mesh(scene)]
    for name in made.parts:
        part = made.part(name)
        meshes.append(as_mesh(scene.frame.to_canonical(part.vertices), part.faces))
    edited = EditedMesh(scene, joined(meshes))
    steps = (read_json_object(folder / "metrics.json") or {}).get("steps")
    edited.guidance_calls = int(steps) if isinstance(steps, int) else None
    return edited
