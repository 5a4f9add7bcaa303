"""The folder of a run: written, read, locked, resumed and replayed."""
