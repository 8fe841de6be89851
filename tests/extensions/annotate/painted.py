"""Quick masks for tests of the page: filled boxes, the same in all frames."""

from threading import Event

import numpy as np

from neuspring.core.errors import InputError
from neuspring.extensions.annotate import masks
from neuspring.perception.film import Carried


class Painted:
    """Stands in for the segmenter of marks. `gate` holds work back after its first report until it is set."""

    def __init__(self, patch):
        self.gate = Event()
        self.gate.set()
        patch.setattr(masks, "SEGMENTERS", {"marks": self})

    def outline(self, capture, camera, frame, marks):
        view = capture.cameras[camera]
        return self.fill([mark for mark in marks if mark.frame == frame], (view.height, view.width))

    def fill(self, marks, size):
        if not marks:
            raise InputError("frame", "an object or a hand must be annotated in it")
        labels = np.zeros(size, np.uint8)
        for mark in marks:
            (x0, y0), (x1, y1) = np.round(np.sort(mark.points, axis=0)).astype(int)[[0, -1]]
            labels[y0 : y1 + 1, x0 : x1 + 1] = mark.value
        return labels

    def carry(self, capture, camera, marks, _, device, progress):
        first = min(mark.frame for mark in marks)
        view, count = capture.cameras[camera], capture.frame_count
        labels = self.fill([mark for mark in marks if mark.frame == first], (view.height, view.width))
        for frame in range(count):
            progress(frame + 1, count)
            assert self.gate.wait(30)
        return Carried(np.repeat(labels[None], count, axis=0), np.linspace(0, 1, count))
