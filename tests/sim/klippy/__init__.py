"""Tests of the simulated Klipper host."""
