"""Calibration of a camera: files of other tools, other lens models, and pictures of a board."""

BOARD = (  # words after ``--board``
    "chessboard|circles|charuco COLUMNS ROWS SIDE [MARKER [DICTIONARY]]"
)
