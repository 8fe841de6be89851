"""A twin of a user's own film with one command, which chains those of the tutorial (neuspring/perception/README.md)."""
