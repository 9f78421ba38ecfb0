"""Images of an asset: found beside it and nowhere else, of a bearable size, as PNG or JPEG."""

from __future__ import annotations

import io
import warnings
from pathlib import Path, PurePosixPath
from urllib.parse import unquote

import numpy as np
from PIL import Image, UnidentifiedImageError

from fd_mitsuba.assets.asset import TextureImage
from fd_mitsuba.assets.broken import BrokenAsset
from fd_mitsuba.io.picture_size import size_in
from fd_mitsuba.io.regular_file import NotReadable, read_regular
from fd_mitsuba.scene.file_gate import MAX_PIXELS

MOST_BYTES = 1 << 30
"""Of an image file, or of a buffer."""
_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF", "GIF", "PPM")
_AS_THEY_ARE = {"PNG": ".png", "JPEG": ".jpg"}
_READ_BY_MITSUBA = ("L", "RGB", "RGBA")


def beside(folder: Path, name: str) -> Path:
    """The file of that name in an asset's folder or below it; by its last part where it is there alone, without the
    folders that it had: a browser sends files without theirs.

    Args:
        name: relative, with `/` or as Windows writes it.

    Raises:
        BrokenAsset: a name that leads out of the folder, also by a symbolic link.
    """
    place = PurePosixPath(unquote(name).replace("\\", "/"))
    outside = place.is_absolute() or ".." in place.parts or ":" in place.parts[0] if place.parts else True
    try:
        if not outside and not (folder / place).exists() and (folder / place.name).is_file():
            place = PurePosixPath(place.name)
        outside = outside or not (folder / place).resolve().is_relative_to(folder.resolve())
    except (OSError, ValueError, RuntimeError):
        outside = True
    if outside:
        raise BrokenAsset(f"names {name[:60]!r}, which lies outside its folder; put the file beside it and save anew")
    return folder / place


def found_beside(folder: Path, name: str) -> Path | None:
    """The image beside an asset, as the name says or by its last part: many files name folders of their makers."""
    for choice in (name, PurePosixPath(name.replace("\\", "/")).name):
        try:
            path = beside(folder, choice)
        except BrokenAsset:
            continue
        if path.is_file():
            return path
    return None


def read_image(path: Path) -> TextureImage:
    """An image file.

    Raises:
        BrokenAsset: it is missing, no image, or too large.
    """
    try:
        data = read_regular(path, MOST_BYTES)
    except NotReadable as error:
        raise BrokenAsset(f"its image {path.name!r} {error}; keep the asset's files together") from None
    return checked_image(path.stem, data)


def checked_image(name: str, data: bytes) -> TextureImage:
    """An image whose bytes are at hand: as they are where Mitsuba and glTF read them, else as a PNG.

    Raises:
        BrokenAsset: it is no image, or too large.
    """
    shown = name[:60]
    _refuse_large(shown, size_in(io.BytesIO(data)))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = Image.open(io.BytesIO(data), formats=_FORMATS)
            _refuse_large(shown, image.size)
            image.load()
    except BrokenAsset:
        raise
    except UnidentifiedImageError:
        raise BrokenAsset(
            f"its image {shown!r} is damaged, or of no kind that is read; save it as PNG or JPEG"
        ) from None
    except Exception as error:  # Pillow's readers raise many kinds
        problem = f"its image {shown!r} cannot be read ({' '.join(str(error).split())[:80] or 'damaged'})"
        raise BrokenAsset(f"{problem}; save it as PNG or JPEG") from None
    kept = _AS_THEY_ARE.get(image.format or "")
    if kept is not None and image.mode in _READ_BY_MITSUBA and "transparency" not in image.info:
        return TextureImage(name, data, kept)
    return TextureImage(name, png_bytes(_plain(image)), ".png")


def _refuse_large(name: str, size: tuple[int, int] | None) -> None:
    if size is not None and size[0] * size[1] > MAX_PIXELS:
        limit = f"{MAX_PIXELS // 1_000_000} million"
        raise BrokenAsset(f"its image {name!r} has {size[0]} x {size[1]} pixels, more than {limit}; shrink it")


def pixels(image: TextureImage) -> np.ndarray:
    """(H, W, C) uint8 with 1, 3 or 4 channels."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        values = np.asarray(_plain(Image.open(io.BytesIO(image.data), formats=_FORMATS)))
    return values.reshape(*values.shape[:2], -1)


def png_bytes(image: Image.Image) -> bytes:
    """The image as a PNG."""
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=4)
    return stream.getvalue()


def _plain(image: Image.Image) -> Image.Image:
    """The image with 8 bits, grey, RGB or RGBA."""
    if image.mode in _READ_BY_MITSUBA:
        return image.convert("RGBA") if "transparency" in image.info else image
    if image.mode.startswith("I;16") or image.mode == "I":
        return Image.fromarray((np.asarray(image, dtype=np.float64) / 257 + 0.5).clip(0, 255).astype(np.uint8))
    if image.mode in ("1", "F"):
        return image.convert("L")
    has_alpha = "transparency" in image.info or image.mode in ("LA", "PA", "La", "RGBa")
    return image.convert("RGBA" if has_alpha else "RGB")
