"""From what a camera gave to a capture folder (`neuspring make-capture`).

- `images`, `views`, `bag`, `raw`: folders, videos, RealSense recordings and PhysTwin's raw layout, as pairs of color and depth.
- `choice`: which frames are kept. `units`: the unit of depth and the frame rate. `lenses`: intrinsics, distortion, files of poses.
- `plane`: planes in depth. `world`: the table among them. `charuco`: poses by a board. `poses`: where the cameras are.
- `make`: all of it, as a library function. `store`: the folder, never over another one.
"""
