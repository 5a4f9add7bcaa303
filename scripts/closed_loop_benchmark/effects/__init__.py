"""What the FMUs lack, a file for each field of engineering, as the systems are."""
