"""The valve board's own program: protocol, safety state machine, server and drivers.

Standard library only, Python 3.11 or later, so that it runs on a bare Raspberry Pi. The host
uses the same frames from here.
"""
