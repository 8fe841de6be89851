"""Pictures: of runs (`run`, `images`), of benchmarks (`benchmark`), and for papers (`strip`, `twin`, `film`).

All that shows the world is drawn by one camera model (`scene`) and one painter of panels (`painter`, `twin`).
"""
