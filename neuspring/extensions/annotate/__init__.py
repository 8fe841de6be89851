"""Masks from annotations that a user draws in the browser: `neuspring annotate`.

server    requests and access control; static/ is the page, without a build step and without network resources
masks     the state that all tabs share
shared    a file that several tabs edit; work in the background
"""
