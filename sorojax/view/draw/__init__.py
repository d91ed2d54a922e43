"""How each kind of object is drawn."""
