"""What is noise in a record, and how large it is."""
