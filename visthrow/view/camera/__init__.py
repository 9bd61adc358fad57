"""``visthrow camera``: from pictures of a board, or another tool's calibration, to a camera configuration that is checked and looked at."""

BOARD = "chessboard|circles|charuco COLUMNS ROWS SIDE [MARKER [DICTIONARY]]"  # words after ``--board``
