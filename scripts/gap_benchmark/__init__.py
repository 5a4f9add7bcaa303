"""Records with gaps, made from the systems of the closed loop's benchmark."""
