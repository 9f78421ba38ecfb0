"""How often the benchmark's classifier finds the generator's own parts in the regions of `prior_pairs`.

    python benchmarks/parts_in_place.py                               # half a minute of a core
    python benchmarks/parts_in_place.py --pairs teddy_backpack+backpack --seeds 3

No run takes place. A part is made for a body of the generator, scaled until it fits the box of the case's regions,
moved to its centre, and judged on the case's base as `prior_in_3d` judges a result. That is no bound: it is placed by
its box alone, and a crown that hangs above the ears is found less often than one that a run fits to the head.
Writes `results.json`.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT / "benchmarks"), str(ROOT / "src")]

from fd_mitsuba.backend.threads import share_cores  # noqa: E402

share_cores(1)
import numpy as np  # noqa: E402
import torch  # noqa: E402
from prior_in_3d import ELEVATION_DEG, HALF_WIDTH, judged, write_scene  # noqa: E402
from prior_pairs import Case, chosen_cases  # noqa: E402

from fd_mitsuba.config import RunConfig  # noqa: E402
from fd_mitsuba.errors import UserError  # noqa: E402
from fd_mitsuba.evaluation.before_and_after import judged_views  # noqa: E402
from fd_mitsuba.evaluation.part_judge import PartJudge, load_judge  # noqa: E402
from fd_mitsuba.io.json_object import write_json  # noqa: E402
from fd_mitsuba.prior.data.bodies import BODIES  # noqa: E402
from fd_mitsuba.prior.data.parts import PARTS  # noqa: E402
from fd_mitsuba.scene.load_scene import load_edit_scene  # noqa: E402
from fd_mitsuba.training.geometry_stage import GeometryStage  # noqa: E402

BODY_OF_UNKNOWN = "mug"
"""Whose parts a base gets that the generator has no body for, such as a stump."""


def found_in_truth(case: Case, seeds: int, folder: Path, judge: PartJudge) -> list[float]:
    """The share of the ring views in which the case's part is found, for each seed."""
    scene = load_edit_scene(write_scene(case, folder))
    stage = GeometryStage(scene, RunConfig.load(ROOT / "configs" / "quick.toml"), None)
    base = stage.base_surface
    before = judged_views(base.vertices, base.faces, stage.aim, ELEVATION_DEG, HALF_WIDTH)
    room = stage.grid.vertices[stage.region_sdf > 0].numpy()
    low, high = room.min(axis=0), room.max(axis=0)
    shares = []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        part = PARTS[case.part](BODIES[case.kind or BODY_OF_UNKNOWN](rng), rng)
        corners = np.asarray(part.vertices, dtype=np.float64)
        scale = ((high - low) / np.ptp(corners, axis=0)).min()
        placed = (corners - (corners.min(axis=0) + corners.max(axis=0)) / 2) * scale + (low + high) / 2
        vertices = torch.cat([base.vertices.float(), torch.from_numpy(placed).float()])
        faces = torch.from_numpy(np.asarray(part.faces, dtype=np.int64)) + len(base.vertices)
        after = judged_views(vertices, torch.cat([base.faces, faces]), stage.aim, ELEVATION_DEG, HALF_WIDTH)
        shares.append(judged(judge, case.part, before, after)["found"])
    return shares


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "runs" / "parts_in_place", metavar="FOLDER")
    parser.add_argument("--pairs", default="all", help="all, or some of the names that prior_in_3d.py --help lists")
    parser.add_argument("--seeds", type=int, default=3, metavar="N", help="parts of each case; default: 3")
    options = parser.parse_args()
    try:
        cases, judge = chosen_cases(options.pairs), load_judge(ROOT / "benchmarks" / "part_classifier")
        found = {}
        for case in cases:
            found[case.name] = found_in_truth(case, options.seeds, options.output, judge)
            print(f"{case.prompt}: {', '.join(f'{share:.0%}' for share in found[case.name])}", flush=True)
    except UserError as error:
        print(f"parts_in_place: error: {error}", file=sys.stderr)
        return 1
    mean = round(float(np.mean([np.mean(shares) for shares in found.values()])), 4)
    write_json(options.output / "results.json", {"found": mean, "cases": found})
    print(json.dumps({"found": mean}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
