"""Raw RGBD video -> observations: segment, track, lift, shape prior, sample. Every step has named backends and writes an
artefact."""
