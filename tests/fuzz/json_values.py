"""Faults in the values of a JSON document."""

from __future__ import annotations

import json
from random import Random

from fuzz.mutators import NUMBERS, WORDS

VALUES = [None, True, 0, -1, 1e300, float("inf"), float("nan"), "", "x", [], [1], {}, {"a": 1}, "\ud800", 10**30]


def changed(rng: Random, text: str) -> str:
    """A JSON document with one of its values replaced, or an entry renamed."""
    try:
        data = json.loads(text)
    except ValueError:
        return text
    holders = [data]
    for holder in holders:
        inner = holder.values() if isinstance(holder, dict) else holder if isinstance(holder, list) else []
        holders += [item for item in inner if isinstance(item, dict | list)]
    holder = rng.choice(holders)
    value = rng.choice([*VALUES, *NUMBERS, *WORDS])
    if isinstance(holder, dict) and holder:
        holder[rng.choice(sorted(holder))] = value
    elif isinstance(holder, list) and holder:
        holder[rng.randrange(len(holder))] = value
    else:
        data = value
    return json.dumps(data) + "\n"
