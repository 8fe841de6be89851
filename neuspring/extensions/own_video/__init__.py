"""A twin of a user's own video with one command: `neuspring twin` (README.md)."""
