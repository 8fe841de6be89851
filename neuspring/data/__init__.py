"""Readers: other people's files -> Observations. One module per source; `unpickle` is the only way to a pickle."""
