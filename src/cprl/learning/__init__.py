"""From what happened to better values."""
