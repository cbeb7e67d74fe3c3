"""From position and attitude of a camera to the ground position of every pixel."""
