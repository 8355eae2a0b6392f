"""Which of MediaPipe's 478 face landmarks lie where; left and right are the subject's.

Source: MediaPipe's `FaceLandmarksConnections`; the nose as in FLAME's MediaPipe embedding.
"""

from __future__ import annotations

LEFT_BROW = (276, 282, 283, 285, 293, 295, 296, 300, 334, 336)
RIGHT_BROW = (46, 52, 53, 55, 63, 65, 66, 70, 105, 107)
LEFT_LIDS = (249, 263, 362, 373, 374, 380, 381, 382, 384, 385, 386, 387, 388, 390, 398, 466)
RIGHT_LIDS = (7, 33, 133, 144, 145, 153, 154, 155, 157, 158, 159, 160, 161, 163, 173, 246)
NOSE = (168, 6, 197, 195, 5, 4, 129, 98, 97, 2, 326, 327, 358)
OUTER_LIPS = (61, 146, 91, 181, 84, 17, 314, 405, 321, 375, 291, 409, 270, 269, 267, 0, 37, 39, 40, 185)
INNER_LIPS = (78, 95, 88, 178, 87, 14, 317, 402, 318, 324, 308, 415, 310, 311, 312, 13, 82, 81, 80, 191)
LEFT_IRIS, RIGHT_IRIS = 473, 468  # the centres
IRISES = (LEFT_IRIS, RIGHT_IRIS)
NUM_MESH = 468  # landmarks before those of the irises

BROWS = LEFT_BROW + RIGHT_BROW
LIDS = LEFT_LIDS + RIGHT_LIDS
LIPS = OUTER_LIPS + INNER_LIPS
FEATURES = BROWS + LIDS + NOSE + LIPS  # the 105 points that FLAME's embedding has too

# Pairs whose distance says how far a lid or the mouth is open: upper point, lower point.
LEFT_LID_PAIRS = ((386, 374), (385, 380), (387, 373), (384, 381), (388, 390))
RIGHT_LID_PAIRS = ((159, 145), (158, 153), (160, 144), (157, 154), (161, 163))
LIP_PAIRS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (80, 88), (310, 318))
MOUTH_WIDTH = (61, 291)
