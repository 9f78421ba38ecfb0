"""Spoils sound inputs, runs the command line on them, and counts how it ends: `python tests/fuzz/fuzzer.py -n 5000`.

Allowed is that it works, that it refuses in one line with exit code 1, and a usage message with exit code 2. A case is
made by its seed, its kind and its number alone: `--kind pictures --only 17 --keep FOLDER` makes one again.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from random import Random

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[1]), str(Path(__file__).resolve().parents[2] / "src")]

from fuzz.asset_files import assets
from fuzz.forked import ALLOWED, HANG, OTHER, REFUSED, SIGNAL, TRACEBACK, USAGE, WORKS, Forked, Outcome
from fuzz.mutators import KINDS, LONG_KINDS, Mutator
from fuzz.run_folders import run_folder
from fuzz.seeds import small_exr, write_seeds

RUN_FOLDERS = "run folders"
ASSETS = "assets"


@dataclass(frozen=True)
class Case:
    """One spoiled input and how the command line took it."""

    kind: str
    number: int
    outcome: Outcome

    @property
    def is_allowed(self) -> bool:
        """Whether it ended as it may."""
        return self.outcome.kind in ALLOWED

    def __str__(self) -> str:
        shown = " ".join(self.outcome.arguments)[:300]
        text = (self.outcome.errors.strip().splitlines() or [""])[-1][:400]
        return f"{self.kind} {self.number}: {self.outcome.kind} ({self.outcome.code}): {shown}: {text}".encode(
            errors="backslashreplace"
        ).decode()


class Fuzzer:
    """Cases on demand; a context manager that keeps the sound inputs and a warm process.

    Args:
        seed: of all cases.
        with_run: also make a run, for the kind `RUN_FOLDERS`; takes as long as a tiny run.
        keep: a folder that keeps the inputs of the cases.
    """

    def __init__(self, seed: int, with_run: bool = False, keep: Path | None = None) -> None:
        self.seed, self.with_run, self.keep = seed, with_run, keep
        more: dict[str, Mutator] = {ASSETS: assets}
        self.kinds = KINDS | LONG_KINDS | more | ({RUN_FOLDERS: run_folder} if with_run else {})

    def __enter__(self) -> Fuzzer:
        self._place = tempfile.TemporaryDirectory(prefix="fuzz-")
        self.sound = Path(self._place.name) / "sound"
        scene = write_seeds(self.sound, small_exr())
        self._forked = Forked().__enter__()
        outcome = self._forked.run("check", scene, "-c", self.sound / "settings.toml")
        if outcome.kind != WORKS:
            raise RuntimeError(f"the sound scene is refused: {outcome.errors}")
        if self.with_run:
            small = [
                f"--set={item}"
                for item in (
                    "geometry.spp=1",
                    "output.turntable_size=32",
                    "output.picture_size=32",
                    "output.texture_size=16",
                )
            ]
            options = [
                "-c",
                self.sound / "settings.toml",
                "-t",
                "1",
                "-q",
                "-o",
                self.sound / "run",
                "--stage",
                "geometry",
            ]
            outcome = self._forked.run("run", scene, *options, *small, seconds=600)
            if outcome.kind == WORKS:
                outcome = self._forked.run("export", self.sound / "run", "--texture-size", "16", seconds=600)
            if outcome.kind != WORKS:
                raise RuntimeError(f"the sound run fails: {outcome.errors}")
        return self

    def __exit__(self, *_: object) -> None:
        self._forked.__exit__()
        self._place.cleanup()

    def case(self, kind: str, number: int) -> Case:
        """Make case `number` of a kind, and run it."""
        root = self.keep or Path(self._place.name)
        folder = root / f"{kind.replace(' ', '_')}_{number}"
        if folder.exists():
            shutil.rmtree(folder)
        shutil.copytree(self.sound, folder, ignore=None if kind == RUN_FOLDERS else shutil.ignore_patterns("run"))
        arguments = self.kinds[kind](Random(f"{self.seed} {kind} {number}"), folder)
        outcome = self._forked.run(*arguments)
        if self.keep is None:
            shutil.rmtree(folder, ignore_errors=True)
        return Case(kind, number, outcome)

    def cases(self, count: int, kinds: list[str] | None = None) -> Iterator[Case]:
        """`count` cases, the kinds in turn."""
        kinds = kinds or list(self.kinds)
        for number in range(count):
            yield self.case(kinds[number % len(kinds)], number // len(kinds))


def table(cases: list[Case]) -> str:
    """Outcomes by kind, and the share of refusals that say where."""
    columns = [WORKS, REFUSED, USAGE, TRACEBACK, SIGNAL, HANG, OTHER]
    kinds = [*dict.fromkeys(case.kind for case in cases), "all"]
    lines = [["", "cases", *columns, "says where"]]
    for kind in kinds:
        chosen = [case for case in cases if kind in (case.kind, "all")]
        counts = Counter(case.outcome.kind for case in chosen)
        refused = [case for case in chosen if case.outcome.kind in (REFUSED, USAGE)]
        share = f"{sum(case.outcome.is_precise for case in refused) / len(refused):.1%}" if refused else "-"
        lines.append([kind, str(len(chosen)), *(str(counts[column]) for column in columns), share])
    widths = [max(len(line[column]) for line in lines) for column in range(len(lines[0]))]
    return "\n".join("  ".join(cell.rjust(width) for cell, width in zip(line, widths, strict=True)) for line in lines)


def _share_of(options: argparse.Namespace, worker: int, kinds: list[str] | None) -> list[Case]:
    found = []
    with Fuzzer(options.seed, kinds is None or RUN_FOLDERS in kinds, options.keep) as fuzzer:
        chosen = kinds or list(fuzzer.kinds)
        for number in range(worker, options.count, options.workers):
            case = fuzzer.case(chosen[number % len(chosen)], options.first + number // len(chosen))
            found.append(case)
            if not case.is_allowed:
                print(case, flush=True)
            elif (
                options.refusals
                and case.outcome.kind == REFUSED
                and (options.refusals == "all" or not case.outcome.is_precise)
            ):
                print(f"{case.kind} {case.number}: {case.outcome.message[:300]}", flush=True)
    return found


def main() -> int:
    """Run the cases that the options ask for; 1 if one ended as none may."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", "--count", type=int, default=500, help="cases; default: 500")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument(
        "--kind", action="append", choices=[*KINDS, *LONG_KINDS, ASSETS, RUN_FOLDERS], help="default: all in turn"
    )
    parser.add_argument("--only", type=int, help="this case of the kind alone")
    parser.add_argument("--keep", type=Path, metavar="FOLDER", help="keep the inputs there")
    parser.add_argument("--workers", type=int, default=1, help="default: 1")
    parser.add_argument("--refusals", choices=["vague", "all"], help="print these refusals, too")
    options = parser.parse_args()
    options.first = 0
    if options.only is not None:
        options.first, options.count, options.workers = options.only, 1, 1
    with ThreadPoolExecutor(options.workers) as pool:
        shares = pool.map(lambda worker: _share_of(options, worker, options.kind), range(options.workers))
        cases = [case for share in shares for case in share]
    print(table(cases))
    slowest = max(cases, key=lambda case: case.outcome.seconds)
    spent = sum(case.outcome.cpu_seconds for case in cases)
    last = f"slowest: {slowest.kind} {slowest.number}, {slowest.outcome.seconds:.1f} s"
    print(f"seed {options.seed}; {spent:.0f} s of CPU; {last}")
    return 0 if all(case.is_allowed for case in cases) else 1


if __name__ == "__main__":
    sys.exit(main())
