"""Calibration of a camera from other tools' files, other lens models, or pictures of a board."""

BOARD = (  # syntax of the option ``--board``
    "chessboard|circles|charuco COLUMNS ROWS SIDE [MARKER [DICTIONARY]]"
)
