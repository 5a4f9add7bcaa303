"""The text of a config: where keys stand, what replaces them, what is said of them."""
