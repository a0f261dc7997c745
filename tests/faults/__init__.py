"""Faults: trainings that are killed, starved of space, locked out or spoilt; see `docs/reliability.md`."""
