"""Masks and ground-truth tracks by hand, in a browser: `neuspring annotate`.

annotations, follow, world, notes, tracks     clicks on points -> places in images -> tracks in the world, and what is doubtful
masks, method, pointing                       the two modes, as all tabs share them
job, document                                 work in the background; files that several tabs edit
server, routes, guard, pictures               requests, and who is answered
static/                                       the page: no build step, nothing from the network
"""

from neuspring.perception.annotate.annotations import Annotations, Click, Point
from neuspring.perception.annotate.follow import GrayImages, Trail, follow
from neuspring.perception.annotate.tracks import tracks_of
from neuspring.perception.annotate.world import lift_places, lift_track

__all__ = ["Annotations", "Click", "GrayImages", "Point", "Trail", "follow", "lift_places", "lift_track", "tracks_of"]
