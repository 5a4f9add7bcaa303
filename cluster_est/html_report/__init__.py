"""One HTML file that says what a run or a sweep found, from its folder alone.

Read `page.py` first. `charts.py` draws, `page_blocks.py` has what a section is made of.
"""
