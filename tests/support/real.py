"""Recordings that are not part of the repository. Tests on them skip where they are absent."""

import os
from pathlib import Path

FOLDER = Path(os.environ.get("NEUSPRING_TEST_DATA") or Path(__file__).parents[2].parent / "shared" / "data")
"""Search path of these recordings: next to the repository, or from the environment."""
FOOTAGE = FOLDER / "phystwin_camera0"
"""Real color film of one camera, 848 x 480, 30 Hz: videos, masks and points of four frames drawn by hand."""
FILMS = FOLDER / "phystwin22_films"
"""Films of all 22 scenes, 640 x 362, 30 Hz, beside renders of two rivals."""
HANDS = FOLDER / "phystwin_hands"
"""Hand points, nodes of frame 0 and annotated points in space of two scenes of that film."""
