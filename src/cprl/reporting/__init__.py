"""Reports that compare finished runs with the published study."""

from cprl.reporting.report import write_report

__all__ = ["write_report"]
