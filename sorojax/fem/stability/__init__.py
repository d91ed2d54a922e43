"""Paths over limit points, bifurcations, buckling, vibration modes."""
