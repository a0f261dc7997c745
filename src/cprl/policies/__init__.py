"""From what agents observe to what they do."""
