"""Several processes that share the views of each step: `torchrun --nproc-per-node N -m fd_mitsuba run ...`.

Every process has the whole field and does the whole step, with its own share of the views; the gradients are added up,
so that all take the same step. Process 0 alone writes. Without torchrun there is one process, and nothing here loads
`torch.distributed`.
"""

from __future__ import annotations

import datetime
import os
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from fd_mitsuba.errors import RunStopped, UserError

if TYPE_CHECKING:
    import torch

_PATIENCE = datetime.timedelta(days=1)
"""How long a process waits for the others: exports and pictures are made by one while the rest have nothing to do."""
_POLITE_SECONDS = 60
_SUMS = frozenset({"loss_sds", "guidance_loss", "guidance_critic_loss", "part_pixels"})
_MAXIMA = frozenset({"guidance_gradient_max"})
"""How the processes' values become those of the step; all others are averaged."""


@dataclass(frozen=True)
class Processes:
    """Attributes:
    rank: of this process, from 0.
    count: of all processes.
    local_rank, local_count: the same on this machine.
    """

    rank: int = 0
    count: int = 1
    local_rank: int = 0
    local_count: int = 1

    @property
    def writes(self) -> bool:
        """Whether this process writes files and talks to the user."""
        return self.rank == 0

    def share(self, views: int) -> slice:
        """Which of a step's views are this process's own: consecutive ones."""
        own = views // self.count
        return slice(self.rank * own, (self.rank + 1) * own)

    def add_up(self, tensors: Iterable[torch.Tensor]) -> None:
        """Put the sum over all processes into each tensor; all must give as many of the same shapes."""
        if self.count > 1:
            for tensor in tensors:
                self._reduced(tensor, "SUM")

    def values_of_all(self, values: Mapping[str, float]) -> dict[str, float]:
        """A step's values, of all views; all processes must give the same names."""
        if self.count == 1:
            return dict(values)
        import torch

        names = sorted(values)
        own = torch.tensor([values[name] for name in names], dtype=torch.float64)
        total, most = own.clone(), own.clone()
        self._reduced(total, "SUM")
        self._reduced(most, "MAX")
        found = {}
        for index, name in enumerate(names):
            mean = float(total[index]) / self.count
            found[name] = float(total[index]) if name in _SUMS else float(most[index]) if name in _MAXIMA else mean
        return {name: found[name] for name in values}

    def sum(self, value: float) -> float:
        """The sum of the processes' numbers."""
        return self.values_of_all({"part_pixels": value})["part_pixels"]

    def agree(self, number: int) -> int:
        """The largest of the processes' numbers."""
        return int(self.values_of_all({"guidance_gradient_max": number})["guidance_gradient_max"])

    def wait(self) -> None:
        """Until all processes have come here."""
        self.sum(0.0)

    def _reduced(self, tensor: torch.Tensor, how: str) -> None:
        from torch import distributed

        try:
            distributed.all_reduce(tensor, getattr(distributed.ReduceOp, how))
        except RuntimeError:
            raise RunStopped("another process of the run has ended, and this one cannot go on alone") from None


@cache
def processes() -> Processes:
    """The processes that torchrun has started; a single one without it.

    Raises:
        UserError: the others cannot be reached.
    """
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1 or "TORCHELASTIC_RUN_ID" not in os.environ:
        return Processes()
    from torch import distributed

    try:
        distributed.init_process_group("gloo", timeout=_PATIENCE)
    except (RuntimeError, ValueError) as error:
        raise UserError(f"torchrun: the processes cannot reach each other ({error})") from None
    names = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE")
    return Processes(*(int(os.environ[name]) for name in names))


def speaks_first() -> bool:
    """Whether this process tells the user what all processes of the machine find alike, such as bad input."""
    return not started_with_others() or os.environ.get("LOCAL_RANK", "0") == "0"


def leave_the_word_to_the_first() -> None:
    """In all processes but the first, wait before an error is told: where the first has the same, it ends them all."""
    if not speaks_first():
        time.sleep(_POLITE_SECONDS)


def started_with_others() -> bool:
    """Whether torchrun started this process as one of several, without reaching out for them."""
    return int(os.environ.get("WORLD_SIZE", "1")) > 1 and "TORCHELASTIC_RUN_ID" in os.environ
