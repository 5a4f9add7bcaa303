"""Everything that a terminal shows: runs, findings, lists, the line of progress."""
