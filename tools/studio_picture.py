"""docs/images/studio.jpg: the page of the studio while a crown grows on the cat.

    python tools/studio_picture.py [SECONDS]

Needs chromium, `npm install` in tools/viewers, and viser. SECONDS is how long the part grows before the picture.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).parents[1]
PICTURE = ROOT / "docs" / "images" / "studio.jpg"


def main(seconds: float) -> None:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "fd_mitsuba", "studio", "scenes/cat/scene.xml", "--port", "0"]
        server = subprocess.Popen([*command, "-o", f"{folder}/work"], stdout=subprocess.PIPE, text=True, cwd=ROOT)
        try:
            assert server.stdout is not None
            found = re.search(r"http://\S+(?=,)", server.stdout.readline())
            assert found is not None, "the studio did not start"
            options = {"prompt": "a cat with a crown", "told": "cat with a crown", "look": 1000 * seconds}
            script = ROOT / "tools" / "viewers" / "studio_page.mjs"
            subprocess.run(["node", str(script), "grow", found[0], folder, json.dumps(options)], check=True)
        finally:
            server.send_signal(signal.SIGINT)
            server.wait()
        Image.open(f"{folder}/growing.png").convert("RGB").save(PICTURE, quality=85, optimize=True)
    print(f"{PICTURE}: {PICTURE.stat().st_size // 1024} KB")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
