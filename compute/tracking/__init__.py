"""Tracking of markers: association, filtering, initiation, management, identification."""
