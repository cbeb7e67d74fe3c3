"""What tests share: builders of small inputs, and the programs that watch over a rebuilding."""
