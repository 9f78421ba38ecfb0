"""The pairs of body and part that the built-in prior is measured on in three dimensions, and where each part may grow.

Bodies are the meshes of `scenes/`, none of which the prior's generator made. Ellipsoids are given in the canonical
frame (base centred, longest side 1.8, front +z), so that their sizes can be compared; `regions_xml` writes them in the
frame of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass

from fd_mitsuba.errors import UserError
from fd_mitsuba.prior.data.fine.captions import HELD_OUT, PART_WORDS
from fd_mitsuba.scene.normalisation import Normalisation


@dataclass(frozen=True)
class Ellipsoid:
    """Half axes, turned about x and then about z (degrees), then moved to `centre`."""

    centre: tuple[float, float, float]
    half_axes: tuple[float, float, float]
    about_x: float = 0.0
    about_z: float = 0.0


@dataclass(frozen=True)
class Case:
    """One run.

    Attributes:
        scene: folder in `scenes/`.
        body: word of the prompt.
        part: key of the vocabulary's parts.
        kind: the vocabulary's body for `body`; None: the prior knows no such body.
        ellipsoids: where the part may grow; empty: the regions of the shipped scene.
        by_words: the region is where and as large as such a part usually is, see `scene.usual_regions`.
    """

    scene: str
    body: str
    part: str
    kind: str | None
    ellipsoids: tuple[Ellipsoid, ...] = ()
    by_words: bool = False

    @property
    def name(self) -> str:
        return f"{self.scene or self.body}+{self.part}".replace(" ", "_")

    @property
    def prompt(self) -> str:
        return f"{'an' if self.body[0] in 'aeiou' else 'a'} {self.body} with {PART_WORDS[self.part][0]}"

    @property
    def untrained(self) -> bool:
        """Whether the prior's training never showed the two together."""
        return self.kind is None or (self.kind, self.part) in HELD_OUT


def _mirrored(one: Ellipsoid) -> tuple[Ellipsoid, Ellipsoid]:
    x, y, z = one.centre
    return one, Ellipsoid((-x, y, z), one.half_axes, one.about_x, -one.about_z)


CASES = (
    # As shipped, or seen in training.
    Case("pegasus", "horse", "wings", "horse"),
    Case("unicorn", "pony", "horn", "horse"),
    Case("deer", "deer", "antlers", "deer"),
    Case("bronze_bull", "bull", "horns", "cow"),
    Case("cat", "cat", "crown", "cat"),
    Case("snowman", "snowman", "pointed hat", "snowman"),
    Case("teddy_backpack", "bear", "backpack", "bear"),
    Case("skateboard_dog", "dog", "skateboard", "dog"),
    Case("mug", "mug", "handle", "mug"),
    Case("vase", "vase", "flower", "vase"),
    Case("rabbit_glasses", "rabbit", "top hat", "rabbit", (Ellipsoid((0, 0.48, 0.22), (0.29, 0.28, 0.29)),)),
    Case("superhero", "person", "cape", "person", (Ellipsoid((0, -0.16, -0.27), (0.42, 0.68, 0.15)),)),
    # Never shown together in training.
    Case("pegasus", "horse", "cape", "horse", (Ellipsoid((0, 0.06, -0.13), (0.42, 0.33, 0.52)),)),
    Case("cat", "cat", "backpack", "cat", (Ellipsoid((0, 0.31, 0.05), (0.26, 0.24, 0.32)),)),
    Case("cat", "cat", "glasses", "cat", (Ellipsoid((0, 0.36, 0.82), (0.29, 0.13, 0.18)),)),
    Case("snowman", "snowman", "flower", "snowman", (Ellipsoid((0, 0.84, 0.02), (0.25, 0.21, 0.22)),)),
    Case("teddy_backpack", "bear", "spikes", "bear", (Ellipsoid((0, 0.0, -0.52), (0.14, 0.64, 0.22)),)),
    Case("skateboard_dog", "dog", "horns", "dog", _mirrored(Ellipsoid((0.2, 0.62, 0.64), (0.23, 0.13, 0.13), 0, 42))),
    Case("deer", "deer", "butterfly", "deer", (Ellipsoid((0, 0.7, 0.52), (0.4, 0.23, 0.32)),)),
    Case("superhero", "person", "tail", "person", (Ellipsoid((0, 0.1, -0.36), (0.12, 0.29, 0.31)),)),
    Case("cup_straw", "cup", "butterfly", "mug", (Ellipsoid((0, 0.62, 0), (0.5, 0.24, 0.42)),)),
    Case("bronze_bull", "bull", "spikes", "cow", (Ellipsoid((0, 0.52, -0.1), (0.13, 0.22, 0.6), -9),)),
    Case("rabbit_glasses", "rabbit", "cape", "rabbit", (Ellipsoid((0, -0.18, -0.42), (0.44, 0.56, 0.14), 28),)),
    Case("stump_butterfly", "stump", "butterfly", None),
)

MADE_BODIES = ("elephant", "dragon", "chair", "car", "teapot", "bottle", "tree", "head")
"""Of the generator, from a seed of their own: no shipped scene has such a body."""
NEW_CASES = (
    *(
        Case(scene, body, part, kind, by_words=True)
        for scene, body, part, kind in (
            ("pegasus", "horse", "saddle", "horse"),
            ("wooden_horse", "horse", "bat wings", "horse"),
            ("cat", "cat", "bow tie", "cat"),
            ("skateboard_dog", "dog", "scarf", "dog"),
            ("superhero", "person", "sword", "person"),
            ("teddy_backpack", "bear", "shield", "bear"),
            ("rabbit_glasses", "rabbit", "boots", "rabbit"),
            ("snowman", "snowman", "hat", "snowman"),
        )
    ),
    *(
        Case("", body, part, body, by_words=True)
        for body, part in zip(
            MADE_BODIES,
            ("tusks", "fin", "umbrella", "propeller", "candle", "mushroom cap", "ears", "halo"),
            strict=True,
        )
    ),
)
"""Words, and half of them bodies, that are not in `CASES`; the classifier of parts does not know them."""


def chosen_cases(names: str) -> list[Case]:
    """All of `CASES` for "all", `NEW_CASES` for "new", else those with the names, which commas part.

    Raises:
        UserError: a name that is not there.
    """
    lists = {"all": CASES, "new": NEW_CASES}
    if names in lists:
        return list(lists[names])
    known = {case.name: case for case in (*CASES, *NEW_CASES)}
    wanted = [name.strip() for name in names.split(",")]
    for name in wanted:
        if name not in known:
            raise UserError(f"--pairs {name}: no such pair; known: {', '.join(known)}")
    return [known[name] for name in wanted]


def regions_xml(case: Case, frame: Normalisation) -> list[str]:
    """The case's ellipsoids as `focal_region` elements in the scene's own frame."""
    elements, part = [], case.part.replace(" ", "_")
    for number, region in enumerate(case.ellipsoids):
        half = [value / frame.scale for value in region.half_axes]
        x, y, z = frame.to_user(region.centre)
        elements.append(
            f'<shape type="focal_region" id="region_{number + 1}"><string name="part" value="{part}"/>'
            f'<transform name="to_world"><scale x="{half[0]:.6g}" y="{half[1]:.6g}" z="{half[2]:.6g}"/>'
            f'<rotate x="1" angle="{region.about_x:g}"/><rotate z="1" angle="{region.about_z:g}"/>'
            f'<translate x="{x:.6g}" y="{y:.6g}" z="{z:.6g}"/></transform></shape>'
        )
    return elements
