"""Procedural figures that stand upright: animals, people, robots, snowmen."""

from __future__ import annotations

import numpy as np

from fd_mitsuba.prior.data.body import Body, finish, jitter
from fd_mitsuba.prior.data.primitives import box, ellipsoid, mirror_x, tube


def upright(
    rng: np.random.Generator,
    *,
    head: float,
    torso: float,
    belly: float,
    leg: float,
    arm: float,
    ear: float,
    ear_width: float,
    boxy: bool = False,
    thick: float = 0.3,
) -> Body:
    """Legs, torso, arms and a round (or boxy) head on top."""
    head, torso, belly, leg, arm, ear = (jitter(rng, v) for v in (head, torso, belly, leg, arm, ear))
    shape = box if boxy else ellipsoid
    hip = leg
    chest = hip + torso * 2
    head_y = chest + head * 0.86
    solids = [
        shape((0, hip + torso * 0.95, 0), (belly, torso * 1.1, belly * 0.8)),
        shape((0, head_y, head * 0.08), (head, head * (0.85 if boxy else 0.95), head * 0.92)),
    ]
    limb = belly * thick
    swing = rng.uniform(0.2, 0.9)
    for sign in (1, -1):
        x = sign * belly * 0.5
        solids.append(
            tube([(x, hip + torso * 0.3, 0), (x, limb * 0.8, 0), (x, limb * 0.7, limb)], [limb * 1.1, limb, limb])
        )
        shoulder = np.array([sign * belly * 0.82, chest - torso * 0.45, 0])
        hand = shoulder + arm * np.array([sign * np.sin(swing), -np.cos(swing), 0.25])
        solids.append(tube([shoulder, hand], [limb * 0.85, limb * 0.75]))
        if ear > 0:
            root = np.array([sign * head * 0.6, head_y + head * 0.62, 0])
            solids.append(
                tube(
                    [root, root + np.array([sign * 0.3, 1, 0]) * ear],
                    [ear_width * head, ear_width * head * 0.9],
                    flatten=0.6,
                )
            )
    solids.append(ellipsoid((0, head_y - head * 0.15, head * 0.92), (head * 0.3, head * 0.25, head * 0.28)))
    return finish(
        solids,
        head_top=(0, head_y + head * (0.8 if boxy else 0.9), 0),
        head_radius=head * 0.85,
        forehead=(0, head_y + head * 0.62, head * 0.66),
        horn_direction=(0, 0.8, 0.6),
        back=(0, chest - torso * 0.5, -belly * 0.55),
        back_half_width=belly * 0.45,
        reach=torso * 1.6 + head * 0.4,
        side=(belly * 0.95, hip + torso * 0.9, 0),
        side_height=torso * 1.3,
        bottom=0.0,
        foot_x=belly * 0.5 + limb,
        foot_z=limb * 2.2,
        upright=True,
        foot_centre_z=limb * 0.4,
    )


def snowman(rng: np.random.Generator) -> Body:
    low, middle, head = jitter(rng, 1.0, 0.08), jitter(rng, 0.74, 0.08), jitter(rng, 0.52, 0.08)
    middle_y = low * 0.86 + low * 0.55 + middle * 0.5
    head_y = middle_y + middle * 0.75 + head * 0.55
    solids = [
        ellipsoid((0, low * 0.86, 0), (low, low * 0.9, low)),
        ellipsoid((0, middle_y, 0), (middle,) * 3),
        ellipsoid((0, head_y, 0), (head,) * 3),
        tube([(0, head_y, head * 0.9), (0, head_y - 0.02, head * rng.uniform(1.4, 1.8))], [head * 0.16, head * 0.03]),
    ]
    if rng.random() < 0.7:
        arm = tube(
            [(middle * 0.8, middle_y + 0.1, 0), (middle * 1.9, middle_y + rng.uniform(0.2, 0.7), 0.1)], [0.07, 0.05]
        )
        solids += [arm, mirror_x(arm)]
    return finish(
        solids,
        head_top=(0, head_y + head * 0.9, 0),
        head_radius=head * 0.85,
        forehead=(0, head_y + head * 0.7, head * 0.62),
        horn_direction=(0, 0.8, 0.6),
        back=(0, middle_y + middle * 0.3, -middle * 0.6),
        back_half_width=middle * 0.5,
        reach=middle * 1.6,
        side=(low * 0.95, low * 0.9, 0),
        side_height=low * 1.2,
        bottom=0.0,
        foot_x=low * 0.6,
        foot_z=low * 0.8,
        upright=True,
        foot_centre_z=0.0,
    )
