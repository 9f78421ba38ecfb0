"""A run of the studio, as a process of its own: `python -m fd_mitsuba.studio.runner RUN` does RUN/live/job.json.

SIGINT and SIGTERM let it finish its step, save, and end. It does the same by itself when the process that started it
is gone: a run that nobody sees takes no core for hours, and goes on later from where it was.
"""

from __future__ import annotations

import os
import signal
import sys
import warnings
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from fd_mitsuba.errors import Interrupted, UserError, out_of_memory
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.runs.run_folder import LIVE_FOLDER
from fd_mitsuba.studio.job import MATERIAL_NAME, MESH_NAME, SHOW_EVERY, EventWriter, RunOrder

if TYPE_CHECKING:
    from fd_mitsuba.training.stage import StepUpdate

_INTERRUPTED = 130


def main(arguments: list[str]) -> int:
    """Do the order in the run folder `arguments[0]`; exit codes as of the command line."""
    folder = Path(arguments[0])
    events = EventWriter(folder)
    _stop_on_signals(events)
    warnings.filterwarnings("ignore")
    try:
        order = RunOrder.read(folder)
        events.write("begun", process=os.getpid(), resume=order.resume)
        _edit(order, folder, events)
    except Interrupted as stop:
        events.write("stopped", line=str(stop))
        return _INTERRUPTED
    except UserError as error:
        events.write("failed", line=str(error))
        return 1
    except (MemoryError, RuntimeError) as error:
        failure = out_of_memory(error)
        events.write("failed", line=str(failure or f"{type(error).__name__}: {str(error)[:300]}"))
        if failure is None:
            raise
        return 1
    events.write("finished")
    return 0


def _edit(order: RunOrder, folder: Path, events: EventWriter) -> None:
    import fd_mitsuba as fd

    config = fd.Config.model_validate(order.config)
    scene = fd.load_scene(
        folder / order.scene,
        order.parameters,
        prompt=order.prompt,
        threads=order.threads,
        variant=order.variant,
        plugins=config.plugins,
    )
    started_by, asked, material = os.getppid(), list[bool](), _Material()

    def on_step(update: StepUpdate) -> None:
        losses = {key: _short(value) for key, value in update.values.items() if key.startswith(("loss", "volume"))}
        events.write(
            "step", stage=update.stage, phase=update.phase, step=update.step, total=update.total, losses=losses
        )
        if update.step % SHOW_EVERY == 0 or update.step in (1, update.total):
            if update.stage == "geometry":
                events.write("mesh", step=update.step, faces=_write_mesh(update.live, folder))
            else:
                material.write(update.live, folder)
                events.write("material", step=update.step)
        if os.getppid() != started_by and not asked:
            asked.append(True)  # once: a second signal would end the process before it has said so
            os.kill(os.getpid(), signal.SIGTERM)

    fd.edit(
        scene,
        config,
        output=folder,
        on_step=on_step,
        resume=order.resume and (folder / "run.json").is_file(),
        quiet=True,
        log=lambda line: events.write("said", line=line),
        command="fd_mitsuba studio",
    )


class _Material:
    """Writes what the appearance stage has learned so far."""

    def __init__(self) -> None:
        self._live: Any = None

    def write(self, stage: Any, folder: Path) -> None:
        from fd_mitsuba.studio.live_material import LiveMaterial

        if self._live is None:
            self._live = LiveMaterial(stage)
        write_atomically(folder / LIVE_FOLDER / MATERIAL_NAME, self._live.glb())


def _write_mesh(stage: Any, folder: Path) -> int:
    from fd_mitsuba.io.ply import ply_bytes
    from fd_mitsuba.studio.live_part import live_part

    vertices, faces = live_part(stage)
    write_atomically(folder / LIVE_FOLDER / MESH_NAME, ply_bytes(vertices, faces))
    return len(faces)


def _stop_on_signals(events: EventWriter) -> None:
    """Outside of a run's steps, which have their own way, a signal ends the process at once, as the command line."""

    def end(number: int, frame: FrameType | None) -> None:
        events.write("stopped", line="stopped before or after the steps; goes on with the last checkpoint")
        os._exit(_INTERRUPTED)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)


def _short(value: float) -> float:
    return float(f"{value:.5g}")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
