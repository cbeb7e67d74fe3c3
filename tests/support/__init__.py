"""What tests share: builders of small inputs, and the programs that watch over the house."""

from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
"""The repository."""
