"""An HTML report of a run or a sweep in one file, written only from its folder.

Read `page.py` first. `charts.py` draws charts, and `page_blocks.py` contains the parts of a
section.
"""
