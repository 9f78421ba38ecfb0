"""What is wrong with a finished run, as far as its metrics show it, and what to do about it."""

from __future__ import annotations

from typing import Any

LEAST_INSIDE = 0.9
"""Share of the part that must lie in its focal regions."""
MOST_BURIED = 0.5
"""Share of the part that may lie inside the base."""
_OTHER_SEED = "try another seed (--set seed=1)"


def outcome_warnings(metrics: dict[str, Any]) -> list[str]:
    """Lines for the user about a part that should be looked at before it is used; none for a part without a fault.

    Args:
        metrics: what `metrics.json` holds; keys that are missing are passed over.
    """
    warnings = []
    inside, buried = metrics.get("inside_fraction", 1.0), metrics.get("overlap_fraction", 0.0)
    gap, islands = metrics.get("gap", 0.0), metrics.get("islands_removed", 0)
    ends = metrics.get("free_ends", [])
    if "removed_volume" in metrics:  # a cut lies in the base, hangs on nothing, and loses no piece that would be seen
        buried, gap, islands, ends = 0.0, 0.0, 0, []
    if inside < LEAST_INSIDE:
        warnings.append(
            f"only {inside:.1%} of the part lies in its focal regions: enlarge them, raise geometry.lambda_focal, "
            f"or {_OTHER_SEED}"
        )
    if buried > MOST_BURIED:
        warnings.append(
            f"{buried:.0%} of the part lies inside the base, where it is not seen: move the regions outwards"
        )
    if gap > 0:
        warnings.append(
            f"a piece of the part is {gap:.3g} away from the base (its longest side is 1.8): move the regions until "
            f"they reach into the base, raise geometry.lambda_tether, or {_OTHER_SEED}"
        )
    if loose := metrics.get("loose_pieces", 0):
        pieces, hang = ("a piece", "hangs") if loose == 1 else (f"{loose} pieces", "hang")
        warnings.append(
            f"{pieces} of the base {hang} free, cut off from the rest: let the regions hold all that is to go, or move "
            "them away"
        )
    for end in ends:
        x, y, z = end["position"]
        warnings.append(
            f"an end of part {end['part']!r} hangs free, {end['gap']:.3g} before the base, at ({x:.4g}, {y:.4g}, "
            f"{z:.4g}) in the scene's units: let the region reach into the base there, or {_OTHER_SEED}"
        )
    if islands:
        pieces = "a loose piece" if islands == 1 else f"{islands} loose pieces"
        warnings.append(f"{pieces} of the part too small to be meant left out of the export: {_OTHER_SEED}")
    verdict = metrics.get("verdict")
    if isinstance(verdict, dict) and not verdict.get("looks_like", True):
        warnings.append(str(verdict.get("line", "the part does not look like the prompt")))
    if not metrics.get("manifold", True):
        warnings.append("the part's mesh is not a closed manifold: it may fail in booleans and 3D printing")
    return warnings
