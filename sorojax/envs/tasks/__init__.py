"""The tasks, one file each, and what tasks of one robot share."""
