"""One run of a batch: which scene, which settings, which folder; and how it is run as a process of its own."""

from __future__ import annotations

import fcntl
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import BinaryIO

from fd_mitsuba.config import RunConfig, settings_for_run
from fd_mitsuba.config.toml_reading import locate_settings
from fd_mitsuba.errors import UserError
from fd_mitsuba.io.json_object import read_json_object
from fd_mitsuba.scene.scene_copy import ELSEWHERE, copied_files

PROGRAM = (sys.executable, "-m", "fd_mitsuba")
FINISHED, SKIPPED, FAILED, INTERRUPTED, KILLED = "finished", "skipped", "failed", "interrupted", "killed"
_POLL_SECONDS = 0.2
_INTERRUPTED_CODE = 130


@dataclass(frozen=True)
class Job:
    """A run that is wanted: what `fd_mitsuba run` is given."""

    scene: Path
    config: Path | None
    """As for `-c`; None: what suits the guidance model."""
    seed: int
    overrides: tuple[str, ...]
    """`section.key=value`, as for `--set`."""
    folder: Path
    """The run folder; its last name is the job's name."""
    definitions: tuple[str, ...] = ()
    """`name=value`, as for `-D`."""
    stage: str = "all"
    """As for `--stage`."""
    prompt: str | None = None
    """Instead of the scene's."""
    geometry_from: Path | None = None
    """As for `--from`: a finished run whose shape is taken over."""
    plugins: tuple[str, ...] = ()
    """As for `--plugin`."""

    @property
    def name(self) -> str:
        """Of the folder."""
        return self.folder.name

    @property
    def log(self) -> Path:
        """What the run said; beside its folder, because a run that fails early leaves no folder."""
        return self.folder.with_name(f"{self.folder.name}.log")

    def is_finished(self) -> bool:
        """See the function of this name; jobs of another kind have files of their own to tell by."""
        return is_finished(self)

    def settings(self) -> RunConfig:
        """The settings with overrides and seed; UserError as `settings_for_run`."""
        return settings_for_run(self.config, [*self.overrides, f"seed={self.seed}"]).config

    def words(self, threads: int) -> list[str]:
        """Arguments for the command line; goes on with a run that is there."""
        words = ["run", str(self.scene.resolve()), *self.settings_words()]
        for item in self.definitions:
            words += ["-D", item]
        words += [] if self.prompt is None else ["--prompt", self.prompt]
        words += [] if self.stage == "all" else ["--stage", self.stage]
        words += [] if self.geometry_from is None else ["--from", str(self.geometry_from.resolve())]
        words += ["-o", str(self.folder.resolve()), "-t", str(threads)]
        return words + (["--resume"] if (self.folder / "run.json").is_file() else [])

    def settings_words(self) -> list[str]:
        """Those of them that say the settings."""
        words = [] if self.config is None else ["-c", str(locate_settings(self.config).resolve())]
        for item in (*self.overrides, f"seed={self.seed}"):
            words += ["--set", item]
        for module in self.plugins:
            words += ["--plugin", str(Path(module).resolve()) if module.endswith(".py") else module]
        return words


@dataclass(frozen=True)
class Outcome:
    """What became of a job."""

    job: Job
    state: str
    """`finished`, `skipped` (was finished before), `failed`, or `interrupted` (goes on when the batch is repeated)."""
    message: str = ""
    seconds: float = 0.0
    """Of the last attempt; of the run itself where it was skipped."""
    attempts: int = 0
    """Processes started by this batch."""

    def to_json(self) -> dict:
        """One row of `batch.json`."""
        return {
            "name": self.job.name,
            "state": self.state,
            "message": self.message,
            "seconds": round(self.seconds, 1),
            "attempts": self.attempts,
            **{name: str(value) if isinstance(value, Path) else value for name, value in asdict(self.job).items()},
            "log": str(self.job.log),
        }


def is_finished(job: Job) -> bool:
    """True if the job's folder holds all that the job asks for: stages, settings, seed, parameters, scene as it is now.

    Raises:
        UserError: the job's own settings cannot be read.
    """
    metrics, known, settings = (
        read_json_object(job.folder / name) or {} for name in ("metrics.json", "run.json", "config.json")
    )
    stages = {"geometry"} if job.stage == "geometry" else {"geometry", "appearance"}
    said = metrics.get("stages")
    if not isinstance(said, dict) or not stages <= set(said):
        return False
    try:
        before = RunConfig.model_validate(settings)
    except ValueError:
        return False
    stage = "appearance" if "appearance" in stages else "geometry"
    parameters = {name: value for name, _, value in (item.partition("=") for item in job.definitions)}
    now = job.settings()
    return (
        before.content_hash(stage) == now.completed_by(before).content_hash(stage)
        and before.output == now.output
        and known.get("parameters") == parameters
        and (job.prompt is None or known.get("prompt") == " ".join(job.prompt.split()))
        and _same_file(job.folder, known.get("scene"), job.scene)
        and _scene_is_unchanged(job)
    )


