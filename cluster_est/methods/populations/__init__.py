"""Evolutionary methods: each generation is one request."""
