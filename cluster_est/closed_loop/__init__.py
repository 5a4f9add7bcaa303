"""Effects that a model lacks: screen, refine, add, refit, and the errors before and after.

Read `loop.py` first.
"""
