"""Read and write the images of a capture; faulty files raise InputError with the cause."""

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
"""Largest value of a 14-bit image; a 16-bit image that uses its range exceeds it."""


def read_image(path: Path, camera: Camera, flag: int, remedy: str = "") -> np.ndarray:
    """Read a PNG of the camera's size with one of OpenCV's flags. Raises InputError, with `remedy` for a missing file."""
    if not path.is_file():
        raise InputError(path, "this image must exist", "no such file", remedy)
    image = read_picture(path, flag)
    require_size(path, image, camera)
    return image


def read_picture(path: Path, flag: int) -> np.ndarray:
    """Read an image with one of OpenCV's flags.

    Raises InputError for a damaged file, and for EXIF data that rotate the image: only some readers rotate it, and intrinsics and
    depth fit only one of the two orientations.
    """
    with contextlib.suppress(OSError), Image.open(path) as header:
        # PIL would decode the pixels of a PNG without EXIF data to search for them.
        orientation = header.getexif().get(Base.Orientation, 1) if header.format != "PNG" or "exif" in header.info else 1
        if orientation not in (0, 1):
            remedy = (
                "If intrinsics and depth fit the image as viewers show it, rotate it: mogrify -auto-orient FILES. "
                "If they fit the sensor's image, remove the tag: exiftool -Orientation= FILES"
            )
            raise InputError(path, "an image must be stored upright, with EXIF orientation 1", orientation, remedy)
    color = flag == cv2.IMREAD_COLOR
    if (image := cv2.imread(str(path), cv2.IMREAD_UNCHANGED if color else flag)) is None:
        raise InputError(path, "this file must be a readable image", "a damaged file", "Copy it again from its source.")
    if not color or (image.dtype == np.uint8 and image.shape[2:] == (3,)):
        return image
    if image.dtype == np.uint16 and image.max() <= DARKEST:
        remedy = "Write 8 bits, or multiply all images by the same factor (12 bits by 16)."
        raise InputError(path, "16-bit color must use its range, 0 to 65535", f"at most {image.max()}", remedy)
    if image.shape[2:] == (4,) and np.ptp(image[..., 3]):
        remedy = "Use images with their background. If it is stored under the alpha channel: magick mogrify -alpha off FILES"
        raise InputError(path, "color must be opaque", "transparent pixels", remedy)
    return np.asarray(cv2.imread(str(path), flag))


def read_array(path: Path, camera: Camera) -> np.ndarray:
    """Read an .npy image [H, W] of the camera's size. Raises InputError."""
    array = read_npy(path)
    if array.ndim != 2:
        raise InputError(path, "a depth image [H, W] is required", array.shape)
    require_size(path, array, camera)
    return array


def read_npy(path: Path) -> np.ndarray:
    """Read the array of an .npy file. Raises InputError."""
    try:
        return np.asarray(np.load(path, allow_pickle=False))
    except (OSError, ValueError, EOFError) as error:
        raise InputError(path, "this file must be a NumPy array without pickle", str(error)) from error


def require_size(path: Path, image: np.ndarray, camera: Camera) -> None:
    """Raise InputError unless an image has the camera's size."""
    if image.shape[:2] != (camera.height, camera.width):
        rule = f"images of camera {camera.name} must be {camera.width} x {camera.height}"
        raise InputError(path, rule, f"{image.shape[1]} x {image.shape[0]}", "Align depth to color.")


def make_way(path: Path) -> None:
    """Remove the old file. It may link to the original of an imported capture, which must not be overwritten."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)


def write_image(path: Path, image: np.ndarray) -> None:
    """Write a PNG; a link is replaced, not followed."""
    make_way(path)
    if not cv2.imwrite(str(path), np.ascontiguousarray(image), [cv2.IMWRITE_PNG_COMPRESSION, 3]):
        raise InputError(path, "this file must be writable")
