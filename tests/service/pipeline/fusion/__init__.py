"""Tests of fused devices."""
