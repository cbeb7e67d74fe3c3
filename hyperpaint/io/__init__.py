"""Files to labelled datasets and back; one module a format, no physics."""
