"""The game: numpy and numba; knows nothing of torch or of learning."""
