"""Figures and videos for papers and pages: `neuspring draw strip`, `twin`, `film` and `frames`."""
