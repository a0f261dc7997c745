"""Figures of a study's table.

Modules, in the order in which one reads them:
    panels       what the figures share
    by_factor    metrics against a factor
    by_condition  conditions one below the other
    courses      the course of the training under each condition
    diagrams     heat maps and phase diagrams of two factors
"""
