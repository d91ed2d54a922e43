"""The zero set: contours, marching cubes, dual contouring, reports."""
