"""The scene as the sensors saw it, and what differs from the map."""
