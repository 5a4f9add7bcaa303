"""The parts of a model description's XML, read without trusting them."""
