"""The errors of this package."""


class ConvertError(ValueError):
    """
    A message that cannot be used. The text says what, where and what is valid.

    kind: short name of the class of error (`size`, `type`, `stamp`, `frame`, ...), under which
    nodes count it.
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class BagError(ValueError):
    """A bag that cannot be read or written. The text names the file and what is valid."""
