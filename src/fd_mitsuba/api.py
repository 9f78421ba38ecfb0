"""The package's public functions: load a scene, edit it, evaluate the outcome. The command line calls nothing else.

Example:
    import fd_mitsuba as fd

    scene = fd.load_scene("scenes/cat/scene.xml", prompt="a cat with a crown")
    run = fd.edit(scene, fd.Config.load("quick"), output="runs/crown")
    run.part().export("crown.stl")
"""

from __future__ import annotations

import atexit
import shutil
import sys
import tempfile
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.backend.startup import DEFAULT_VARIANT
from fd_mitsuba.backend.threads import own_threads
from fd_mitsuba.config import ChosenSettings, RunConfig, misfits, settings_for_run
from fd_mitsuba.config.registry import load_plugins
from fd_mitsuba.conventions import STAGES
from fd_mitsuba.errors import UserError
from fd_mitsuba.runs.run import Run
from fd_mitsuba.scene.prompt_text import length_fault, one_line_of

if TYPE_CHECKING:
    from fd_mitsuba.assets.importing import ImportedAsset
    from fd_mitsuba.guidance.interface import Guidance
    from fd_mitsuba.scene.edit_scene import EditScene
    from fd_mitsuba.training.stage import OnStep

_LIGHT = Path(__file__).with_name("demo") / "lighting" / "city.exr"


def demo_scene() -> Path:
    """Path of the scene that ships with the package: a cat, and a focal region for a crown above its head.

    Example:
        scene = fd.load_scene(fd.demo_scene(), prompt="a cat with a pointed hat")
    """
    return Path(__file__).with_name("demo") / "cat" / "scene.xml"


def import_asset(
    path: Path | str,
    folder: Path | str,
    *,
    prompt: str | None = None,
    base_prompt: str | None = None,
    up: str | None = None,
    front: str | None = None,
    units: str | None = None,
    at: Sequence[str] | str = (),
    size: str | None = None,
    light: Path | str | None = None,
    subtract: bool = False,
) -> ImportedAsset:
    """Write a scene to edit, with everything that it reads, out of a GLB, glTF, OBJ, DAE, 3DS, PLY, STL, OFF or ZIP.

    Meshes become PLY, one shape a material, in the asset's own unit and turned so that up is +y and front is +z;
    materials become `principled` BSDFs; images are kept byte for byte where that is possible. Mitsuba is not started.

    Args:
        path: the mesh file; its images and material files lie beside it or below its folder.
        folder: of the scene; must be new or empty.
        prompt: what the edited object should look like; None: the file's name, for `load_scene(prompt=...)` to say.
        base_prompt: what it looks like now; None: the prompt up to its "with".
        up: the asset's axis that points up, such as "z"; None: as the file says, or a guess.
        front: the axis that it looks along, such as "-y"; None: likewise.
        units: "mm", "cm" or "m"; None: as the format says.
        at: places of focal regions; see `scene.region_words`; none: where the prompted part usually is, else its head.
            A prompt of several parts puts each where it usually is, or at as many places in their order, and gives each
            a prompt of its own.
        size: of the regions: a share of the longest side such as "0.3", or "12u" in the asset's unit; None: what the
            prompted part usually has there, see `scene.usual_regions`, else 0.3.
        light: an EXR environment map; None: a shipped one.
        subtract: whether the regions take something off, in place of adding a part.

    Returns:
        The scene's path, and what was guessed, left out or understood in another way.

    Raises:
        UserError: an asset that cannot be read or edited, in one line with file, element and remedy.

    Example:
        imported = fd.import_asset("duck.glb", "scenes/duck", prompt="a duck with a crown")
        run = fd.edit(fd.load_scene(imported.scene), output="runs/duck")
    """
    from fd_mitsuba.assets.importing import import_file
    from fd_mitsuba.guidance.prompted_part import prompted_parts

    at = [at] if isinstance(at, str) else at
    for name, text in (("prompt", prompt), ("base_prompt", base_prompt)):
        if text is not None and not text.strip():
            raise UserError(f"{name}: is blank; describe the object")
    told = [None if text is None else " ".join(text.split()) for text in (prompt, base_prompt)]
    lit = _LIGHT if light is None else Path(light)
    how = up, front, units, at, size, subtract, prompted_parts(told[0], told[1] or "", subtract)
    return import_file(Path(path), Path(folder), lit, told[0], told[1], *how)


