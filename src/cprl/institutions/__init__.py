"""Institutions: rules that people make, as frozen values, and their scalar rules.

Values: `Game(..., institutions=(Quota(share=0.8), Tax(rate=0.2)))`.
    base        what all share
    boundaries  Boundaries: regions with owners
    quotas      Quota, ClosedSeason, ClosedPatches: limits that fit the resource
    taxes       Tax, and Levies of nested groups
    monitoring  Monitoring: whether violations are detected, and what that costs
    sanctions   GraduatedSanctions, and Mediation of tags
    choice      Vote and Sanctioner: what agents decide themselves
Rules, on one world's arrays, compiled by `cprl.commons` for every target:
    arrays      tuples of arrays, allocated and cut into worlds
    memory      the arrays: memory, payments, parameters
    deciding    votes and elections
    limits      which bites and steps are stopped or forbidden
    paying      fines, refunds and taxes
    showing     what agents are shown
"""

from cprl.institutions.base import Institution
from cprl.institutions.boundaries import Boundaries
from cprl.institutions.choice import Sanctioner, Vote
from cprl.institutions.memory import COUNTS
from cprl.institutions.monitoring import Monitoring
from cprl.institutions.quotas import ClosedPatches, ClosedSeason, Quota
from cprl.institutions.sanctions import GraduatedSanctions, Mediation
from cprl.institutions.taxes import Levies, Tax

__all__ = [
    "COUNTS",
    "Boundaries",
    "ClosedPatches",
    "ClosedSeason",
    "GraduatedSanctions",
    "Institution",
    "Levies",
    "Mediation",
    "Monitoring",
    "Quota",
    "Sanctioner",
    "Tax",
    "Vote",
]
