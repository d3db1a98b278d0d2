"""The error of this package: a map, cloud or reconstruction that cannot be used."""


class MapError(ValueError):
    """The message names what was wrong, where, and what is valid."""
