"""Reports that compare finished runs with the published study.

Modules, in the order in which one reads them:
    report    the tables in Markdown, and their figures
    result    the files of a run that a report needs
    figures   a metric of a run beside the published curve
    turning   phases and turning points of experiment 5
    claims    measures for the study's claims
    markdown  tables
"""

from cprl.reporting.report import write_report

__all__ = ["write_report"]
