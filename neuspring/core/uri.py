"""Addresses of stores, which may hold passwords."""

from __future__ import annotations

import re


def masked(text: str) -> str:
    """Text without the user and password of any URI in it."""
    return re.sub(r"://[^/@\s]+@", "://***@", text)


def refuse_password(key: str, uri: str, instead: str) -> None:
    """Raise ValueError if a URI holds a password: command lines and logs of jobs would show it."""
    if ":" in uri.partition("://")[2].partition("/")[0].rpartition("@")[0]:
        raise ValueError(f"{key}: a password would be shown by ps and in logs; set {instead} instead")
