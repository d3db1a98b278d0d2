"""Quality of service of the contract's topics."""

from __future__ import annotations

from msg_tools.topics import Topic
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def input_qos(topic: Topic, reliable: bool) -> QoSProfile:
    """
    Quality of service of an input: best effort hears every publisher.

    The depth of its queue bridges a slow moment of the node.
    """
    reliability = ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=topic.depth, reliability=reliability)


def output_qos(topic: Topic) -> QoSProfile:
    """Reliable, which every subscription accepts; latched where the contract says so."""
    durability = DurabilityPolicy.TRANSIENT_LOCAL if topic.latched else DurabilityPolicy.VOLATILE
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=topic.depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )
