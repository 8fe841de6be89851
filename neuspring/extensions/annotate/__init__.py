"""Masks and ground-truth tracks by hand, in a browser: `neuspring annotate`.

server, guard            requests, and who is answered; static/ is the page: no build step, nothing from the network
masks, tracks            the two modes, as all tabs share them
clicks                   clicks on points, as a file; one point through the video of one camera
shared                   files that several tabs edit; work in the background
"""
