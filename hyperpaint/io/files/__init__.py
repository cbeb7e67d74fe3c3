"""What readers and writers of every format share: bounded reading, patterns, publishing whole, TOML."""
