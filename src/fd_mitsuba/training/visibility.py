"""Whether a step's pictures show the part at all; a run whose part nobody sees any more cannot go on."""

from __future__ import annotations

from torch import Tensor

from fd_mitsuba.backend.processes import processes
from fd_mitsuba.errors import RunStopped

INVISIBLE = "invisible_steps"
"""Of a stage's counters: steps in a row without any visible part."""
VANISHED_AFTER = 25
"""So many of them stop the run."""
_LEAST_PIXELS = 0.5


def watch_visibility(pictures: Tensor, counters: dict[str, int], subtracts: bool) -> None:
    """Count a step, and stop the run after `VANISHED_AFTER` in a row without a part.

    Args:
        pictures: (B, 5, H, H) geometry pictures of the step's views in this process.
        counters: with `INVISIBLE`.
        subtracts: whether the part is cut out of the base.

    Raises:
        RunStopped: with what to change.
    """
    visible = processes().sum(float(pictures[:, 4].detach().sum())) >= _LEAST_PIXELS
    counters[INVISIBLE] = 0 if visible else counters[INVISIBLE] + 1
    if counters[INVISIBLE] < VANISHED_AFTER:
        return
    if subtracts:
        raise RunStopped(
            f"no cut has been visible for {VANISHED_AFTER} steps, so there seems to be nothing to take off; move "
            "the focal region onto all of what is to go"
        )
    raise RunStopped(
        f"the part has been invisible for {VANISHED_AFTER} steps; move or enlarge the focal region, "
        "or lower geometry.lambda_volume"
    )
