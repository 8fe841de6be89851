"""A ChArUco board on a table, as OpenCV prints it, seen by a camera; and a lens."""

from __future__ import annotations

import cv2
import numpy as np

from neuspring.core.geometry import rigid_inverse
from neuspring.extensions.make_capture.lenses import Board

BOARD = "5x7:0.04:0.03:DICT_5X5_100"
LENS = np.array([[600, 0, 319.5], [0, 600, 239.5], [0, 0, 1.0]])
PLAIN = {"fx": 70, "fy": 71, "cx": 39.5, "cy": 29.5}
MATRIX = np.array([[70.0, 0, 39.5], [0, 71.0, 29.5], [0, 0, 1]])
BENT = [-0.25, 0.12, 0.001, -0.002, 0.03]
"""k1, k2, p1, p2, k3."""


def board_image(pose, text=BOARD):
    """What a camera sees of a board that lies on z = 0, its corner at the origin, its rows along x, its columns along minus y."""
    board = Board.of(text)
    print_ = board.opencv().generateImage((board.across * 100, board.down * 100))
    scale = board.square / 100
    # The print's pixel (0, 0) is the middle of a pixel, half of one inside the corner.
    to_world = np.array([[scale, 0, scale / 2], [0, -scale, -scale / 2], [0, 0, 1]])
    homography = LENS @ rigid_inverse(pose)[:3][:, [0, 1, 3]] @ to_world
    view = cv2.warpPerspective(print_, homography, (640, 480), borderValue=200, flags=cv2.INTER_AREA)
    return np.repeat(cv2.GaussianBlur(view, (3, 3), 0)[..., None], 3, axis=2)


def depth_of_table(pose):
    """Depth [480, 640], m, of z = 0."""
    rays = np.stack([*np.mgrid[:480, :640][::-1], np.ones((480, 640))], axis=-1) @ np.linalg.inv(LENS).T @ pose[:3, :3].T
    return -pose[2, 3] / rays[..., 2]
