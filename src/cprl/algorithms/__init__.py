"""What agents learn by."""
