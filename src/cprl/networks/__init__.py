"""What turns an observation into numbers."""
