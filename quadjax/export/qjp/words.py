"""Little-endian 32-bit words, written and read in order."""

import numpy as np

from quadjax.core.errors import InputError


class Writer:
    """Collects words."""

    def __init__(self) -> None:
        self._parts: list[np.ndarray] = []

    def put(self, *values: object) -> None:
        """Append integers or arrays of them, each from -2^31 to 2^32 - 1.

        Raises:
            InputError: an integer that does not fit in a word.
        """
        for value in values:
            numbers = np.ravel(np.asarray(value)).astype(np.int64)
            if np.any((numbers < -(2**31)) | (numbers >= 2**32)):
                raise InputError("a number of the policy does not fit in the 32 bits of a .qjp")
            self._parts.append((numbers & 0xFFFFFFFF).astype("<u4"))

    def text(self, data: str, size: int) -> None:
        """Append text as ``size`` bytes, the last of which is zero."""
        padded = data.encode("ascii", "replace")[: size - 1].ljust(size, b"\0")
        self._parts.append(np.frombuffer(padded, "<u4"))

    def data(self, size_at: int, extra: int) -> bytes:
        """All words; word ``size_at`` becomes their size in bytes plus ``extra``."""
        words = np.concatenate(self._parts)
        words[size_at] = 4 * len(words) + extra
        return words.tobytes()


class Reader:
    """Takes words from the beginning on."""

    def __init__(self, data: bytes) -> None:
        self._words = np.frombuffer(data, "<i4")
        self._at = 0

    def take(self, count: int) -> np.ndarray:
        """The next words, (count,) int64.

        Raises:
            InputError: there are fewer.
        """
        count = int(count)
        if count < 0 or self._at + count > len(self._words):
            raise InputError("its sizes are not those of its header")
        self._at += count
        return self._words[self._at - count : self._at].astype(np.int64)

    def longs(self, count: int) -> np.ndarray:
        """The next integers of two words each, (count,) int64."""
        words = self.take(2 * count).reshape(-1, 2)
        return (words[:, 1] << 32) | (words[:, 0] & 0xFFFFFFFF)

    def text(self, size: int) -> str:
        """The next ``size`` bytes, up to the first zero."""
        data = self.take(size // 4).astype("<i4").tobytes()
        return data.partition(b"\0")[0].decode("ascii", "replace")

    def end(self) -> None:
        """Raise an ``InputError`` if words are left."""
        if self._at != len(self._words):
            raise InputError("its sizes are not those of its header")
