"""A field of labels in which neighbors of the same color like to be the same: mean field of a Potts model."""

from __future__ import annotations

import cv2
import numpy as np

ROUNDS = 10
NEIGHBORS = ((0, 1, 1.0), (1, 0, 1.0), (1, 1, 0.7071), (1, -1, 0.7071))
"""Steps down and right, and weights: the inverse of the distance. The other four neighbors are opposite."""
CLOSE = 6
"""Pixels from a border of labels within which a pixel may change."""
DECIDED = 10.0
"""Log odds from which no neighbors change a pixel."""


def solve(logs: np.ndarray, lab: np.ndarray, smoothness: float, rounds: int = ROUNDS) -> np.ndarray:
    """Probabilities [K, H, W] of labels from log likelihoods [K, H, W] and an image [H, W, 3].

    q_l(p) ~ exp(u_l(p) + sum_n w_pn q_l(n)),   w_pn = s exp(-|c_p - c_n|^2 / (2 m)) / |p - n|

    over the eight neighbors n, m the mean of |c_p - c_n|^2, s = `smoothness`. Only pixels near a border of labels are solved.
    """
    kinds, height, width = logs.shape
    q = _softmax(logs).reshape(kinds, -1)
    pixels = np.flatnonzero(_open(logs))
    if not len(pixels):
        return q.reshape(logs.shape)
    flat, color = logs.reshape(kinds, -1)[:, pixels], lab.reshape(-1, 3).astype(np.float32)
    rows, columns = np.divmod(pixels, width)
    beside, squares, weights = [], [], []
    for down, right, weight in NEIGHBORS:
        for sign in (1, -1):
            row, column = rows + sign * down, columns + sign * right
            there = (row >= 0) & (row < height) & (column >= 0) & (column < width)
            place = np.where(there, row * width + column, pixels)
            beside.append(place)
            squares.append(((color[pixels] - color[place]) ** 2).sum(axis=-1))
            weights.append(np.where(there, np.float32(smoothness * weight), np.float32(0)))
    mean = max(float(np.mean(squares)), 1.0)
    links = [weight * np.exp(-square / (2 * mean)) for weight, square in zip(weights, squares, strict=True)]
    part = q[:, pixels]
    for _ in range(rounds):
        message = flat.copy()
        for place, link in zip(beside, links, strict=True):
            message += link * q[:, place]
        # Half a step: without it, two pixels can exchange their labels forever.
        part = 0.5 * (part + _softmax(message))
        q[:, pixels] = part
    return q.reshape(logs.shape)


def _open(logs: np.ndarray) -> np.ndarray:
    """Which pixels [H, W] are near a border of labels and not decided."""
    best = logs.argmax(axis=0).astype(np.uint8)
    kernel = np.ones((3, 3), np.uint8)
    border = (cv2.dilate(best, kernel) != cv2.erode(best, kernel)).astype(np.uint8)
    near = cv2.dilate(border, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * CLOSE + 1,) * 2)).astype(bool)
    first = logs.max(axis=0)
    others = np.stack([np.where(best == label, -np.inf, part) for label, part in enumerate(logs)]).max(axis=0)
    return np.asarray(near & (first - others < DECIDED))


def _softmax(logs: np.ndarray) -> np.ndarray:
    powers = np.exp(logs - logs.max(axis=0))
    return np.asarray(powers / powers.sum(axis=0), dtype=np.float32)
