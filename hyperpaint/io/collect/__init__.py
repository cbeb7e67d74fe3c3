"""A whole collect: ``collect.toml`` read, checked, and opened as one tree."""
