"""Does the prior of colours paint what the prompt says? Its samples, and parts painted through the guidance."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
from PIL import Image

from fd_mitsuba.config import GuidanceConfig
from fd_mitsuba.config.sections import AppearanceConfig
from fd_mitsuba.guidance.diffusion import DiffusionGuidance
from fd_mitsuba.io.atomic import write_atomically
from fd_mitsuba.io.picture import write_picture
from fd_mitsuba.prior.data.captions import COLOURS
from fd_mitsuba.prior.data.looks import NAMED
from fd_mitsuba.prior.judging.evaluate_colour import balanced_cases, evaluate_colours, prompt
from fd_mitsuba.prior.judging.paint_check import Painted, paint
from fd_mitsuba.prior.training.kinds import APPEARANCE, Kind
from fd_mitsuba.scene.bsdf_reading import PlainMaterial

Case = tuple[str, str, str]
LEAST_NEAREST = 0.85
PAINT_SETTINGS = AppearanceConfig(timestep_range=(0.02, 0.98), weighting="sds", guidance_scale=1.0)
"""Those of `configs/quick.toml` as far as guidance is concerned."""
_MATERIALS = ("gold", "silver", "wood", "plastic")
_PAINT_SEED = 4


def evaluate_paint(
    folder: Path,
    output: Path,
    count: int = 24,
    seed: int = 0,
    steps: int = 12,
    painted: int = 0,
    paint_steps: int = 50,
    say: Callable[[str], None] = lambda line: None,
    kind: Kind = APPEARANCE,
) -> dict:
    """Sample `count` (part, colour or material) prompts, paint the first `painted` of them, and judge the colours.

    Writes the sheet `output`, `output`.json, and with `painted` the sheet `<output>_painted.png`: a row a prompt, clay
    first, then after each quarter of the steps.

    Args:
        folder: a packed pipeline folder of the appearance prior.
        steps: of DDIM.
        paint_steps: of the texture field's descent through the guidance.
        kind: of colours, whose bodies and parts are asked for.

    Returns:
        What the JSON file holds: shares of nearest anchors in CIELAB for colours, materials and both, how metallic and
        how rough painted materials became, and the figure of every prompt.
    """
    cases = balanced_cases(count, seed, kind)
    figures = evaluate_colours(folder, output, cases, seed, steps, kind=kind)
    report: dict = {
        "conditions": {"folder": str(folder), "seed": seed, "steps": steps, "paint_steps": paint_steps},
        "sampled": nearest_shares([(figure.style, figure.nearest) for figure in figures]),
        "samples": [asdict(figure) for figure in figures],
        "painted": None,
        "paintings": [],
    }
    path = output.with_suffix(".json")
    done: list[tuple[Case, Painted]] = []
    settings = GuidanceConfig(model=str(folder), normalise_gradient=True)
    guidance = DiffusionGuidance.load(settings, appearance=PAINT_SETTINGS) if painted else None
    for case in cases[:painted]:
        assert guidance is not None
        result = paint(guidance, case[0], case[1], prompt(*case, kind), _PAINT_SEED + seed, paint_steps, kind=kind)
        done.append((case, result))
        say(f"{prompt(*case, kind)}: nearest to {result.nearest}, metallic {result.metallic:.2f}")
        report["painted"] = painted_figures(done)
        report["paintings"].append(_row(case, result))
        write_atomically(path, (json.dumps(report, indent=1) + "\n").encode())
    if done:
        rows = [np.concatenate(result.pictures, axis=2).transpose(1, 2, 0) for _, result in done]
        sheet = np.rint(255 * np.concatenate(rows).clip(0, 1)).astype(np.uint8)
        write_picture(output.with_name(f"{output.stem}_painted.png"), Image.fromarray(sheet))
    write_atomically(path, (json.dumps(report, indent=1) + "\n").encode())
    return report


def nearest_shares(pairs: Sequence[tuple[str, str]]) -> dict:
    """How often the nearest anchor is the prompted one, from (prompted, nearest): all, colours, materials."""
    groups = {
        "all": pairs,
        "colours": [pair for pair in pairs if pair[0] in COLOURS],
        "materials": [pair for pair in pairs if pair[0] not in COLOURS],
    }
    shares = {
        name: None if not group else round(sum(style == nearest for style, nearest in group) / len(group), 4)
        for name, group in groups.items()
    }
    return {"prompts": len(pairs), **shares, "bar": LEAST_NEAREST}


def painted_figures(done: Sequence[tuple[Case, Painted]]) -> dict:
    """`nearest_shares` of painted parts, and how metallic and rough those became of which it is known.

    Right is a metallic on the anchor's side of a half, and a roughness on its side of where every field starts.
    """

    def means(channel: str) -> dict[str, float]:
        found = {style: [getattr(p, channel) for case, p in done if case[2] == style] for style in _MATERIALS}
        return {style: round(float(np.mean(values)), 3) for style, values in found.items() if values}

    def right(means: dict[str, float], channel: str, middle: float) -> dict[str, bool]:
        return {style: (value > middle) == (getattr(NAMED[style], channel) > middle) for style, value in means.items()}

    shares = nearest_shares([(case[2], painted.nearest) for case, painted in done])
    metallic, roughness = means("metallic"), means("roughness")
    return {
        **shares,
        "metallic": metallic,
        "metallic_right": right(metallic, "metallic", 0.5),
        "roughness": roughness,
        "roughness_right": right(roughness, "roughness", PlainMaterial().roughness),
    }


def _row(case: Case, painted: Painted) -> dict:
    values = {name: value for name, value in asdict(painted).items() if name != "pictures"}
    return {"body": case[0], "part": case[1], "style": case[2], **values}
