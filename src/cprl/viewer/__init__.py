"""The Rerun recording of a training."""
