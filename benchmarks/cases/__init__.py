"""One file per case; `rod_acceleration.py` is the case `rod.acceleration`."""
