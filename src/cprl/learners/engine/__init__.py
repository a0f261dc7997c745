"""Engines: one update step for many independent learners."""
