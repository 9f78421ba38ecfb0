"""How often is the verdict of a run right? On objects whose truth is known: unseen bodies with parts, starts and lumps.

    python benchmarks/verdicts.py                    # 6 parts on each of 29 bodies, about 6 minutes of a core
    python benchmarks/verdicts.py --parts 2 --json runs/verdicts.json

Each object is judged as a run that was asked for its part. "Right" is: a true part looks like its name; the bare start,
lumps in the part's place, and another part do not. The bodies have seeds that no training has seen.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "src"))

import numpy as np  # noqa: E402
import torch  # noqa: E402

from fd_mitsuba.backend.startup import start  # noqa: E402
from fd_mitsuba.evaluation.part_judge import load_judge  # noqa: E402
from fd_mitsuba.evaluation.verdict import LIKE, SURE, judge_part  # noqa: E402
from fd_mitsuba.guidance.model_vocabulary import vocabulary_of  # noqa: E402
from fd_mitsuba.io.json_object import write_json  # noqa: E402
from fd_mitsuba.prior.data.catalogue import FINE  # noqa: E402
from fd_mitsuba.prior.data.primitives import Solid, join  # noqa: E402
from fd_mitsuba.prior.data.starts import starts_like  # noqa: E402
from fd_mitsuba.prior.pictures.part_corpus import SEEDS_APART, UNSEEN_SEED, lumps_of  # noqa: E402

SEED = UNSEEN_SEED + 9 * SEEDS_APART
KINDS = ("part", "start", "lumps", "other")


def surface(body: Solid, part: Solid | None) -> SimpleNamespace:
    """A body with a part as a run's surface."""
    both = body if part is None else join([body, part])
    weight = torch.zeros(len(both.vertices))
    weight[len(body.vertices) :] = 1
    vertices, faces = torch.from_numpy(both.vertices).float(), torch.from_numpy(np.asarray(both.faces, np.int64))
    return SimpleNamespace(vertices=vertices, faces=faces, part_weight=weight)


def finished_stage(prompt: str, body: Solid, begun: Solid, grown: Solid) -> Any:
    """What a verdict reads of a geometry stage."""
    before, begin, end = (surface(body, part) for part in (None, begun, grown))
    scene = SimpleNamespace(prompt=prompt, base_prompt="")
    return SimpleNamespace(
        scene=scene, aim=np.zeros(3), base_surface=before, start_surface=lambda: begin, surface=lambda: end
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--parts", type=int, default=6, metavar="N", help="random parts on each body; default: 6")
    parser.add_argument("--json", type=Path, metavar="FILE", help="every verdict")
    options = parser.parse_args()
    torch.set_num_threads(1)
    start("llvm_ad_rgb")
    judge, words = load_judge(), vocabulary_of("builtin-wide")
    assert words is not None
    rows: list[dict[str, Any]] = []
    for number, name in enumerate(words.bodies):
        rng = np.random.default_rng([SEED, number])
        made = FINE.make_body(name, rng)
        suited = [part for part in FINE.parts_of(name) if part in words.parts]
        for part in rng.choice(suited, min(options.parts, len(suited)), replace=False):
            true = FINE.grow(made, str(part), rng).solid
            begun = starts_like(true, rng)
            other = str(rng.choice([one for one in suited if one != part]))
            solids = (true, begun, lumps_of(true, rng), FINE.grow(made, other, rng).solid)
            for kind, solid in zip(KINDS, solids, strict=True):
                prompt = f"a {words.bodies[name][0]} with {words.parts[part][0]}"
                verdict = judge_part(finished_stage(prompt, made.solid, begun, solid), judge, words)
                if verdict is None:
                    print(f"{prompt}: not judged", file=sys.stderr)
                    continue
                seen = next(iter(verdict.shares))
                row = {"body": name, "part": str(part), "kind": kind, "looks_like": verdict.looks_like, "seen": seen}
                rows.append(row | {"share": verdict.share, "sure": verdict.sure, "other": other})
        print(f"{name}: {_summary(rows)}", file=sys.stderr, flush=True)
    if options.json:
        write_json(options.json, {"verdicts": rows})
    for part in words.parts:
        print(f"{part:14} {_summary([row for row in rows if row['part'] == part])}")
    print(f"{'all':14} {_summary(rows)}")
    return 0


def _summary(rows: list[dict[str, Any]]) -> str:
    texts = []
    for kind in KINDS:
        mine = [row for row in rows if row["kind"] == kind]
        if mine:
            like, sure = (float(np.mean([row[key] for row in mine])) for key in ("looks_like", "sure"))
            texts.append(f"{kind} {like:.0%} >= {LIKE}, {sure:.0%} >= {SURE} of {len(mine)}")
    return "; ".join(texts)


if __name__ == "__main__":
    sys.exit(main())
