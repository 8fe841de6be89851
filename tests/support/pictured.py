"""A filmed scene with its perception, and the steps of appearance on it, for tests that need pictures."""

import dataclasses

import numpy as np
import pandas as pd

from neuspring.config.images import Images
from neuspring.core.artifacts import Trajectory
from neuspring.core.records import Recorder, StageRecord
from neuspring.splats.train import SplatRates
from neuspring.stages.appearance import appearance
from neuspring.stages.render import render
from tests.support.filmed import FRAMES
from tests.support.perceived import SETTINGS, perceived

IMAGES = Images(appearance=SplatRates(iterations=90, degree=0, spacing=2.0, color_rate=0.02, opacity_rate=0.05))


def pictured(**changes):
    return dataclasses.replace(SETTINGS, images=dataclasses.replace(IMAGES, **changes))


class Scene:
    """A filmed scene with its perception, and what the steps of appearance make of it."""

    def __init__(self, capture, folder):
        self.capture, self.folder = capture, folder
        self.observations = perceived(capture, folder)
        self.masks = [folder / camera / "masks.json" for camera in capture.cameras]
        self.appearance = folder / "appearance" / "appearance.json"

    @property
    def before(self):
        """Inputs of both steps; tests put other parts into the scene."""
        return {"capture": self.capture.folder / "capture.json", "masks": self.masks}

    def learn(self, chosen, seed=0):
        self.appearance.parent.mkdir(exist_ok=True)
        before = self.before | {"lifted": self.folder / "lifted.json"}
        appearance(**before, settings=chosen, seed=seed, device="cpu", output=self.appearance)
        return StageRecord.load(self.appearance)

    def roll(self, step, name, frames=FRAMES):
        """The record of a rollout that moves all nodes by `step` a frame, and diverges after `frames`."""
        path = self.folder / name / "rollout.json"
        path.parent.mkdir(exist_ok=True)
        positions = self.observations.nodes + np.arange(frames)[:, None, None] * step
        ended = {} if frames == FRAMES else {"diverged_frame": frames, "reason": "test"}
        Trajectory(positions=positions, frame_count=FRAMES, **ended).save(path.with_name("trajectory.npz"))
        failure = "" if frames == FRAMES else "rollout: test"
        Recorder("rollout", path).save({"trajectory": path.with_name("trajectory.npz")}, failure=failure)
        return path

    def render(self, rollout, chosen):
        output = rollout.with_name("render.json")
        before = self.before | {"appearance": self.appearance, "rollout": rollout}
        render(**before, observations=self.folder / "observations.npz", settings=chosen, device="cpu", output=output)
        record = StageRecord.load(output)
        return record, pd.read_parquet(record.file("frames", output)) if "frames" in record.files else None
