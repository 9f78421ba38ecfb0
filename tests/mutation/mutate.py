"""How many small faults the tests find: `make mutants`, or this file with the modules to look at.

Every mutant of a module (see `mutants.py`) is tested by the files that are named for it here, the quick ones first; one
that passes them all is a survivor. Survivors that change nothing that can be seen are listed, with reasons, in
`survivors.toml`; the others are gaps. One fork a mutant (see `forks.py`), about a second of CPU each.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path

from forks import FAILED, NEVER, PASSED, ROOT, TIME, tested, warm_up
from mutants import Mutant, mutants

_SOURCE = ROOT / "src" / "fd_mitsuba"
TESTS: dict[str, tuple[tuple[str, ...], ...]] = {
    "losses/bend.py": (("unit/test_bend_loss.py",),),
    "losses/collision.py": (("unit/test_losses.py",),),
    "losses/focal.py": (("unit/test_losses.py",),),
    "losses/presence.py": (("unit/test_losses.py",),),
    "losses/style.py": (("unit/test_style_losses.py",),),
    "losses/tether.py": (("unit/test_tethers.py",),),
    "guidance/sds.py": (("unit/test_sds.py",), ("unit/test_guidance_variants.py",)),
    "fields/union.py": (("unit/test_union.py",),),
    "extraction/marching_tets.py": (("unit/test_marching_tets.py",), ("unit/test_surface.py",)),
    "export/obj.py": (("unit/test_export_files.py",), ("unit/test_texture_tiling.py",)),
    "export/gltf.py": (("unit/test_export_files.py",), ("unit/test_texture_tiling.py", "unit/test_instance_glb.py")),
}
"""Module -> groups of test files; a later group runs on what the earlier ones have not found."""


@dataclass(frozen=True)
class Tally:
    """What became of a module's mutants.

    Attributes:
        module: below the package.
        tried: how many, of ...
        of: ... how many there are.
        killed: by a test, or by the limit of time.
        survivors: what no test found.
    """

    module: str
    tried: int
    of: int
    killed: int
    survivors: tuple[str, ...]


def main(arguments: list[str] | None = None) -> int:
    """Print a row a module and its survivors; 1 where a module is below `--at-least`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("modules", nargs="*", help=f"of these, all by default: {', '.join(TESTS)}")
    parser.add_argument("--sample", type=int, help="mutants a module, drawn with --seed; all by default")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--at-least", type=float, default=85, help="percent of those without a reason")
    parser.add_argument("--json", type=Path, help="file for the numbers and survivors")
    options = parser.parse_args(arguments)
    if unknown := [name for name in options.modules if name not in TESTS]:
        parser.error(f"no tests are named for {unknown[0]}")
    with tempfile.TemporaryDirectory(prefix="compiled_") as folder:
        warm_up(folder)
        tallies = [_tally(name, options.sample, options.seed) for name in options.modules or TESTS]
    _print(tallies)
    if options.json:
        options.json.write_text(json.dumps([asdict(tally) for tally in tallies], indent=1) + "\n")
    return int(any(100 * tally.killed < options.at_least * (tally.tried - _explained(tally)) for tally in tallies))


def _tally(name: str, sample: int | None, seed: int) -> Tally:
    module = _SOURCE / name
    every = mutants(module.read_text())
    chosen = every
    if sample is not None and sample < len(every):
        chosen = [every[index] for index in sorted(random.Random(seed).sample(range(len(every)), sample))]
    limits = [_limit(module, tests) for tests in TESTS[name]]
    survivors = [str(mutant) for mutant in chosen if _survives(module, mutant, TESTS[name], limits)]
    tally = Tally(name, len(chosen), len(every), len(chosen) - len(survivors), tuple(survivors))
    print(f"{name}: {tally.killed} of {tally.tried} killed", file=sys.stderr, flush=True)
    return tally


def _limit(module: Path, tests: tuple[str, ...]) -> int:
    """Seconds of CPU for a mutant, of what the module itself takes; it must pass."""
    outcome = tested(module, None, tests, 600)
    if outcome.kind != PASSED:
        sys.exit(f"{', '.join(tests)} fail without any mutant:\n{outcome.output}")
    return int(10 + 4 * outcome.cpu_seconds)


def _survives(module: Path, mutant: Mutant, groups: tuple[tuple[str, ...], ...], limits: list[int]) -> bool:
    for tests, limit in zip(groups, limits, strict=True):
        outcome = tested(module, mutant.source, tests, limit)
        if outcome.kind in (FAILED, TIME):
            return False
        if outcome.kind == NEVER:
            sys.exit(f"{', '.join(tests)} never import {module}")
    return True


def _print(tallies: list[Tally]) -> None:
    reasons = _reasons()
    print(f"{'module':32} {'mutants':>8} {'killed':>7} {'':>6} {'survivors':>10} {'with a reason':>14}")
    for tally in tallies:
        told = _explained(tally)
        share = f"{100 * tally.killed / max(tally.tried, 1):.0f} %"
        count = str(tally.of) if tally.tried == tally.of else f"{tally.tried}/{tally.of}"
        print(f"{tally.module:32} {count:>8} {tally.killed:>7} {share:>6} {len(tally.survivors):>10} {told:>14}")
    for tally in tallies:
        for survivor in tally.survivors:
            reason = reasons.get(tally.module, {}).get(_fault(survivor), "no test finds it")
            print(f"{tally.module}:{survivor}\n    {reason}")


def _explained(tally: Tally) -> int:
    """How many survivors have a reason."""
    return sum(_fault(survivor) in _reasons().get(tally.module, {}) for survivor in tally.survivors)


def _fault(survivor: str) -> str:
    """Without its line, which moves."""
    return survivor.partition(": ")[2]


def _reasons() -> dict[str, dict[str, str]]:
    """Module -> fault -> why no test can find it, or needs to."""
    return tomllib.loads((Path(__file__).parent / "survivors.toml").read_text())


if __name__ == "__main__":
    sys.exit(main())
