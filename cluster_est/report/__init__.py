"""One HTML file that says what a run or a sweep found, from its folder alone.

Read `page.py` first.
"""

from cluster_est.report.page import REPORT, write_report
from cluster_est.report.sweep_page import is_sweep, write_sweep_report

__all__ = ["REPORT", "is_sweep", "write_report", "write_sweep_report"]
