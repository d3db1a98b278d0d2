"""
Prior maps, their nearest-neighbour index, and what the sensors saw.

The last: reconstruction and anomalies.
"""
