"""Tables that ship with the package: the 22 cases, the paper's values, released scores, timings."""
