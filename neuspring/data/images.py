"""Images of a capture's folder: pictures, labels and depth, read with a reason where they cannot be, and written."""

from __future__ import annotations

import contextlib
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import Base

from neuspring.core.errors import InputError
from neuspring.data.camera import Camera

DARKEST = 16383
"""A value that images of 16 bits exceed somewhere, and those of 14 bits nowhere."""


def read_image(path: Path, camera: Camera, flag: int, remedy: str = "") -> np.ndarray:
    """A PNG of the camera's size, read with one of OpenCV's flags. Raises InputError, with `remedy` for a missing file."""
    if not path.is_file():
        raise InputError(path, "this image must exist", "no such file", remedy)
    image = read_picture(path, flag)
    require_size(path, image, camera)
    return image


def read_picture(path: Path, flag: int) -> np.ndarray:
    """An image by one of OpenCV's flags. Raises InputError for a damaged one, or one whose EXIF data turn it: some readers turn it,
    others do not, and intrinsics and depth are of one of the two."""
    with contextlib.suppress(OSError), Image.open(path) as header:
        # Of a PNG without EXIF data PIL would decode the pixels to look for them.
        turned = header.getexif().get(Base.Orientation, 1) if header.format != "PNG" or "exif" in header.info else 1
        if turned not in (0, 1):
            remedy = (
                "Are intrinsics and depth those of the image as viewers show it? Then turn it: mogrify -auto-orient FILES. "
                "Are they those of the sensor? Then remove the mark: exiftool -Orientation= FILES"
            )
            raise InputError(path, "an image must be stored upright, with EXIF orientation 1", turned, remedy)
    color = flag == cv2.IMREAD_COLOR
    if (image := cv2.imread(str(path), cv2.IMREAD_UNCHANGED if color else flag)) is None:
        raise InputError(path, "this file must be a readable image", "a damaged file", "Copy it again from where it was made.")
    if not color or (image.dtype == np.uint8 and image.shape[2:] == (3,)):
        return image
    if image.dtype == np.uint16 and image.max() <= DARKEST:
        remedy = "Write 8 bits, or multiply all images alike (12 bits by 16)."
        raise InputError(path, "color of 16 bits must use its range, 0 to 65535", image.max(), remedy)
    if image.shape[2:] == (4,) and np.ptp(image[..., 3]):
        remedy = "Give images with their background. If it is there below the alpha: magick mogrify -alpha off FILES"
        raise InputError(path, "color must be opaque", "transparent pixels", remedy)
    return np.asarray(cv2.imread(str(path), flag))


def read_array(path: Path, camera: Camera) -> np.ndarray:
    """An .npy image [H, W] of the camera's size. Raises InputError."""
    array = read_npy(path)
    if array.ndim != 2:
        raise InputError(path, "a depth image [H, W] is required", array.shape)
    require_size(path, array, camera)
    return array


def read_npy(path: Path) -> np.ndarray:
    """The array of an .npy file. Raises InputError."""
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        raise InputError(path, "this file must be a NumPy array without pickle", str(error)) from error


def require_size(path: Path, image: np.ndarray, camera: Camera) -> None:
    """Raise InputError unless an image has the camera's size."""
    if image.shape[:2] != (camera.height, camera.width):
        rule = f"camera {camera.name} has images of {camera.width} x {camera.height}"
        raise InputError(path, rule, f"{image.shape[1]} x {image.shape[0]}", "Depth must be aligned to color.")


def make_way(path: Path) -> None:
    """Remove the old file. It may be a link to the original of an imported capture, which must not be overwritten."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write a PNG; a link to another file is replaced."""
    make_way(path)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 3]):
        raise InputError(path, "this file must be writable")
