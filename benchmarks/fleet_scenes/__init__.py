"""Scenes of the fleet benchmark: lines as a camera sees them, with the truth of every car beside them."""
