"""What readers of damaged logs share. Onboard-safe."""

import io
from collections import Counter

from visthrow.common.errors import LogError

MOST_RETURNS = 8
"""Times that a reader may step back to one and the same byte; one that is led astray by a damaged length does so for ever."""


class Forward(io.BytesIO):
    """Bytes of a file for a reader that looks for the next message of a damaged log by stepping back: never in a circle."""

    def __init__(self, data: bytes) -> None:
        """Begin at the first byte."""
        super().__init__(data)
        self._returns: Counter[int] = Counter()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """As of any file.

        Raises:
            LogError: It leads to a byte that was returned to too often.
        """
        before = self.tell()
        after = super().seek(offset, whence)
        if after < before:
            self._returns[after] += 1
            if self._returns[after] > MOST_RETURNS:
                raise LogError(f"the length of a message leads nowhere, near byte {after}")
        return after
