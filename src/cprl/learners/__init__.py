"""How agents learn, many at once."""
