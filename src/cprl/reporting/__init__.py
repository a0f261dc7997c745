"""Reports that compare finished runs with the published study.

Modules, in the order in which one reads them:
    report        the tables in Markdown, and their figures
    verdicts      when a number, a curve or a claim is contradicted
    result        the files of a run that a report needs
    pooled        runs of one experiment under several seeds, as one result
    random_play   10,000 episodes of random play
    appendix      appendix A beside ours
    curves        the published curves beside ours, under their own windows
    turning       phases and turning points of experiment 5
    claims        a claim, its measure and its verdict
    claims_alone  the claims on experiments 1 to 4
    claims_many   the claims on experiment 5, and combat, replica by replica
    measures      measures of trainings, and of trained agents in new worlds
    figures       a metric of a run beside the published curve
    markdown      tables
"""

from cprl.reporting.report import write_report

__all__ = ["write_report"]
