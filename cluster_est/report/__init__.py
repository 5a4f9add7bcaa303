"""One HTML file that says what a run found, from its folder alone.

Read `page.py` first.
"""

from cluster_est.report.page import REPORT, write_report

__all__ = ["REPORT", "write_report"]
