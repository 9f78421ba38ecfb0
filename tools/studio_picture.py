"""docs/images/studio.jpg: the page of the studio while a crown grows on the cat.

    python tools/studio_picture.py [SECONDS]

Needs chromium, `npm install` in tools/viewers, and viser. SECONDS is how long the part grows before the picture.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image
from studio_process import ROOT, driven, served

PICTURE = ROOT / "docs" / "images" / "studio.jpg"


def main(seconds: float) -> None:
    options = {"prompt": "a cat with a crown", "told": "cat with a crown", "look": 1000 * seconds}
    with tempfile.TemporaryDirectory() as folder:
        with served("scenes/cat/scene.xml", Path(folder) / "work") as url:
            driven("studio_page.mjs", "grow", url, folder, options=options)
        Image.open(f"{folder}/growing.png").convert("RGB").save(PICTURE, quality=85, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} KB")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
