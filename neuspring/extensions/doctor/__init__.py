"""`neuspring doctor`: checks of this machine."""
