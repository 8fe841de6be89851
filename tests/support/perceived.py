"""All perception steps on a small film, through their records as the workflow calls them."""

import numpy as np

from neuspring.config import Config, ScenarioRow
from neuspring.config.perception import Lift, Perception, Sampling
from neuspring.core.artifacts import Observations
from neuspring.stages.lift import lift
from neuspring.stages.observe import observe
from neuspring.stages.segment import segment
from neuspring.stages.track import track

ROW = ScenarioRow(scenario="film", source="capture", category="toy", path="film", self_collision=False, ground=True)
SETTINGS = Config(
    scenarios=("film",),
    perception=Perception(
        lift=Lift(neighborhood=0.02, controller_gaps="rigid", controller_share=0.5, least_controllers=5),
        sample=Sampling(voxel=0.015),
    ),
)


def perceived(capture, folder, row=ROW, settings=SETTINGS):
    """Results of perception for a capture; records and files are in the folder."""
    masks, tracks = [], []
    own = {"capture": capture.folder / "capture.json", "settings": settings}
    for camera in capture.cameras:
        masks.append(folder / camera / "masks.json")
        tracks.append(folder / camera / "tracks.json")
        masks[-1].parent.mkdir(parents=True)
        segment(**own, camera=camera, device="cpu", output=masks[-1])
        track(**own, camera=camera, masks=masks[-1], device="cpu", output=tracks[-1])
    lift(**own, masks=masks, tracks=tracks, output=folder / "lifted.json")
    observe(**own, scenario=row, output=folder / "observations.npz", lifted=folder / "lifted.json")
    return Observations.load(folder / "observations.npz")


def final_data(observations):
    """Observations as the contents of PhysTwin's `final_data.pkl`."""
    visible = observations.object_visibility
    return {
        "object_points": observations.object_points.astype(float),
        "object_colors": np.where(visible[..., None], 0.5, 0.0) * np.ones(3),
        "object_visibilities": visible,
        "object_motions_valid": observations.object_motion_valid,
        "controller_points": observations.controller_points.astype(float),
        "surface_points": observations.surface_points.astype(float),
        "interior_points": observations.interior_points.astype(float),
        "controller_mask": np.arange(observations.controller_points.shape[1]),
    }
