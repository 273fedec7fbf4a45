"""Tests of fusion: readings at one time, and the errors of clocks."""
