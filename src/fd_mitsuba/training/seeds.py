"""One seed a run, split by step and purpose, so that no random number depends on what was drawn before it."""

from __future__ import annotations

from enum import IntEnum

import numpy as np


class Purpose(IntEnum):
    """What a stream of random numbers is for; the values are part of the checkpoint format."""

    FIELD = 0
    VIEWS = 1
    PIXELS = 2
    SAMPLES = 3
    GUIDANCE = 4
    BASE_PIXELS = 5
    TEXTURE = 6
    APPEARANCE_VIEWS = 7
    APPEARANCE_PIXELS = 8
    APPEARANCE_GUIDANCE = 9
    BACKGROUND = 10
    STYLE = 11
    EXPOSURE = 12
    BASE_MATERIAL = 13
    STYLE_JITTER = 14
    START = 15
    LOSSES = 16
    REGIONS = 17
    DRAFT = 18


def seed_for(run_seed: int, purpose: Purpose, step: int = 0) -> int:
    """A seed below 2^31 for one purpose at one step."""
    state = np.random.SeedSequence((run_seed, int(purpose), step)).generate_state(1, np.uint32)
    return int(state[0] >> 1)
