"""The loop of a stage: step, record, checkpoint; a signal stops it cleanly, a failure leaves the last good state."""

from __future__ import annotations

import signal
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from fd_mitsuba.backend.processes import Processes, processes
from fd_mitsuba.errors import Interrupted, RunStopped, out_of_memory
from fd_mitsuba.training.checkpoint import CheckpointHeader, checkpoint_folder, load_newest, save_checkpoint
from fd_mitsuba.training.record import Recorder
from fd_mitsuba.training.stage import OnStep, Stage, StepUpdate
from fd_mitsuba.training.stop_request import stop_on_signals

_FIELD_CHECKED_EVERY = 10


def run_stage(
    stage: Stage,
    folder: Path,
    resume: bool = False,
    quiet: bool = False,
    say: Callable[[str], None] = print,
    on_step: OnStep | None = None,
) -> None:
    """Train until the last step; the newest checkpoint in the stage's `checkpoint_folder` then holds the result.

    Args:
        stage: fresh; a checkpoint is loaded into it if `resume`.
        folder: the run folder.
        say: takes remarks for the user, a line each.
        on_step: called after each finished step, saved or not.

    Raises:
        Interrupted: after SIGINT or SIGTERM, with a checkpoint of the last finished step.
        RunStopped: the run cannot go on; the checkpoints stay as they were.
        UserError: a checkpoint that does not fit, a folder that cannot be written.
    """
    config, checkpoints = stage.config, checkpoint_folder(folder, stage.name)
    config_hash, total = config.content_hash(stage.name), stage.steps
    done, guidance = 0, getattr(stage, "guidance", None)
    if resume:
        own = stage.field, stage.optimiser, stage.counters, guidance, stage.average
        done, remarks = load_newest(checkpoints, stage.name, config_hash, *own)
        for remark in remarks:
            say(remark)
        say(f"resuming after step {done} of {total}" if done else "no checkpoint yet: starting at step 0")

    def save(step: int) -> None:
        header = CheckpointHeader(stage.name, step, config_hash, counters=dict(stage.counters))
        kept = config.output.checkpoints_kept
        save_checkpoint(checkpoints, header, stage.field, stage.optimiser, kept, guidance, stage.average)

    group = processes()
    recording = Recorder(folder, stage.name, total, done, quiet) if group.writes else nullcontext()
    with stop_on_signals() as request, recording as recorder:
        for step in range(done, total):
            try:
                record = stage.step(step)
            except (MemoryError, RuntimeError) as error:  # torch, Dr.Jit and CUDA say it in words only
                if problem := out_of_memory(error):
                    raise RunStopped(f"step {step + 1}: {problem}") from None
                raise
            finished = step + 1
            last = finished == total
            stopped_by = _agreed(group, request.name)  # read once: a signal after this line stops the next step
            saving = finished % config.output.checkpoint_every == 0 or last or stopped_by is not None
            values = dict(record.values)
            if saving or finished % _FIELD_CHECKED_EVERY == 0:
                values.update(stage.check_field(finished))
            phase = stage.phase_name(step)
            if recorder is None:
                if stopped_by is not None:
                    raise Interrupted(f"{stopped_by}: stopped after step {finished} of {total}")
                continue
            recorder.row(finished, phase, values)
            every = config.output.sheet_every
            if every and (finished % every == 0 or last) and (sheet := record.sheet()) is not None:
                recorder.sheet(finished, sheet)
            if saving:
                save(finished)
            if on_step is not None:
                on_step(StepUpdate(stage.name, phase, finished, total, values, stage))
            if stopped_by is not None:
                raise Interrupted(f"{stopped_by}: stopped after step {finished} of {total}; continue with --resume")


def _agreed(group: Processes, name: str | None) -> str | None:
    """The signal that any process was stopped by, so that all stop after the same step."""
    if group.count == 1:
        return name
    number = group.agree(0 if name is None else int(signal.Signals[name]))
    return signal.Signals(number).name if number else None