def load_scene(
    path: Path | str,
    parameters: Mapping[str, str] | None = None,
    *,
    prompt: str | None = None,
    regions: Path | str | None = None,
    threads: int = 0,
    variant: str = DEFAULT_VARIANT,
    on_misplaced: Callable[[UserError], None] | None = None,
    plugins: Collection[str] = (),
    at: Sequence[str] | str = (),
    size: str | None = None,
    needs_region: bool = True,
    subtract: bool = False,
) -> EditScene:
    """Read a scene and start Mitsuba if it has not been started.

    Args:
        path: a Mitsuba scene (XML) with focal regions and a prompt.
        parameters: values for `$name`, as `-D name=value`.
        prompt: in place of the scene's.
        regions: an XML file with focal regions, such as for a scene that was exported.
        threads: cores to use; 0: all; 1: results that are the same bytes at every run. Import torch after this call.
            Between calls of this package your own code has its threads back.
        variant: Mitsuba's.
        on_misplaced: takes what is wrong with the place of a region, which is then kept; None: it is raised.
        plugins: modules or .py files to import first, which register what the scene names; see docs/extending.md.
        at: places of focal regions that take the place of the scene's own, such as "head"; see
            `scene.region_words`. The file of regions that is made of them lies in a temporary folder and is copied
            into the run.
        size: of these regions: a share of the base's longest side such as "0.3", or "12u" in the scene's unit.
        needs_region: False: a scene without regions or prompt is taken as well, to look at its base.
        subtract: whether the regions at `at` take something off, in place of adding a part.

    Raises:
        UserError: whatever is wrong with the scene, in one line with file, element and remedy.
    """
    at = [at] if isinstance(at, str) else at
    words = None if prompt is None else one_line_of(prompt)
    if words == "":
        raise UserError("prompt: is blank; describe the edited object")
    if words is not None and (fault := length_fault(words)):
        raise UserError(f"prompt: {fault}")
    if threads < 0:
        raise UserError(f"threads = {threads}: give 0 (all cores) or a positive number")
    with own_threads(threads, variant):
        load_plugins(plugins)
        from fd_mitsuba.scene.load_scene import load_edit_scene

        if at:
            regions = _placed(Path(path), dict(parameters or {}), regions, at, size, subtract, words)
        elif size is not None:
            raise UserError(f"size {size}: is that of regions to place; say where they go, too")
        elif subtract:
            raise UserError("subtract: is for regions to place; say where they go, too")
        return load_edit_scene(path, dict(parameters or {}), regions, words, on_misplaced, needs_region)


def _placed(
    scene: Path,
    parameters: dict[str, str],
    regions: Path | str | None,
    at: Sequence[str],
    size: str | None,
    subtract: bool,
    prompt: str | None,
) -> Path:
    """A file of regions at places, which is gone with this process."""
    from fd_mitsuba.assets.placing import write_placed_regions
    from fd_mitsuba.guidance.prompted_part import prompted_parts
    from fd_mitsuba.scene.load_scene import scene_prompt

    if regions is not None:
        raise UserError(f"{regions}: regions come from a file or from places to put them; give one of the two")
    target = temporary_folder() / "regions.xml"
    # A scene without any prompt says so when it is loaded.
    wanted = prompted_parts(prompt or scene_prompt(scene, parameters), removed=subtract)
    write_placed_regions(scene, parameters, at, size, target, subtract, wanted)
    return target


