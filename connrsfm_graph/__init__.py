"""Con-NRSfM on GTSAM: the surface of every image and the conformal scale between images, from 2D tracks.

The folders are the stages of the method in the order data flows:
`Tracks -> ImageGraph -> Warps -> Problem -> initialise -> solve -> integrate -> refine -> Reconstruction`.
"""
