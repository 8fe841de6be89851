"""Masks by hand, in a browser: `neuspring annotate`.

server, guard            requests, and who is answered; static/ is the page: no build step, nothing from the network
masks                    the state that all tabs share
shared                   a file that several tabs edit; work in the background
"""
