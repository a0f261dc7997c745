"""One update of many independent learners."""
