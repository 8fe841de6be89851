"""PhysTwin's release: fetch the archives, read the results, compare them with ours and with the published scores.

The real archives and the real hub have not been met yet: the readers are written to the described layout.
"""
