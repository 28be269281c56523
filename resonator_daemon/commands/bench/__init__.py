"""Measure how fast this computer is, with an emulated plate.

Example: resonatord bench latency --seconds 20
"""
