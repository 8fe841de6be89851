"""Figures of runs (`run`, `images`), of numbers (`benchmark`), for papers (`strip`, `twin`, `film`) and for notebooks (`show`).

They share the style and the layout of panels (`sheet`), the camera model (`scene`) and the drawing of panels (`painter`, `twin`).
"""
