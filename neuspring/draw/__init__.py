"""Pictures: of runs (`run`, `images`), of benchmarks (`benchmark`), for papers (`strip`, `twin`, `film`),
and in a notebook (`show`).

All that shows the world is drawn by one camera model (`scene`) and one painter of panels (`painter`, `twin`).
"""
