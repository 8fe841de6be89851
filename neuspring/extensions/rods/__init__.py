"""Cables and ropes as discrete elastic rods: a body, its sources and checks, and DEFORM's benchmark. README.md here is the page."""
