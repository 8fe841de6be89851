"""PhysTwin's release: fetch the archives, read the results, compare them with this code and with the published scores.

The readers follow a description of the layout; they are untested with the real archives and the real hub.
"""
