"""From seeing to doing."""
