"""What one training step of a prior costs: `python benchmarks/prior_training_step.py [--json] [--device cuda] ...`.

The pictures are random: only the networks, their gradients and the step of the weights count, not the data.

    step_ms              the median of the steps after a warm-up; on a card as it trains there, recorded
    mosaics_per_second   of the batch
    plain_step_ms        on a card: every kernel launched from Python
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores()

import torch  # noqa: E402
from machine import print_figures  # noqa: E402

from fd_mitsuba.prior.training.kinds import kind_named  # noqa: E402
from fd_mitsuba.prior.training.model import TokenRows, build_scheduler, build_tokenizer  # noqa: E402
from fd_mitsuba.prior.training.recorded_step import RecordedStep  # noqa: E402
from fd_mitsuba.prior.training.step import TrainingStep, memory_format  # noqa: E402


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--kind", default="geometry_fine")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--bf16", action="store_true")
    parser.add_argument("--repeats", type=int, default=10)
    options = parser.parse_args()
    kind, place = kind_named(options.kind), torch.device(options.device)
    on_card = place.type == "cuda"
    torch.manual_seed(0)
    tokenizer = build_tokenizer(kind.catalogue.vocabulary)
    modules = kind.build_modules(tokenizer).to(place)
    modules["unet"].to(memory_format=memory_format(place))  # pyright: ignore[reportCallIssue]
    rate = torch.tensor(1e-4, device=place) if on_card else 1e-4
    optimiser = torch.optim.AdamW(modules.parameters(), lr=rate, fused=True, capturable=on_card)
    step = TrainingStep(modules, optimiser, kind, build_scheduler(kind.prediction), options.bf16, 0)
    size, count = 2 * kind.view_size, options.batch
    base = 2 * torch.rand(count, 4, size, size, device=place) - 1
    changed = (torch.rand(count, 1, size, size, device=place) > 0.9).float()
    kept = torch.ones(count, 1, 1, 1, device=place)
    batch = base, base * 0.9, changed, kept, TokenRows(tokenizer)(["a cat with a crown"] * count).to(place)
    figures = {}
    if on_card:
        figures["plain_step_ms"] = milliseconds(lambda: step(*batch), options.repeats, place)
    trained = RecordedStep(step, step.generator) if on_card else step
    figures["step_ms"] = milliseconds(lambda: trained(*batch), options.repeats, place)
    figures["mosaics_per_second"] = round(1000 * count / figures["step_ms"], 1)
    print_figures({"kind": kind.name, "batch": count, "bf16": options.bf16, **figures}, options.json)
    return 0


def milliseconds(call: Callable[[], object], repeats: int, place: torch.device) -> float:
    """The median time of a call, with what it has launched."""
    times = []
    for _ in range(5 + repeats):
        started = time.perf_counter()
        call()
        if place.type == "cuda":
            torch.cuda.synchronize(place)
        times.append(time.perf_counter() - started)
    return round(1000 * sorted(times[5:])[repeats // 2], 2)


if __name__ == "__main__":
    raise SystemExit(main())
