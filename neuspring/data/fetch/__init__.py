"""The released archives: which parts there are, where they lie, and how they are read without being downloaded whole."""
