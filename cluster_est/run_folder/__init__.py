"""The folder of a run: its files are written, read, locked, resumed and replayed.

Each module handles one file of that folder, or one operation on the folder.
"""
