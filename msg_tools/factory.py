"""
Where message classes come from: an installed ROS, or rosbags' own type store.

Converters are handed one of these.
"""

from __future__ import annotations

import array
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
import importlib
from typing import Any

import numpy as np

SLACK = 8  # bytes behind a message that are not an error


@dataclass(frozen=True)
class Messages:
    """
    Builds messages of one flavour.

    resolve: message class of a full type name such as `sensor_msgs/msg/Imu`.
    octets, doubles: turn an array into what the flavour wants in a `uint8[]` or a `float64[]` of
    free length. blank: that many octets, to be written in place. uncopied: what a message is made
    with in order to take over such octets as they are.
    """

    resolve: Callable[[str], type]
    octets: Callable[[np.ndarray], Any]
    doubles: Callable[[np.ndarray], Any]
    blank: Callable[[int], Any]
    uncopied: dict[str, Any]

    def __call__(self, type_name: str, **fields: Any) -> Any:
        """Make a message with all its fields given."""
        return self.resolve(type_name)(**fields)


@cache
def ros_messages() -> Messages:
    """Messages of the installed ROS packages, which rclpy publishes."""

    @cache
    def resolve(type_name: str) -> type:
        package, _, name = type_name.split('/')
        return getattr(importlib.import_module(f'{package}.msg'), name)

    # An array.array is taken over as a block; an ndarray would be copied element by element (up to
    # 3 ms a cloud).
    return Messages(
        resolve,
        lambda a: array.array('B', a.tobytes()),
        lambda a: array.array('d', a.tobytes()),
        lambda size: array.array('B', b'\0') * size,
        {'check_fields': True},  # what rclpy's messages do not check they copy
    )


@cache
def typestore():
    """Return the type store of ROS 2 Jazzy's messages."""
    from rosbags.typesys import get_typestore, Stores

    return get_typestore(Stores.ROS2_JAZZY)


@cache
def bag_messages() -> Messages:
    """Messages of rosbags' type store, which bags are written from and read into."""
    types = typestore().types
    return Messages(
        types.__getitem__,
        lambda a: np.frombuffer(a.tobytes(), np.uint8),
        np.ascontiguousarray,
        lambda size: np.zeros(size, np.uint8),
        {},
    )


def deserialize(data: bytes, type_name: str):
    """
    Deserialise the rosbags message of bytes (CDR with its 4-byte head).

    Raises rosbags' SerdeError and others.

    rclpy's `serialize_message` may leave up to 8 bytes behind the message (it returns the
    estimated length), and bags written with it hold them; rosbags refuses more than 3. So such a
    tail is cut off here.
    """
    from rosbags.serde import SerdeError

    try:
        return typestore().deserialize_cdr(data, type_name)
    except SerdeError:
        definition = typestore().get_msgdef(type_name)
        read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
        message, length = read(data[4:], 0, definition.cls, typestore())
        if len(data) - 4 - length > SLACK:
            raise
        return message
