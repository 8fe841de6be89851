"""Sources of scenarios: `sources` declares every kind of data and reads the table of scenarios; `mocap` reads recordings of
cables; `synthetic` makes scenes whose truth is known, filmed ones and toys."""