def perform(
    job: Job,
    token: str,
    threads: int = 1,
    program: tuple[str, ...] = PROGRAM,
    stops: Callable[[], int] = lambda: 0,
) -> Outcome:
    """Run the job as a process and wait for it; state `killed` if a signal ended it that nobody here has sent.

    The process holds a lock on the log. A worker may be killed while its process lives on; whoever takes the job up
    again waits for that process, so no folder ever has two writers.

    Args:
        token: names the batch in the log.
        stops: how often the user has asked to stop: once lets the run save its state, twice kills it.
    """
    if job.is_finished() and not attempts(job, token):
        metrics = read_json_object(job.folder / "metrics.json") or {}
        seconds = metrics.get("seconds")
        return Outcome(job, SKIPPED, seconds=float(seconds) if isinstance(seconds, int | float) else 0.0)
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with open(job.log, "ab") as log:
        if not _locked(log, stops):
            return Outcome(job, INTERRUPTED, "not started", attempts=attempts(job, token))
        if job.is_finished():  # by the process of a worker that was killed
            return Outcome(job, FINISHED, "its worker was killed, the run was not", attempts=attempts(job, token))
        started, offset = time.monotonic(), log.tell()
        words = job.words(threads)
        log.write(f"# {token} {' '.join(words)}\n".encode(errors="surrogateescape"))
        log.flush()
        code = _wait([*program, *words], log, stops)
    seconds, count = time.monotonic() - started, attempts(job, token)
    if code == 0:
        return Outcome(job, FINISHED, "", seconds, count)
    if stops():
        return Outcome(job, INTERRUPTED, "repeat the batch to go on", seconds, count)
    if code < 0 or code == _INTERRUPTED_CODE:
        cause = signal.Signals(-code).name if code < 0 else "SIGINT or SIGTERM"
        return Outcome(job, KILLED, f"the run was ended by {cause}", seconds, count)
    return Outcome(job, FAILED, _last_words(job.log, offset) or f"exit code {code}", seconds, count)


def _wait(command: list[str], log: BinaryIO, stops: Callable[[], int]) -> int:
    # A session of its own: Ctrl-C in the terminal reaches the batch alone, which then asks each run once.
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
    asked = 0
    try:
        while True:
            try:
                return process.wait(_POLL_SECONDS)
            except subprocess.TimeoutExpired:
                if stops() > asked:
                    asked = stops()
                    process.send_signal(signal.SIGTERM if asked == 1 else signal.SIGKILL)
    except BaseException:
        # Ray cancels a task by KeyboardInterrupt in its worker.
        process.send_signal(signal.SIGTERM)
        process.wait()
        raise


def _locked(log: BinaryIO, stops: Callable[[], int]) -> bool:
    while not stops():
        try:
            fcntl.flock(log, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            time.sleep(_POLL_SECONDS)
        else:
            return True
    return False


def attempts(job: Job, token: str) -> int:
    """Processes that the batch of this token has started for the job."""
    try:
        return job.log.read_bytes().count(f"# {token} ".encode())
    except OSError:
        return 0


def _last_words(log: Path, offset: int) -> str:
    lines = log.read_bytes()[offset:].decode(errors="replace").splitlines()[1:]
    errors = [line for line in lines if line.startswith("fd_mitsuba: error:")]
    spoken = errors or [line for line in lines if line.strip()]
    return " ".join(spoken[-1].removeprefix("fd_mitsuba: error:").split())[:500] if spoken else ""


def _same_file(folder: Path, recorded: object, scene: Path) -> bool:
    return isinstance(recorded, str) and (folder.resolve() / recorded).resolve() == scene.resolve()


def _scene_is_unchanged(job: Job) -> bool:
    """Every file that the run copied for the record is the one that the scene reads now."""
    record, root = job.folder / "scene", job.scene.resolve().parent
    try:
        names = {copy: root / name for name, copy in copied_files(record / job.scene.name).items()}
    except UserError:
        return False
    own = record / ELSEWHERE
    for copy in record.rglob("*"):
        if not copy.is_file() or copy.name.startswith(".") or copy == own / "names.json":
            continue
        origin = names.get(copy.resolve(), root / copy.relative_to(record))
        if not origin.is_file() or origin.read_bytes() != copy.read_bytes():
            return False
    return record.is_dir()
