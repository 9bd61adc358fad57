"""``visthrow camera``: from pictures of a board, or another tool's calibration, to a camera
configuration that is checked and looked at.
"""

BOARD = (  # words after ``--board``
    "chessboard|circles|charuco COLUMNS ROWS SIDE [MARKER [DICTIONARY]]"
)
