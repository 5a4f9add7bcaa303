"""The folder of a run: written, read, locked, resumed and replayed.

Wider than other rooms: each module is one file of that folder, or one thing that is done with it.
"""
