"""Prior maps, their nearest-neighbour index, and what the sensors saw: reconstruction and anomalies."""
