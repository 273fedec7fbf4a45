"""Correspondence: which peaks of the sensors belong to one marker."""
