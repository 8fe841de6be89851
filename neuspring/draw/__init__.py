"""Pictures: of runs (`run`, `images`), of numbers (`benchmark`), for papers (`strip`, `twin`, `film`),
and in a notebook (`show`).

All of them have one style and one layout of panels (`sheet`), one camera model (`scene`), and one painter of panels
(`painter`, `twin`).
"""
