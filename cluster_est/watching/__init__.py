"""Runs seen from their folders alone while they go on: as views, and as a page in a browser."""
