"""Prior maps, their nearest-neighbour index, reconstruction of what the sensors saw, anomalies."""