def temporary_folder() -> Path:
    """A new folder that goes when this process ends."""
    folder = Path(tempfile.mkdtemp(prefix="fd_mitsuba_"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@own_threads()
def edit(
    scene: EditScene | Path | str,
    config: RunConfig | ChosenSettings | None = None,
    *,
    output: Path | str,
    guidance: Guidance | None = None,
    on_step: OnStep | None = None,
    resume: bool = False,
    quiet: bool = False,
    stages: Collection[str] = STAGES,
    geometry_from: Path | str | None = None,
    tries: int | None = None,
    log: Callable[[str], None] | None = None,
    command: str = "",
) -> Run:
    """Grow the part that a scene asks for, give it its material, write the run folder with all exports and its report.

    Args:
        scene: from `load_scene`, or a path.
        config: settings, or what `settings_for_run` chose and is then said; None: those that suit the built-in prior.
        output: the run folder; must be new or empty, or hold a run to go on with.
        guidance: any object with the methods of `guidance.interface.Guidance`, in place of the model that the settings
            name. With `guide_appearance` it serves the appearance stage as well.
        on_step: called with a `StepUpdate` after each finished step.
        resume: go on with the run in `output`.
        quiet: no progress display, no log lines.
        stages: which of `geometry` and `appearance` to run.
        geometry_from: another run of this scene, whose finished geometry is taken over.
        tries: grow up to so many seeds and keep the one that looks most like the prompt; see `evaluation.tries`.
        log: takes log lines and warnings; None: they go to stderr unless `quiet`.
        command: for the record in the run folder.

    Raises:
        UserError: bad input; `RunStopped` if a run cannot go on, `Interrupted` after SIGINT or SIGTERM.
    """
    if log is None:
        log = _nothing if quiet else _to_stderr
    opening = []
    if config is None:
        config = settings_for_run(None)
    if isinstance(config, ChosenSettings):
        opening = [config.remark] if config.remark else []
        config = config.config
    if isinstance(scene, (str, Path)):
        scene = load_scene(scene, plugins=config.plugins)
    load_plugins(config.plugins)
    opening += [scene.base_choice] if scene.base_choice else []
    unknown = set(stages) - set(STAGES)
    if unknown or not stages:
        raise UserError(f"stages = {sorted(stages)}: give any of {', '.join(STAGES)}")
    if guidance is None:
        opening += [f"warning: {line}" for line in misfits(config)]
    from fd_mitsuba.evaluation.report.run_page import reported
    from fd_mitsuba.evaluation.tries import run_tries
    from fd_mitsuba.evaluation.verdict import judge_run
    from fd_mitsuba.runs.pipeline import run

    folder = Path(output)
    taken = None if geometry_from is None else Path(geometry_from)
    if tries is not None and (taken, guidance, on_step) != (None, None, None):
        raise UserError("tries: grows shapes of its own; leave out the other run, and guidance and on_step")
    if processes().count > 1 and tries is not None:
        raise UserError("tries: grows its shapes in one process; leave torchrun or --tries out")
    if not processes().writes:
        from fd_mitsuba.runs.follower import follow

        follow(scene, config, folder, resume, tuple(stages), taken)
        processes().wait()
        return Run(folder)
    with reported(folder, log):
        if tries is not None:
            run_tries(scene, config, folder, tries, resume, command, quiet, log, tuple(stages), opening)
        else:
            run(
                scene, config, folder, resume, command, quiet, log, tuple(stages), taken, guidance, on_step, opening,
                judge=judge_run,
            )  # fmt: skip
    processes().wait()
    result = Run(folder)
    said = result.metrics.get("verdict", {}).get("line")
    for warning in result.warnings:
        if warning != said:
            log(f"warning: {warning}")
    return result


@own_threads()
def evaluate(run: Run | Path | str, *, judge: str | None = None, **protocol: Any) -> dict[str, Any]:
    """The metrics of a finished run: CLIP scores, base preservation, leakage; also written to `evaluation.json`.

    Args:
        judge: a CLIP model by folder or hub id; None: the built-in evaluator.
        protocol: `views`, `size`, `spp`, `pictures` as in `evaluation.run_evaluation.Protocol`.

    Raises:
        UserError: no finished run there, a model that cannot be loaded.
    """
    from fd_mitsuba.evaluation.clip import ClipJudge
    from fd_mitsuba.evaluation.run_evaluation import Protocol, evaluate_run

    folder = run.folder if isinstance(run, Run) else Path(run)
    return evaluate_run(folder, ClipJudge.load(judge), Protocol(**protocol))


def _nothing(line: str) -> None:
    pass


def _to_stderr(line: str) -> None:
    print(f"fd_mitsuba: {line}", file=sys.stderr)
