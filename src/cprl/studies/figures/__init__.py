"""Figures of a study's table.

Modules, in the order in which one reads them:
    levels       metrics against a factor, and conditions one below the other; what the figures share
    courses      the course of the training under each condition
    diagrams     maps of two factors: a metric, and phases
"""
