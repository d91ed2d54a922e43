"""What is drawn of each kind of object."""
