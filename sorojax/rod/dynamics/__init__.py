"""Kinematics and equations of motion."""
