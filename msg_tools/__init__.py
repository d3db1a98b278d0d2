"""
ROS 2 messages and bags on one side, plain measurements on the other.

Nothing here needs a ROS installation.
"""

__all__ = ['BagError', 'BagWriter', 'ConvertError', 'read_bag']


def __getattr__(name: str):
    """Load the bag reader and the converters only when somebody asks for them."""
    if name in ('BagError', 'BagWriter', 'read_bag'):
        from msg_tools import bag

        return getattr(bag, name)
    if name == 'ConvertError':
        from msg_tools.errors import ConvertError

        return ConvertError
    raise AttributeError(f"module 'msg_tools' has no attribute '{name}'")
